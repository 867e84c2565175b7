"""Downwash: the jets of air below drones, which push the other drones of a world through drag."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Plugin, Simulation, StagePlacement, airframe_numbers, derived, param, state
from crazysim.drones.airframe_estimate import AIR_DENSITY
from crazysim.dynamics import first_principles
from crazysim.dynamics.rotor import quadratic_curve
from crazysim.engine.pair_reductions import reduce_over_others
from crazysim.engine.pytree import device_array
from crazysim.plugins.effects.moving_air import (
    BodiesInAir,
    MovingAir,
    needs_drag,
    with_moving_air,
)

JET_DECAY, JET_SPREAD = 5.8, 0.094
"""Velocity decay constant B and spreading rate S of a round turbulent jet, 1 (Hussein, Capp and George 1994; Pope,
Turbulent Flows, 2000, table 5.1)."""


class Downwash(MovingAir, Plugin, replaces=("downwash",), requires=needs_drag):
    """Downwash of the other drones of a world, as drag of the velocity relative to the air; needs a model with drag."""

    propeller_radius: Param = param(default=None, airframe="shape.propeller_radius", positive=True)
    """Radius of a propeller, m; None for the airframe's. (1,)"""
    air_density: Param = param(default=AIR_DENSITY, positive=True)
    """Density of air, kg/m^3. (1,)"""
    diameter: Array = derived()
    """Diameter of the fully contracted jet of a drone, m. (1,)"""
    air_vel: Array = state((3,))
    """Velocity of the air from other drones, world frame, m/s. (n_worlds, n_drones, 3)"""
    name: str = "downwash"

    def bind(self, sim: Simulation) -> Downwash:
        bound = self.with_arrays(sim)
        return bound.replace(diameter=stream_diameter(sim, bound.propeller_radius))

    def velocity_at_drone(self, data: SimData) -> Array:
        return self.air_vel

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        return [StagePlacement(self.stage(self.sum_jets))]

    def influence(self, data: SimData) -> SimData:
        return with_moving_air(data, self.velocity_at_drone(data))

    def sum_jets(self, data: SimData) -> SimData:
        """Add up the jets of all other drones of the world at one drone.

        The load of a drone is also in the jet of the drone that carries it.
        """
        s = data.states
        bodies = {name: x for name, x in data.plugins.items() if isinstance(x, BodiesInAir) and x.air_vel is not None}
        positions = {self.name: s.pos} | {name: x.pos for name, x in bodies.items()}
        axis = rotation.z_axis(s.quat)
        sources = jet_source(collective_thrust(data), self.diameter, self.air_density)

        def opposite_jet_velocities(other: tuple[Array, Array, JetSource], _: Array) -> dict[str, Array]:
            origin, axis, source = other
            return {name: jet_speed(pos - origin, axis, source) * axis for name, pos in positions.items()}

        opposite_velocity = reduce_over_others(opposite_jet_velocities, (s.pos, axis, sources))
        bodies_in_jets = {name: x.replace(air_vel=-opposite_velocity[name]) for name, x in bodies.items()}
        data = data.replace(plugins=data.plugins | bodies_in_jets)
        return self.write(data, self.replace(air_vel=-opposite_velocity[self.name]))


def stream_diameter(sim: Simulation, radius: Array) -> Array:
    """Return the diameter of each drone's contracted stream, m, for a propeller radius, m. (1,) or one per drone

    Far below a rotor the cross-section of its stream is half the rotor's disc (momentum theory).
    """
    factor = np.sqrt(2 * airframe_numbers(sim, lambda airframe: airframe.n_rotors))
    factor = factor[..., None] if factor.ndim else factor
    return device_array(factor * np.asarray(radius), radius.dtype)


