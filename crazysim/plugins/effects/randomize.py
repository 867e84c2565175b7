"""Randomisation: parameters of the drones that are drawn at random at the beginning of every episode."""

from __future__ import annotations

import dataclasses
import difflib
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Plugin, Simulation, check_parameter, derived, drone_array, param, state
from crazysim.core.random import drone_key, uniform
from crazysim.core.settings import Setting
from crazysim.engine.pytree import CORE_NDIM_KEY, Members, PyTree
from crazysim.errors import ConfigError, expect, require
from crazysim.plugins.effects.battery import Battery, open_circuit_voltage
from crazysim.plugins.effects.latency import Latency
from crazysim.plugins.effects.moving_air import MovingAir, has_drag, require_drag, require_rotors, with_moving_air
from crazysim.plugins.effects.rotor_aerodynamics import RotorAerodynamics
from crazysim.tables import NOT_NEGATIVE, range_between, read_number, read_numbers

FACTOR_PATHS = {
    "mass": "params.mass",
    "inertia": "params.J",
    "torque": "params.rpm2torque",
    "lag": "params.rotor_dyn_coef",
    "drag": "params.drag_matrix",
}
"""Path of the number that a setting scales. The factors are the entries of ``Randomize.factors``, in this order."""
FACTOR_SETTINGS = tuple(FACTOR_PATHS)
RANGE_SETTINGS = (*FACTOR_SETTINGS, "thrust", "rotor_thrust", "wind", "charge", "delay")
"""Settings that are ranges (low, high)."""
FACTOR_NAMES = (*FACTOR_SETTINGS, "thrust", "rotor_thrust")
"""Settings that are factors, for which a number r is short for (1 - r, 1 + r)."""
INVERSES = {"params.J": "params.J_inv", "params.J_inv": "params.J"}
"""Paths of numbers that are inverse to others, which change with them."""


def _needs_rotors(sim: Simulation, plugin: Plugin) -> None:
    if any(getattr(plugin, name) is not None for name in (*FACTOR_NAMES, "wind")):
        require_rotors(sim, "Randomize with settings other than paths, charge and delay")


