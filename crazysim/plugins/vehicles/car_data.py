"""States, commands and parameters of cars: the record of a population."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from crazysim.eager import jit_eager_calls
from crazysim.engine.pytree import Members, leaf
from crazysim.plugins.vehicles.car_params import CarParams
from crazysim.plugins.vehicles.car_state import CarState, tilted_quat, to_body_frame, to_world_frame
from crazysim.plugins.vehicles.path import Path


class CarData(Members):
    """States, commands and parameters of the cars of a population."""

    pos: Array = leaf("member", 1)
    """Position of the centre of mass, world frame, m. (n_worlds, n_members, 3)"""
    yaw: Array = leaf("member", 1)
    """Heading, rad, not wrapped. (n_worlds, n_members, 1)"""
    body_vel: Array = leaf("member", 1)
    """Forward and left velocity of the centre of mass, body frame, m/s. (n_worlds, n_members, 2)"""
    yaw_rate: Array = leaf("member", 1)
    """Rate of the heading, rad/s. (n_worlds, n_members, 1)"""
    normal: Array = leaf("member", 1)
    """Unit normal of the ground below, upwards, world frame; it follows terrain with a time constant of
    ``SETTLING_TIME``. (n_worlds, n_members, 3)"""
    steer: Array = leaf("member", 1)
    """Steering angle in the middle of the front axle, rad, positive to the left. (n_worlds, n_members, 1)"""
    distance: Array = leaf("member", 1)
    """Distance that the wheels rolled, m; backwards it decreases. (n_worlds, n_members, 1)"""
    joints: Array | None = leaf("member", 1)
    """Headings of the trailer's drawbar and deck, rad, not wrapped; None without trailers. (n_worlds, n_members, 2)"""
    command: Array = leaf("member", 1)
    """Motor reference, 1, or speed, m/s, depending on the command level, followed by the steering angle, rad.
    (n_worlds, n_members, 2)"""
    applied_command: Array | None = leaf("member", 1)
    """Motor reference and steering angle, rad, of the last tick of the controller; None at the level ``drive``, where
    they are the command. (n_worlds, n_members, 2)"""
    force: Array = leaf("member", 1)
    """External force on the centre of mass, world frame, N; kept until it is changed. (n_worlds, n_members, 3)"""
    torque: Array = leaf("member", 1)
    """External torque, world frame, N m, of which only z acts; kept until it is changed. (n_worlds, n_members, 3)"""
    params: CarParams
    """Parameters of the dynamics."""
    path: Path | None
    """Paths; None for cars that follow no path."""
    index: Array | None = leaf("parameter", 1, (1,))
    """Index of the path that a car follows. (1,)"""
    start_time: Array | None = leaf("parameter", 1, (1,))
    """Simulated time at which a car is at the start of its path, s. (1,)"""
    arc: Array | None = leaf("member", 1)
    """Arc length of the car's projection on its path, m. (n_worlds, n_members, 1)"""
    memory: Any
    """Memory of the path controller."""
    gains: Any
    """Gains of the path controller."""

    @property
    def state(self) -> CarState:
        """State of the dynamics."""
        return CarState(**{name: getattr(self, name) for name in CarState._fields})

    @property
    def quat(self) -> Array:
        """Attitude, body to world, xyzw. (n_worlds, n_members, 4)"""
        return tilted_quat(self.yaw, self.normal)

    @property
    def vel(self) -> Array:
        """Velocity of the centre of mass, world frame, m/s; z is zero even on slopes. (n_worlds, n_members, 3)"""
        return _level_vel(self.yaw, self.body_vel)

    @property
    def ang_vel(self) -> Array:
        """Angular velocity, body frame, rad/s. (n_worlds, n_members, 3)"""
        return _ang_vel_about_z(self.yaw_rate)

    def with_vel(self, vel: Array, ang_vel: Array) -> CarData:
        """Return the record with other velocities; only the horizontal velocity and the yaw rate are used.

        Args:
            vel: Velocity of the centre of mass, world frame, m/s. (..., 3)
            ang_vel: Angular velocity, body frame, rad/s. (..., 3)
        """
        return self.replace(body_vel=to_body_frame(self.yaw, vel[..., :2]), yaw_rate=ang_vel[..., 2:])


@jit_eager_calls()
def _level_vel(yaw: Array, body_vel: Array) -> Array:
    level_vel = to_world_frame(yaw, body_vel)
    return jnp.concatenate([level_vel, jnp.zeros_like(yaw)], axis=-1)


@jit_eager_calls()
def _ang_vel_about_z(yaw_rate: Array) -> Array:
    zero = jnp.zeros_like(yaw_rate)
    return jnp.concatenate([zero, zero, yaw_rate], axis=-1)
