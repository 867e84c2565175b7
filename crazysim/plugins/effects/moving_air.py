"""Helpers of several effects: requirements on the model, records and forces of moving air, radii of propellers."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.plugin import Plugin, Simulation, airframe_numbers, state
from crazysim.dynamics import first_principles
from crazysim.dynamics.drag import drag_force
from crazysim.engine.pytree import device_array
from crazysim.errors import ConfigError


class BodiesInAir(Plugin, abstract=True):
    """Base class of plugins with bodies that wind and downwash act on, one body for each drone, such as its load."""

    pos: Array = state((3,))
    """Position of the body, world frame, m. (n_worlds, n_drones, 3)"""
    air_vel: Array | None = state((3,))
    """Velocity of the air at the body from the jets of all drones, world frame, m/s; None without drag.
    (n_worlds, n_drones, 3)"""
    wind_vel: Array | None = state((3,))
    """Velocity of the air at the body from all wind fields, world frame, m/s; None without drag.
    (n_worlds, n_drones, 3)"""


class MovingAir:
    """Base class, beside ``Plugin``, of effects that move the air at the drones."""

    def velocity_at_drone(self, data: SimData) -> Array:
        """Return the velocity of the air at one drone, world frame, m/s. (3,)"""
        raise NotImplementedError

    @property
    def drag_factor(self) -> Array | float:
        """Factor of the drag of one drone, 1. (1,)"""
        return 1.0


def air_velocity(data: SimData) -> Array:
    """Return the velocity of the air at one drone, the sum of all effects that move it, world frame, m/s. (3,)"""
    velocities = [record.velocity_at_drone(data) for record in data.plugins.values() if isinstance(record, MovingAir)]
    return sum(velocities, jnp.zeros_like(data.states.vel))


def drag_factor(data: SimData) -> Array | float:
    """Return the factor of the drag of one drone, the product over all effects, 1. (1,)"""
    return math.prod([record.drag_factor for record in data.plugins.values() if isinstance(record, MovingAir)])


def with_moving_air(data: SimData, air_vel: Array) -> SimData:
    """Return the data with the force that moving air adds to the drag.

    The drag is linear: the drag of the velocity relative to the air is the drag of the velocity plus the drag of
    ``-air_vel``.

    Args:
        data: The data, of dynamics with drag.
        air_vel: Velocity of the air, world frame, m/s. (..., 3)
    """
    s = data.states
    force = s.force + drag_force(s.quat, -air_vel, data.params.drag_matrix)
    return data.replace(states=s.replace(force=force))


def has_drag(sim: Simulation) -> bool:
    """Whether the model has drag, and the drag of at least one airframe is not zero."""
    drag = getattr(sim.data.params, "drag_matrix", None)
    return drag is not None and bool(np.any(np.asarray(drag)))


def require_drag(sim: Simulation, effect: str) -> None:
    """Check that moving air would push the drones."""
    if not has_drag(sim):
        raise ConfigError(
            f"{effect} acts through drag, and drone {sim.airframes[0].name!r} has none in this model. Use "
            f"dynamics='first_principles' or 'so_rpy_rotor_drag' and an airframe with drag coefficients."
        )


def require_rotors(sim: Simulation, effect: str) -> None:
    if not isinstance(sim.data.params, first_principles.Params):
        raise ConfigError(f"{effect} acts on single rotors, which only dynamics='first_principles' has")


def needs_rotors(sim: Simulation, plugin: Plugin) -> None:
    """Check that the model has rotors, as a requirement of a class of plugins."""
    require_rotors(sim, type(plugin).__name__)


def needs_drag(sim: Simulation, plugin: Plugin) -> None:
    """Check that moving air would push the drones, as a requirement of a class of plugins."""
    require_drag(sim, type(plugin).__name__)


def rotor_positions(sim: Simulation) -> Array:
    """Return the positions of the rotors, body frame, m; zero for rotors that a drone lacks. (..., n_rotors, 3)"""
    positions = airframe_numbers(sim, lambda airframe: airframe.value("rotors.position"), ("rotors", 3))
    return device_array(positions, sim.data.states.pos.dtype)