class Randomize(MovingAir, Plugin, requires=_needs_rotors):
    """Random differences of the drones from their airframe, drawn anew for every episode.

    Numbers of drones, controllers, sensors and other plugins are drawn by their path in ``sim.data``, such as
    ``Randomize({"plugins.imu.accel.noise": (0.5, 2.0), "controls.controller.params.kp": 0.2})``, as a range of
    factors of the nominal number. 0.2 is short for (0.8, 1.2). Dynamics, controllers and plugins compute with the
    product; ``sim.data`` keeps the nominal number, which filters assume and your own stages read.

    The settings below act on several numbers, or are no factors; all but ``charge`` and ``delay`` need rotors. Each is
    a range (low, high): one for all drones, (2,), or one per drone, (n_worlds, n_drones, 2); for a factor, a number r
    is short for (1 - r, 1 + r). A number is drawn uniformly for every drone at every reset, or in the first step of a
    simulation that was not reset. Two equal numbers give a fixed number; None changes nothing. The number drawn for a
    path or a setting does not depend on the others.
    ``Randomize.crazyflie()`` and ``Randomize.generic()`` have ranges from the literature; ``Randomize.within(0.05)``
    changes everything by up to 5%.
    """

    paths: Mapping[str, ArrayLike] | None = None
    """Ranges of the factors of numbers by their path, each (2,), (n_worlds, n_drones, 2), or a number r for
    (1 - r, 1 + r)."""
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
    limits: Array = derived(("paths", 2))
    """Ranges of the factors of ``paths``, in their order; None without. (n_paths, 2)"""
    path_factors: Array = state(("paths",), optional=True)
    """Factors of ``paths``, 1; None without. (n_worlds, n_drones, n_paths)"""
    is_applied: bool = dataclasses.field(default=False, kw_only=True, repr=False, metadata={"static": True})
    """Whether the data that holds this record has the numbers as drawn."""
    air_vel: Array = state((3,), optional=True)
    """Mean wind, world frame, m/s; None without wind. (n_worlds, n_drones, 3)"""
    name: str = "randomize"
    order: ClassVar[int] = -2  # before effects that change the same parameters

    def __post_init__(self) -> None:
        super().__post_init__()
        is_list = isinstance(self.optional, (list, tuple)) and all(name in RANGE_SETTINGS for name in self.optional)
        names = ", ".join(RANGE_SETTINGS)
        expect(is_list, f"optional as a list of {names}", self.optional, "Use optional=('wind',), say.")

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
    def within(cls, fraction: float, **changes: ArrayLike | None) -> Randomize:
        """Return a plugin with factors of mass, inertia, thrust, torque, lag and drag that differ from 1 by a fraction.

        Args:
            fraction: Largest relative difference, such as 0.05 for 5%.
            changes: Other settings, by name.
        """
        return cls._preset(dict.fromkeys((*FACTOR_SETTINGS, "thrust"), fraction), changes)

    @classmethod
    def _preset(cls, ranges: dict[str, Any], changes: dict[str, Any]) -> Randomize:
        settings: dict[str, Any] = {"optional": tuple([name for name in ranges if name not in changes])}
        return cls(**(settings | ranges | changes))

    def velocity_at_drone(self, data: SimData) -> Array:
        return jnp.zeros_like(data.states.vel) if self.air_vel is None else self.air_vel

    @property
    def drag_factor(self) -> Array | float:
        return 1.0 if self.drag is None else self.factors[..., FACTOR_SETTINGS.index("drag") :]

    def bind(self, sim: Simulation) -> Randomize:
        # Wind needs drag; if it is optional, it is left out.
        has_wind = self.wind is not None
        if has_wind and "wind" in self.optional and not has_drag(sim):
            has_wind = False
        elif has_wind:
            require_drag(sim, "wind")
        # Ranges of paths, and single numbers as ranges around one.
        settings = {_full_path(sim, path): x for path, x in (self.paths or {}).items()}
        ranges = {
            path: check_parameter(sim, f"paths[{path!r}]", _around_one(path, x), (2,), NOT_NEGATIVE)
            for path, x in settings.items()
        }
        single_factors = {
            name: _around_one(name, getattr(self, name)) for name in FACTOR_NAMES if getattr(self, name) is not None
        }
        bound = self.replace(**single_factors).with_arrays(
            sim,
            paths=tuple(ranges),
            limits=jnp.stack(jnp.broadcast_arrays(*ranges.values()), axis=-2) if ranges else None,
            path_factors=drone_array(sim, 1.0, len(ranges)) if ranges else None,
            factors=drone_array(sim, 1.0, len(FACTOR_SETTINGS)),
            thrust_factors=drone_array(sim, 1.0, sim.data.states.rotor_vel.shape[-1]),
            air_vel=drone_array(sim, 0.0, 3) if has_wind else None,
            **({} if has_wind else {"wind": None}),
        )
        # All ranges are (low, high).
        for name in RANGE_SETTINGS:
            values = settings[name] = getattr(self, name)
            ranges[name] = getattr(bound, name)
            require(
                values is None or name in FACTOR_NAMES or np.ndim(values) > 0,
                f"expected {name} as (low, high), got {values!r}. Use ({values}, {values}) for a fixed number.",
            )
        for name, limits in ranges.items():
            require(
                limits is None or np.all(np.asarray(limits[..., 0]) <= np.asarray(limits[..., 1])),
                f"expected {name} as (low, high), got {settings[name]!r}. Use the smaller number first.",
            )
        return bound

    def check_plugins(self, sim: Simulation) -> None:
        self._check_paths(sim)
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

    def _check_paths(self, sim: Simulation) -> None:
        numbers = _numbers(sim.data, "")
        allowed = [
            path
            for path, (metadata, x) in numbers.items()
            if metadata.get("scope") == "parameter" and jnp.issubdtype(x.dtype, jnp.floating)
            and not path.startswith(f"plugins.{self.name}.")
        ]  # fmt: skip
        for path in {_full_path(sim, path) for path in self.paths or ()} - {*allowed}:
            names = [x for x in allowed if x.rpartition(".")[2] == path.rpartition(".")[2]]
            names += difflib.get_close_matches(path, allowed, cutoff=0.4)
            raise ConfigError(
                f"expected the path of a number in sim.data that may differ between drones, got {path!r}, which is "
                f"{'a state, a whole number, or one for all drones' if path in numbers else 'none'}. Near are "
                f"{', '.join(dict.fromkeys(names)) or 'none'}."
            )
        bound = sim.data.plugins[self.name]
        for k, path in enumerate(bound.paths or ()):
            (metadata, x), limits = numbers[path], np.asarray(bound.limits[..., k, :])
            remedy = "Use another value there, or leave out the path."
            expect(np.any(np.asarray(x)), f"a number other than zero at {path!r}, for factors", np.asarray(x), remedy)
            declared = metadata.get("setting", Setting())
            for factor in (limits[..., 0].min(), limits[..., 1].max()):
                read_numbers(f"{path} times {factor:g}", factor * np.asarray(x), declared.range)

    @property
    def _max_delay(self) -> int:
        return 0 if self.delay is None else int(np.max(np.asarray(self.delay)))

    def _latency_code(self, sim: Simulation) -> str:
        return f"Latency(delay=np.zeros({(sim.n_worlds, sim.n_drones)}, int), max_delay={self._max_delay})"

    def with_drawn_numbers(self, data: SimData) -> SimData:
        if self.is_applied:
            return data
        data = self.write(data, self.replace(is_applied=True))
        factors = [(path, self.factors[..., k]) for k, (name, path) in enumerate(FACTOR_PATHS.items())
                   if getattr(self, name) is not None]  # fmt: skip
        factors += [(path, self.path_factors[..., k]) for k, path in enumerate(self.paths or ())]
        for path, factor in factors:
            data = _scale(data, path, factor, operator.mul)
            data = _scale(data, INVERSES.get(path, ""), factor, operator.truediv)
        if self.thrust is None and self.rotor_thrust is None:
            return data
        thrust_curve = self.thrust_factors[..., None] * data.params.rpm2thrust
        return data.replace(params=data.params.replace(rpm2thrust=thrust_curve))

    def influence(self, data: SimData) -> SimData:
        return data if self.air_vel is None else with_moving_air(data, self.air_vel)

    def observations(self, data: SimData) -> dict[str, Array]:
        observations = {"factors": self.factors, "thrust_factors": self.thrust_factors}
        optional = {"air_vel": self.air_vel, "path_factors": self.path_factors}
        return observations | {name: x for name, x in optional.items() if x is not None}

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
        if self.limits is not None:
            draws = [uniform(drone_key(data, f"{self.name} {path}"), (1,), dtype) for path in self.paths or ()]
            low, high = self.limits[:, 0], self.limits[:, 1]
            changes["path_factors"] = low + jnp.concatenate(draws) * (high - low)
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


