"""The single-track model of the F1TENTH gym, for results that can be compared with it."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from crazysim.dynamics.models import GRAVITY
from crazysim.engine.pytree import PyTree, as_parameter, leaf

MAX_KINEMATIC_SPEED = 0.5
"""Speed below which the model is kinematic, m/s."""


class CommonRoadParams(PyTree):
    """Parameters of ``commonroad_single_track``; defaults in ``create``."""

    friction: Array = leaf("parameter", 1, (1,))
    """Friction coefficient, 1. (1,)"""
    stiffness: Array = leaf("parameter", 1, (2,))
    """Cornering stiffness of front and rear axle divided by friction and load, 1/rad. (2,)"""
    axle_distances: Array = leaf("parameter", 1, (2,))
    """Distances of front and rear axle from the centre of mass, m. (2,)"""
    height: Array = leaf("parameter", 1, (1,))
    """Height of the centre of mass, m. (1,)"""
    mass: Array = leaf("parameter", 1, (1,))
    """Mass, kg. (1,)"""
    yaw_inertia: Array = leaf("parameter", 1, (1,))
    """Moment of inertia about the vertical axis, kg m^2. (1,)"""
    steer: Array = leaf("parameter", 1, (2,))
    """Least and largest steering angle, rad. (2,)"""
    steer_rate: Array = leaf("parameter", 1, (2,))
    """Least and largest rate of the steering angle, rad/s. (2,)"""
    speed: Array = leaf("parameter", 1, (2,))
    """Least and largest speed, m/s. (2,)"""
    switch_speed: Array = leaf("parameter", 1, (1,))
    """Speed above which the largest acceleration decreases with the inverse of the speed, m/s. (1,)"""
    acc_max: Array = leaf("parameter", 1, (1,))
    """Largest acceleration, m/s^2. (1,)"""

    @staticmethod
    def create() -> CommonRoadParams:
        """Return the gym's defaults (f1tenth/f1tenth_gym, commit 4fdb9c7, gym/f110_gym/envs/f110_env.py)."""
        return CommonRoadParams(
            friction=as_parameter(1.0489),
            stiffness=as_parameter([4.718, 5.4562]),
            axle_distances=as_parameter([0.15875, 0.17145]),
            height=as_parameter(0.074),
            mass=as_parameter(3.74),
            yaw_inertia=as_parameter(0.04712),
            steer=as_parameter([-0.4189, 0.4189]),
            steer_rate=as_parameter([-3.2, 3.2]),
            speed=as_parameter([-5.0, 20.0]),
            switch_speed=as_parameter(7.319),
            acc_max=as_parameter(9.51),
        )


class CommonRoadState(NamedTuple):
    """State of ``commonroad_single_track``, in the gym's order; or its derivative. Leading axes (...)."""

    pos: Array
    """Position, world frame, m. (..., 2)"""
    steer: Array
    """Steering angle, rad. (..., 1)"""
    speed: Array
    """Speed, m/s. (..., 1)"""
    yaw: Array
    """Heading, rad. (..., 1)"""
    yaw_rate: Array
    """Rate of the heading, rad/s. (..., 1)"""
    slip: Array
    """Angle from the heading to the velocity, rad. (..., 1)"""


def commonroad_single_track(state: CommonRoadState, command: Array, params: CommonRoadParams) -> CommonRoadState:
    """Return the time derivative of the state by the equations of the F1TENTH gym.

    Althoff, Koschi and Manzinger, "CommonRoad: Composable Benchmarks for Motion Planning on Roads", 2017, vehicle
    models, single-track model: slip angles and steering angle are small, the speed is prescribed by the acceleration,
    and the loads of the axles shift with the acceleration. Below 0.5 m/s the model is kinematic, with a jump at this
    speed. When the vehicle drives backwards, its slip forces increase the slip; the forces of ``single_track`` do not.

    Args:
        command: Rate of the steering angle, rad/s, and acceleration, m/s^2. (..., 2)
    """
    p, v, d, g = params, state.speed, state.steer, -GRAVITY[2]
    steer_rate = limited_steer_rate(d, command[..., :1], p)
    acc = limited_acceleration(v, command[..., 1:], p)
    front, rear = p.axle_distances[..., :1], p.axle_distances[..., 1:]
    wheelbase = front + rear
    # An axle has the load m (g l -+ a h) / L. Its slip force is friction times stiffness times load times slip angle.
    # Here forces are divided by the mass.
    stiffness_front = p.friction * p.stiffness[..., :1] * (g * rear - acc * p.height) / wheelbase
    stiffness_rear = p.friction * p.stiffness[..., 1:] * (g * front + acc * p.height) / wheelbase
    is_slow = jnp.abs(v) < MAX_KINEMATIC_SPEED
    safe_speed = jnp.where(is_slow, 1.0, v)
    lateral_acc_front = stiffness_front * (d - state.slip - front * state.yaw_rate / safe_speed)
    lateral_acc_rear = stiffness_rear * (rear * state.yaw_rate / safe_speed - state.slip)
    yaw_acc = p.mass / p.yaw_inertia * (front * lateral_acc_front - rear * lateral_acc_rear)
    slip_rate = (lateral_acc_front + lateral_acc_rear) / safe_speed - state.yaw_rate
    tan = jnp.tan(d)
    course = state.yaw + jnp.where(is_slow, 0.0, state.slip)
    return CommonRoadState(
        pos=jnp.concatenate([v * jnp.cos(course), v * jnp.sin(course)], axis=-1),
        steer=steer_rate,
        speed=acc,
        yaw=jnp.where(is_slow, v * tan / wheelbase, state.yaw_rate),
        yaw_rate=jnp.where(is_slow, (acc * tan + v * steer_rate * (1 + tan * tan)) / wheelbase, yaw_acc),
        slip=jnp.where(is_slow, 0.0, slip_rate),
    )


def limited_steer_rate(steer: Array, rate: Array, params: CommonRoadParams) -> Array:
    """Return the rate of the steering angle within its limits, zero at a stop of the angle, rad/s. (..., 1)"""
    p = params
    is_at_limit = ((steer <= p.steer[..., :1]) & (rate <= 0)) | ((steer >= p.steer[..., 1:]) & (rate >= 0))
    return jnp.where(is_at_limit, 0.0, jnp.clip(rate, p.steer_rate[..., :1], p.steer_rate[..., 1:]))


def limited_acceleration(speed: Array, acc: Array, params: CommonRoadParams) -> Array:
    """Return the acceleration within the power of the motor, zero at a limit of the speed, m/s^2. (..., 1)"""
    p = params
    is_fast = speed > p.switch_speed
    acc_limit = jnp.where(is_fast, p.acc_max * p.switch_speed / jnp.where(is_fast, speed, 1.0), p.acc_max)
    is_at_limit = ((speed <= p.speed[..., :1]) & (acc <= 0)) | ((speed >= p.speed[..., 1:]) & (acc >= 0))
    return jnp.where(is_at_limit, 0.0, jnp.clip(acc, -p.acc_max, acc_limit))
