"""Another quadrotor in every episode, drawn from ranges of numbers that builders choose."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Plugin, Simulation, param, state
from crazysim.core.random import drone_key, uniform
from crazysim.dynamics.first_principles import Params
from crazysim.errors import require
from crazysim.plugins.effects.moving_air import require_rotors
from crazysim.rotation import safe_norm

LOGARITHMIC = ("mass", "agility", "lag", "torque")
"""Ranges in which the logarithm is uniform: their ends differ by an order of magnitude."""
RANGES = (*LOGARITHMIC, "thrust_to_weight", "slower_down", "length", "width", "flatness", "drag", "sag")
"""Settings that are ranges (low, high), in the order of ``RandomAirframe.drawn``."""
CRAZYFLIE_MASS, CRAZYFLIE_ARM = 0.0306, 0.028
"""Mass, kg, and distance of the rotors from both axes, m, of the quadrotor from which sizes are scaled with the cube
root of the mass (rl-tools at commit e43ae4bc, ``rl/environments/l2f/parameters/dynamics/crazyflie.h``)."""


def quadrotor_params(
    params: Params,
    *,
    mass: Array,
    thrust: Array,
    arms: tuple[Array, Array],
    inertia: Array,
    lag: Array,
    torque: Array,
    drag: Array | float = 0.0,
) -> Params:
    """Return parameters of quadrotors whose thrust is proportional to the square of the rotor speed.

    Args:
        params: Parameters whose signs of the mixing matrix and largest rotor speed stay.
        mass: Mass, kg. (..., 1)
        thrust: Thrust of a rotor at its largest speed, N. (..., 1)
        arms: Distances of the rotors from the x and from the y axis, m. (..., 1) each
        inertia: Moments of inertia, kg m^2. (..., 3)
        lag: Time constants of rising and of falling rotor speeds, s. (..., 2)
        torque: Drag torque of a rotor over its thrust, m. (..., 1)
        drag: Linear drag, N s/m. (..., 1)
    """
    eye, zero = np.eye(3), 0 * mass
    curve = jnp.concatenate([zero, zero, thrust / params.rotor_vel_max[..., :1] ** 2], axis=-1)[..., None, :]
    rows = jnp.concatenate([jnp.ones_like(mass), arms[1] / arms[0], jnp.ones_like(mass)], axis=-1)
    return params.replace(
        mass=mass,
        L=arms[0],
        J=eye * inertia[..., None],
        J_inv=eye / inertia[..., None],
        rpm2thrust=curve,
        rpm2torque=torque[..., None] * curve,
        rotor_dyn_coef=jnp.concatenate([1 / lag[..., :1], zero, 1 / lag[..., 1:], zero], axis=-1)[..., None, :],
        rotor_vel_min=zero,
        mixing_matrix=jnp.sign(params.mixing_matrix) * rows[..., None],
        drag_matrix=-eye * (drag + zero)[..., None],
        prop_inertia=zero,
    )


def _needs_a_quadrotor(sim: Simulation, plugin: Plugin) -> None:
    require_rotors(sim, type(plugin).__name__)
    n = sim.data.states.rotor_vel.shape[-1]
    require(n == 4, f"expected drones with four rotors for RandomAirframe, got {n}. Use a quadrotor's drone=.")


class RandomAirframe(Plugin, requires=_needs_a_quadrotor):
    """Another quadrotor in every episode, for policies that fly any.

    Its numbers are drawn independently of each other from the ranges below, each (2,): the first four uniformly in the
    logarithm. The order and the directions of rotation of the rotors, and their largest speed, are the airframe's, at
    which the drawn thrust is reached; the thrust is proportional to the square of the speed. Dynamics and
    plugins compute with the drawn numbers; controllers keep those of the airframe, as does ``sim.data.params``, and
    ``sim.plugins.observations(sim.data)`` has the drawn ones by name, such as ``"airframe.mass"``.
    """

    mass: Param = param(default=(0.02, 8.0), core=(2,), positive=True)
    """Mass, kg. (2,)"""
    agility: Param = param(default=(40.0, 1700.0), core=(2,), positive=True)
    """Angular acceleration about x if the two rotors of one side give all their thrust, rad/s^2; it gives the inertia.
    rl-tools' ``sample_dynamics_parameters.cpp`` draws 40 to 1200 for 0.7 of this torque. (2,)"""
    lag: Param = param(default=(0.003, 0.13), core=(2,), positive=True)
    """Time constant of rising rotor speeds, s. (2,)"""
    torque: Param = param(default=(0.004, 0.06), core=(2,), positive=True)
    """Drag torque of a rotor over its thrust, m. (2,)"""
    thrust_to_weight: Param = param(default=(1.5, 10.0), core=(2,), low=1.0)
    """Largest thrust of all rotors over the weight, 1. (2,)"""
    slower_down: Param = param(default=(1.0, 3.0), core=(2,), positive=True)
    """Time constant of falling over that of rising rotor speeds, 1. (2,)"""
    length: Param = param(default=(0.7, 1.4), core=(2,), positive=True)
    """Distance of the rotors from the y axis over that of a scaled Crazyflie, 1. (2,)"""
    width: Param = param(default=(0.7, 1.4), core=(2,), positive=True)
    """Distance of the rotors from the x axis, likewise: arms are not square. (2,)"""
    flatness: Param = param(default=(0.6, 1.0), core=(2,), positive=True, high=1.0)
    """Moment of inertia about z over the sum of the other two, 1 for a plate. (2,)"""
    drag: Param = param(default=(0.0, 0.5), core=(2,), low=0.0)
    """Linear drag over the mass, 1/s. (2,)"""
    sag: Param = param(default=(0.0, 0.15), core=(2,), low=0.0, high=0.9)
    """Loss of the battery's voltage at full load over that without load, 1. ``thrust_to_weight`` is reached with it.
    (2,)"""
    drawn: Array = state((len(RANGES),))
    """Drawn numbers, in the order of ``RANGES``. (n_worlds, n_drones, 11)"""
    is_applied: bool = dataclasses.field(default=False, kw_only=True, repr=False, metadata={"static": True})
    """Whether the data that holds this record has the numbers as drawn."""
    name: str = "airframe"
    order: ClassVar[int] = -3  # before the factors of Randomize

    def bind(self, sim: Simulation) -> RandomAirframe:
        bound = self.with_arrays(sim)
        for name in RANGES:
            limits = np.asarray(getattr(bound, name))
            require(
                np.all(limits[..., 0] <= limits[..., 1]),
                f"expected {name} as (low, high), got {getattr(self, name)!r}. Use the smaller number first.",
            )
        middle = jnp.stack([jnp.mean(getattr(bound, name), axis=-1) for name in RANGES], axis=-1)
        return bound.replace(drawn=jnp.broadcast_to(middle, bound.drawn.shape))

    def reset_episode(self, data: SimData) -> SimData:
        u = uniform(drone_key(data, self.name), (len(RANGES),), self.drawn.dtype)
        limits = jnp.stack([getattr(self, name) for name in RANGES])
        is_logarithmic = np.array([name in LOGARITHMIC for name in RANGES])
        low, high = limits[:, 0], limits[:, 1]
        drawn = jnp.where(is_logarithmic, low * (high / jnp.maximum(low, 1e-9)) ** u, low + u * (high - low))
        return self.write(data, drawn=drawn)

    def with_drawn_numbers(self, data: SimData) -> SimData:
        if self.is_applied:
            return data
        mass, agility, lag, torque, ratio, slower, length, width, flatness, drag, _ = [
            self.drawn[..., k : k + 1] for k in range(len(RANGES))
        ]
        size = CRAZYFLIE_ARM * jnp.cbrt(mass / CRAZYFLIE_MASS)
        thrust = ratio * mass * safe_norm(data.params.gravity_vec) / 4
        # The mass is spread like the rotors, whose distances give the moments of inertia.
        inertia_x = 2 * thrust * size * width / agility
        inertia_y = (length / width) ** 2 * inertia_x
        params = quadrotor_params(
            data.params,
            mass=mass,
            thrust=thrust,
            arms=(size * width, size * length),
            inertia=jnp.concatenate([inertia_x, inertia_y, flatness * (inertia_x + inertia_y)], axis=-1),
            lag=jnp.concatenate([lag, slower * lag], axis=-1),
            torque=torque,
            drag=drag * mass,
        )
        return self.write(data, self.replace(is_applied=True)).replace(params=params)

    def influence(self, data: SimData) -> SimData:
        p, sag = data.params, self.drawn[..., -1:]
        # Speeds are proportional to the voltage. Thrust and torque rise with their square; the states keep the speeds
        # at the voltage of full load. The power is proportional to the third power of the speeds.
        load = jnp.mean((data.states.rotor_vel / p.rotor_vel_max) ** 3, axis=-1, keepdims=True)
        factor = ((1 - sag * load) / (1 - sag))[..., None] ** 2
        return data.replace(params=p.replace(rpm2thrust=factor * p.rpm2thrust, rpm2torque=factor * p.rpm2torque))

    def observations(self, data: SimData) -> dict[str, Array]:
        return {name: self.drawn[..., k : k + 1] for k, name in enumerate(RANGES)}
