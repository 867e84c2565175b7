"""Randomisation: parameters of the drones that are drawn at random at the beginning of every episode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Plugin, Simulation, drone_array, param, state
from crazysim.core.random import drone_key, uniform
from crazysim.errors import ConfigError, short_repr
from crazysim.plugins.effects.battery import Battery, open_circuit_voltage
from crazysim.plugins.effects.latency import Latency
from crazysim.plugins.effects.moving_air import MovingAir, has_drag, needs_rotors, require_drag, with_moving_air
from crazysim.plugins.effects.rotor_aerodynamics import RotorAerodynamics

FACTOR_SETTINGS = ("mass", "inertia", "torque", "lag", "drag")
"""Settings whose factors are the entries of ``Randomize.factors``, in this order."""
RANGE_SETTINGS = (*FACTOR_SETTINGS, "thrust", "rotor_thrust", "wind", "charge", "delay")
"""Settings that are ranges (low, high)."""


class Randomize(MovingAir, Plugin, requires=needs_rotors):
    """Random differences of the drones from their airframe, drawn anew for every episode; needs rotors.

    Each setting is a range (low, high): one for all drones, (2,), or one per drone, (n_worlds, n_drones, 2). A number
    is drawn uniformly from it for every drone at every reset, or in the first step of a simulation that was not reset.
    Two equal numbers give a fixed number; None changes nothing. Controllers use the airframe's numbers. The number
    drawn for a setting does not depend on the other settings. ``Randomize.crazyflie()`` and ``Randomize.generic()``
    have ranges from the literature.
    """

    mass: Param = param(default=None, core=(2,), positive=True)
    """Factor of the mass. (2,)"""
    inertia: Param = param(default=None, core=(2,), positive=True)
    """Factor of the inertia, the same for all axes. (2,)"""
    thrust: Param = param(default=None, core=(2,), positive=True)
    """Factor of the thrust, the same for all rotors of a drone. (2,)"""
    rotor_thrust: Param = param(default=None, core=(2,), positive=True)
    """Factor of the thrust, drawn separately for each rotor; it multiplies the factor ``thrust``. (2,)"""
    torque: Param = param(default=None, core=(2,), positive=True)
    """Factor of the rotors' drag torque. (2,)"""
    lag: Param = param(default=None, core=(2,), positive=True)
    """Factor of the rates of the rotors' lag: their time constants are divided by it. (2,)"""
    drag: Param = param(default=None, core=(2,), low=0.0)
    """Factor of the linear drag, or of the rotor drag and loss of thrust by inflow of ``RotorAerodynamics``. (2,)"""
    wind: Param = param(default=None, core=(2,), low=0.0)
    """Speed of a mean wind of random horizontal direction, m/s; needs a model with drag. (2,)"""
    charge: Param = param(default=None, core=(2,), low=0.0, high=1.0)
    """State of charge at the beginning of an episode; needs ``Battery``. (2,)"""
    delay: Param = param(default=None, core=(2,), low=0.0)
    """Delay of commands, steps, rounded down; needs ``Latency`` with one delay per drone. (2,)"""
    optional: Sequence[str] = ()
    """Settings, of ``charge``, ``drag``, ``wind`` and ``delay``, that are ignored if the simulation lacks what they act
    on; without this, they raise an error. The ranges of presets are optional."""
    factors: Array = state((len(FACTOR_SETTINGS),))
    """Factors of mass, inertia, drag torque, rates of the rotors' lag, and linear drag, 1. (n_worlds, n_drones, 5)"""
    thrust_factors: Array = state(("rotors",))
    """Factors of the thrust of the rotors, 1. (n_worlds, n_drones, n_rotors)"""
    air_vel: Array = state((3,), optional=True)
    """Mean wind, world frame, m/s; None without wind. (n_worlds, n_drones, 3)"""
    name: str = "randomize"
    order: ClassVar[int] = -2  # before effects that change the same parameters

    def __post_init__(self) -> None:
        """Check the settings that do not depend on a simulation."""
        super().__post_init__()
        if self.is_bound:
            return
        if not isinstance(self.optional, (list, tuple)) or not all(name in RANGE_SETTINGS for name in self.optional):
            raise ConfigError(
                f"expected optional as a list of {', '.join(RANGE_SETTINGS)}, got {short_repr(self.optional)}. Use "
                f"optional=('wind',), say."
            )

    @classmethod
    def crazyflie(cls, **changes: ArrayLike | None) -> Randomize:
        """Return a plugin with ranges that cover the published identifications of Crazyflies 2.x in several flights.

        The page *Disturbances, randomisation, sim to real* has the source of each range.

        Args:
            changes: Other settings, by name.
        """
        ranges: dict[str, Any] = {
            "mass": (0.91, 1.05),
            "inertia": (0.85, 1.32),
            "thrust": (0.88, 1.12),
            "rotor_thrust": (0.95, 1.05),
            "lag": (0.9, 1.9),
            "drag": (0.5, 1.6),
            "wind": (0.05, 0.4),
            "charge": (0.1, 1.0),
        }
        return cls._preset(ranges, changes)

    @classmethod
    def generic(cls, **changes: ArrayLike | None) -> Randomize:
        """Return a plugin with factors of 0.7 to 1.3, the widest range of Ferede et al. 2025 (arXiv 2504.21586).

        The additional factor of each rotor's thrust has the range 0.95 to 1.05, and the charge the range 0.1 to 1.

        Args:
            changes: Other settings, by name.
        """
        ranges: dict[str, Any] = dict.fromkeys((*FACTOR_SETTINGS, "thrust"), (0.7, 1.3))
        return cls._preset(ranges | {"rotor_thrust": (0.95, 1.05), "charge": (0.1, 1.0)}, changes)

    @classmethod
    def _preset(cls, ranges: dict[str, Any], changes: dict[str, Any]) -> Randomize:
        """Return a plugin with the ranges of a preset, and with changes; ranges without a change are optional."""
        settings: dict[str, Any] = {"optional": tuple([name for name in ranges if name not in changes])}
        return cls(**(settings | ranges | changes))

    def velocity_at_drone(self, data: SimData) -> Array:
        return jnp.zeros_like(data.states.vel) if self.air_vel is None else self.air_vel

    @property
    def drag_factor(self) -> Array | float:
        return 1.0 if self.drag is None else self.factors[..., FACTOR_SETTINGS.index("drag") :]

    def bind(self, sim: Simulation) -> Randomize:
        has_wind = self.wind is not None
        if has_wind and "wind" in self.optional and not has_drag(sim):
            has_wind = False
        elif has_wind:
            require_drag(sim, "wind")
        bound = self.with_arrays(
            sim,
            factors=drone_array(sim, 1.0, len(FACTOR_SETTINGS)),
            thrust_factors=drone_array(sim, 1.0, sim.data.states.rotor_vel.shape[-1]),
            air_vel=drone_array(sim, 0.0, 3) if has_wind else None,
            **({} if has_wind else {"wind": None}),
        )
        for name in RANGE_SETTINGS:
            limits, values = getattr(bound, name), getattr(self, name)
            if limits is not None and np.ndim(values) == 0:
                raise ConfigError(
                    f"expected {name} as (low, high), got {values!r}. Use ({values}, {values}) for a fixed number."
                )
            if limits is not None and np.any(np.asarray(limits[..., 0]) > np.asarray(limits[..., 1])):
                raise ConfigError(f"expected {name} as (low, high), got {values!r}. Use the smaller number first.")
        return bound

    def check_plugins(self, sim: Simulation) -> None:
        records = sim.data.plugins.values()
        latencies = {name: x for name, x in sim.data.plugins.items() if isinstance(x, Latency)}
        has_battery = any(isinstance(x, Battery) for x in records)
        has_any_drag = has_drag(sim) or any(isinstance(x, RotorAerodynamics) for x in records)
        requirements = {
            "charge": (has_battery, "a battery", "sim.add(Battery())"),
            "drag": (has_any_drag, "an airframe with drag", "sim.add(RotorAerodynamics(...))"),
            "delay": (bool(latencies), "late commands", f"sim.add({self._latency_code(sim)})"),
        }
        for setting, (is_met, requirement, remedy) in requirements.items():
            if getattr(self, setting) is not None and not is_met and setting not in self.optional:
                raise ConfigError(
                    f"expected {requirement} for Randomize({setting}=...), got a simulation without. Use {remedy} too, "
                    f"or {setting}=None."
                )
        for name, latency in latencies.items() if self.delay is not None else ():
            batch = (sim.n_worlds, sim.n_drones)
            if latency.delay.shape[:-1] != batch or latency.queue.shape[-2] <= self._max_delay:
                raise ConfigError(
                    f"expected plugin {name!r} with one delay per drone, of up to {self._max_delay} steps, got delay "
                    f"of shape {latency.delay.shape} and queues of {latency.queue.shape[-2]} rows. Use "
                    f"{self._latency_code(sim)}."
                )

    @property
    def _max_delay(self) -> int:
        """Longest delay, steps."""
        return 0 if self.delay is None else int(np.max(np.asarray(self.delay)))

    def _latency_code(self, sim: Simulation) -> str:
        """Return the code, for messages, of a ``Latency`` that allows one random delay per drone."""
        return f"Latency(delay=np.zeros({(sim.n_worlds, sim.n_drones)}, int), max_delay={self._max_delay})"

    def influence(self, data: SimData) -> SimData:
        p = data.params
        mass, inertia, torque, lag, drag = (self.factors[k : k + 1] for k in range(len(FACTOR_SETTINGS)))
        changes = {}
        if self.mass is not None:
            changes["mass"] = mass * p.mass
        if self.inertia is not None:
            changes |= {"J": inertia * p.J, "J_inv": p.J_inv / inertia}
        if self.torque is not None:
            changes["rpm2torque"] = torque * p.rpm2torque
        if self.lag is not None:
            changes["rotor_dyn_coef"] = lag * p.rotor_dyn_coef
        if self.drag is not None:
            changes["drag_matrix"] = drag * p.drag_matrix
        if self.thrust is not None or self.rotor_thrust is not None:
            changes["rpm2thrust"] = self.thrust_factors[:, None] * p.rpm2thrust
        data = data.replace(params=p.replace(**changes))
        return data if self.air_vel is None else with_moving_air(data, self.air_vel)

    def observations(self, data: SimData) -> dict[str, Array]:
        observations = {"factors": self.factors, "thrust_factors": self.thrust_factors}
        return observations if self.air_vel is None else observations | {"air_vel": self.air_vel}

    def reset_episode(self, data: SimData) -> SimData:
        n_rotors, dtype = self.thrust_factors.shape[-1], self.factors.dtype
        u = uniform(drone_key(data, self.name), (len(FACTOR_SETTINGS) + 5 + n_rotors,), dtype)

        def draw_in_range(limits: Array | None, random_number: Array) -> Array:
            return (
                jnp.ones_like(random_number) if limits is None else limits[0] + random_number * (limits[1] - limits[0])
            )

        single_factors = [draw_in_range(getattr(self, name), u[k : k + 1]) for k, name in enumerate(FACTOR_SETTINGS)]
        # Thrust, speed and direction of the wind, charge, delay, then the thrust of each rotor.
        other_draws = u[len(FACTOR_SETTINGS) :]
        thrust = draw_in_range(self.thrust, other_draws[:1]) * draw_in_range(self.rotor_thrust, other_draws[5:])
        changes = {"factors": jnp.concatenate(single_factors), "thrust_factors": thrust}
        if self.wind is not None:
            speed, angle = draw_in_range(self.wind, other_draws[1:2]), 2 * math.pi * other_draws[2:3]
            changes["air_vel"] = jnp.concatenate([speed * jnp.cos(angle), speed * jnp.sin(angle), 0 * speed])
        data = self.write(data, self.replace(**changes))

        records = dict(data.plugins)
        for name, other in data.plugins.items():
            if isinstance(other, Battery) and self.charge is not None:
                charge = draw_in_range(self.charge, other_draws[3:4])
                records[name] = other.replace(charge=charge, voltage=open_circuit_voltage(charge, other.n_cells))
            if isinstance(other, Latency) and self.delay is not None:
                steps = jnp.floor(draw_in_range(self.delay, other_draws[4:5])).astype(other.delay.dtype)
                records[name] = other.replace(delay=steps)
        return data.replace(plugins=records)