def hover_jet_speed(offset: Array, axis: Array, thrust: Array, diameter: Array, air_density: Array) -> Array:
    """Return the speed of the air in the jet of a hovering drone, m/s.

    From 2.5 drone diameters downwards the mean flow below a quadrotor is one round turbulent jet (Bauersfeld
    et al., Robotics meets Fluid Dynamics, RA-L 2025). The speed of such a jet falls as one over the distance, and its
    profile keeps its shape (Pope 2000, sections 5.1 and 5.2):

        u = u_0 / (1 + s / (B d)) / (1 + (sqrt(2) - 1) (r / b)^2)^2,  b = S (s + B d)

    at s below the rotors and r off their axis. Momentum theory gives the speed at the start, ``u_0^2 = 4 T / (pi rho
    d^2)`` with d the diameter of the contracted stream. Two assumptions: the virtual origin lies where the speed of the
    jet is u_0 in the plane of the rotors, and the jet starts smoothly from zero within one diameter below. There is no
    jet above the drone.

    Args:
        offset: Position relative to the drone, world frame, m. (..., 3)
        axis: Body z axis of the drone, world frame. (..., 3)
        thrust: Collective thrust of the drone, N; below zero there is no jet. (..., 1)
        diameter: Diameter d of the drone's contracted stream, m. (..., 1)
        air_density: Density of air, kg/m^3. (..., 1)

    Returns:
        Speed, in the direction of ``-axis``. (..., 1)
    """
    return jet_speed(offset, axis, jet_source(thrust, diameter, air_density))


class JetSource(NamedTuple):
    """The part of a jet's speed that does not depend on the position."""

    strength: Array
    """``u_0 B d``, m^2/s; zero without thrust. (..., 1)"""
    origin: Array
    """Distance ``B d`` of the virtual origin above the rotors, m. (..., 1)"""
    inverse_diameter: Array
    """``1 / d``, 1/m. (..., 1)"""


def jet_source(thrust: Array, diameter: Array, air_density: Array) -> JetSource:
    """Return the source of a drone's jet; for the arguments see ``hover_jet_speed``."""
    has_thrust = thrust > 0
    # The product of u_0 and d.
    speed_times_diameter = jnp.where(
        has_thrust, jnp.sqrt(jnp.where(has_thrust, thrust, 1.0) * 4 / (math.pi * air_density)), 0.0
    )
    return JetSource(JET_DECAY * speed_times_diameter, JET_DECAY * diameter, 1 / diameter)


def jet_speed(offset: Array, axis: Array, source: JetSource) -> Array:
    """Return the speed of the air in a jet, m/s. (..., 1)

    The formula of ``hover_jet_speed`` with one division: for ``q = s + B d`` and
    ``w = q / (q^2 + (sqrt(2) - 1) (r / S)^2)`` the speed is ``u_0 B d q w^2``.
    """
    depth = -rotation.dot(offset, axis)
    off_axis = offset + depth * axis
    # Clamped to zero above the rotors, where the distance to the virtual origin would pass through zero.
    positive_depth = jnp.where(depth < 0, 0.0, depth)
    q = positive_depth + source.origin
    w = q / (q * q + (math.sqrt(2) - 1) / JET_SPREAD**2 * rotation.dot(off_axis, off_axis))
    x = positive_depth * source.inverse_diameter  # depth in diameters
    x = jnp.where(x > 1, 1.0, x)
    fade_in = x * x * (3 - 2 * x)
    return fade_in * source.strength * q * w * w


def mean_rotor_vel(data: SimData) -> Array:
    """Return the mean speed of a drone's rotors, rpm, without the rotors that it lacks (their limit is 0). (..., 1)"""
    rotor_vel, limit = data.states.rotor_vel, data.params.rotor_vel_max  # type: ignore[union-attr]
    if limit.shape[-1] == 1:
        return jnp.mean(rotor_vel, axis=-1, keepdims=True)
    return jnp.sum(rotor_vel, axis=-1, keepdims=True) / jnp.sum(limit > 0, axis=-1, keepdims=True)


def collective_thrust(data: SimData) -> Array:
    """Return the collective thrust of a drone, N, from its rotor speeds or by the fitted model. (..., 1)"""
    p: Any = data.params
    rotor_vel = data.states.rotor_vel
    if isinstance(p, first_principles.Params):
        return jnp.sum(quadratic_curve(rotor_vel, p.rpm2thrust), axis=-1, keepdims=True)
    thrust = data.controls.attitude.cmd[..., 3:] if p.thrust_dyn_coef is None else rotor_vel[..., :1]
    return p.acc_coef + p.cmd_f_coef * thrust
