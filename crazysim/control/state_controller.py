"""Outer loop of Crazyflow's cascade, from a full-state setpoint to attitude and collective thrust."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.control.gains import Gains
from crazysim.drones import Airframe
from crazysim.dynamics.models import GRAVITY
from crazysim.engine.pytree import leaf


def _thrust_scale(airframe: Airframe) -> ArrayLike:
    pwm_per_newton = airframe.value("controller.mass_thrust", ())
    max_thrust = airframe.n_rotors * airframe.value("rotors.thrust_max", ())
    return pwm_per_newton * (max_thrust / airframe.value("controller.pwm_max", ()))


class StateParams(
    Gains, controller="crazyflow", needs=("controller.mass_thrust", "controller.pwm_max", "rotors.thrust_max")
):
    """Gains and parameters of the state controller, each shared or one per drone."""

    mass: Array = leaf("parameter", 1, (1,), airframe="controller.mass")
    """Mass that the controller assumes, kg. (1,)"""
    kp: Array = leaf("parameter", 1, (3,), airframe="controller.state.kp")
    """Gain on the position error, N/m. (3,)"""
    kd: Array = leaf("parameter", 1, (3,), airframe="controller.state.kd")
    """Gain on the velocity error, N s/m. (3,)"""
    ki: Array = leaf("parameter", 1, (3,), airframe="controller.state.ki")
    """Gain on the integral of the position error, N/(m s). (3,)"""
    gravity_vec: Array = leaf("parameter", 1, (3,), airframe=lambda _: GRAVITY)
    """Gravitational acceleration that the controller assumes, world frame, m/s^2. (3,)"""
    thrust_scale: Array = leaf("parameter", 1, (1,), airframe=_thrust_scale)
    """Actual over desired thrust, 1. It is not 1, because the firmware's mass_thrust does not match its mass. (1,)"""
    int_err_max: Array = leaf("parameter", 1, (3,), airframe="controller.state.int_err_max")
    """Limit of the integral of the position error, m s. (3,)"""


def state2attitude(
    pos: Array,
    quat: Array,
    vel: Array,
    cmd: Array,
    pos_err_i: Array,
    ctrl_freq: float,
    *,
    params: StateParams,
) -> tuple[Array, Array]:
    """Track a full-state setpoint; return attitude and thrust, and the new integral.

    This is the position part of the controller of Mellinger and Kumar (2011, eq. 6 to 9) as in the Crazyflie firmware.
    A force follows from position error, velocity error and the integral of the position error. The body z axis is along
    that force, and the x axis is closest to the desired yaw. A zero quaternion in the setpoint means zero yaw.

    Args:
        pos: Position, world frame, m. (..., 3)
        quat: Attitude, body to world, unit, xyzw. (..., 4)
        vel: Velocity, world frame, m/s. (..., 3)
        cmd: Setpoint: position, velocity, acceleration, quaternion, body rates (not used here). (..., 16)
        pos_err_i: Integral of the position error, m s. (..., 3)
        ctrl_freq: Rate of this controller, Hz.
        params: Gains, shared or with the leading axes of the state.

    Returns:
        Roll, pitch, yaw, rad, and collective thrust, N (..., 4); the new integral, m s (..., 3).
    """
    p = params
    # PID loop of the position, with gravity and the desired acceleration.
    pos_err, vel_err = cmd[..., 0:3] - pos, cmd[..., 3:6] - vel
    pos_err_i = rotation.clip(pos_err_i + pos_err / ctrl_freq, -p.int_err_max, p.int_err_max)
    force = p.mass * (cmd[..., 6:9] - p.gravity_vec) + p.kp * pos_err + p.kd * vel_err + p.ki * pos_err_i

    # Attitude with z along the force and x towards the heading.
    forward, left = rotation.heading(cmd[..., 9:13])
    rpy = rotation.rpy_from_axes(*rotation.axes_from_z(force, forward, left))

    # Only the part of the force along the present z axis.
    thrust = p.thrust_scale * rotation.dot(force, rotation.z_axis(quat))
    return jnp.concatenate([rpy, thrust], axis=-1), pos_err_i
