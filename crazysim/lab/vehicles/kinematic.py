"""Dynamics of a vehicle whose wheels roll without slip: the kinematic bicycle."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax

from crazysim.lab.vehicles.car_params import CarParams
from crazysim.lab.vehicles.car_state import CarState
from crazysim.lab.vehicles.single_track import drive_force, state_rates, steer_rate

RETURN_RATE = 50.0
"""Rate at which velocities that are incompatible with rolling wheels decay, 1/s."""


def kinematic(state: CarState, command: Array, params: CarParams, wrench: Array | None = None) -> CarState:
    """Return the time derivative of the state of a vehicle that rolls without slip.

    The yaw rate is ``w = v_x tan(d) / L`` and the velocity of the centre of mass to the left ``l_r w`` (Rajamani,
    "Vehicle Dynamics and Control", 2012, section 2.2). The drive, limited by the grip, and the external force
    accelerate the vehicle along its axis. The wheels balance all forces across the axis.

    Args:
        command: Motor reference, 1, and steering angle, rad. (..., 2)
        wrench: External force forwards and to the left, N, and torque about the vertical axis, N m, body frame; None
            for no external wrench. (..., 3)
    """
    p, speed, wheelbase = params, state.body_vel[..., :1], params.front + params.rear
    drive, grip = drive_force(command[..., :1], speed, p), p.grip[..., :1] + p.grip[..., 1:]
    force = drive * lax.rsqrt(1 + drive * drive / (grip * grip))
    if wrench is not None:
        force = force + wrench[..., :1]
    forward_acc = force / p.mass
    tan, steer_vel = jnp.tan(state.steer), steer_rate(state, command, p)
    yaw_rate = speed * tan / wheelbase
    yaw_acc = (forward_acc * tan + speed * steer_vel * (1 + tan * tan)) / wheelbase
    lateral_acc = p.rear * yaw_acc + RETURN_RATE * (p.rear * yaw_rate - state.body_vel[..., 1:])
    acc = jnp.concatenate([forward_acc, lateral_acc], axis=-1)
    return state_rates(state, acc, yaw_acc + RETURN_RATE * (yaw_rate - state.yaw_rate), steer_vel, p)