def _full_path(sim: Simulation, path: Any) -> str:
    return str(path).replace("controls.controller.", f"controls.{sim.data.controls.mode.value}.controller.", 1)


def _around_one(name: str, value: Any) -> Any:
    if np.ndim(value) > 0:
        return value
    remedy = "Use (low, high), or a number r for (1 - r, 1 + r)."
    r = read_number(name, value, range_between(0.0, 1.0), remedy)
    return 1 - r, 1 + r


def _numbers(node: Any, prefix: str) -> dict[str, tuple[Mapping[str, Any], Array]]:
    found = {}
    for name, metadata, x in _children(node):
        if isinstance(x, (PyTree, dict)) and not isinstance(x, Members):
            found |= _numbers(x, f"{prefix}{name}.")
        elif metadata.get(CORE_NDIM_KEY) is not None and hasattr(x, "dtype"):
            found[f"{prefix}{name}"] = metadata, x
    return found


def _children(node: PyTree | dict[str, Any]) -> list[tuple[str, Mapping[str, Any], Any]]:
    if isinstance(node, dict):
        return [(name, {}, x) for name, x in node.items()]
    return [(f.name, f.metadata, getattr(node, f.name)) for f in dataclasses.fields(node)]  # type: ignore[arg-type]


def _scale(node: Any, path: str, factor: Array, operation: Callable[[Array, Array], Array]) -> Any:
    name, _, rest = path.partition(".")
    for child_name, metadata, x in _children(node) if isinstance(node, (PyTree, dict)) else ():
        if child_name == name and x is not None:
            core_ndim = metadata.get(CORE_NDIM_KEY) or 0
            new = (
                _scale(x, rest, factor, operation)
                if rest
                else operation(x, factor.reshape(factor.shape + (1,) * core_ndim))
            )
            return node | {name: new} if isinstance(node, dict) else node.replace(**{name: new})
    return node
