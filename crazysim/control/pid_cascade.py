"""Loops of the Crazyflie firmware's PID cascade, as pure functions: position, velocity, attitude and body rates."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.control.gains import Gains
from crazysim.control.pid_loop import PIDLoop, PIDLoopMemory, pid_step
from crazysim.control.power_distribution import PowerDistributionParams
from crazysim.dynamics.models import part
from crazysim.engine.pytree import PyTree, leaf
from crazysim.rotation import clip

THRUST_SCALE = 1000.0
"""PWM per unit of the vertical velocity loop's output (``thrustScale``)."""
TORQUE_MAX = 32767.0
"""Limit of the outputs of the rate loops, PWM (``saturateSignedInt16``)."""

LOOPS = ("position", "velocity", "attitude", "rate")
"""Names of the loops: fields of parameters and memory, and tables ``[pid.position]`` and so on."""


class PIDParams(
    Gains, controller="pid", needs=tuple(f"pid.{loop}.{key}" for loop in LOOPS for key in ("kp", "ki", "kd"))
):
    """Gains and limits of the cascade, each shared or one per drone. Angles are in degrees, as in the firmware.

    The heading frame has x along the yaw, y to the left and z up (``to_heading_frame``).
    """

    position: PIDLoop
    """Position loop in the heading frame: position error, m, to desired velocity, m/s."""
    velocity: PIDLoop
    """Velocity loop in the heading frame: velocity error, m/s, to pitch, degrees, negative roll, degrees, and thrust in
    units of 1000 PWM."""
    attitude: PIDLoop
    """Attitude loop: error of roll, pitch and yaw, degrees, to desired body rates, degrees/s."""
    rate: PIDLoop
    """Rate loop: error of the body rates, degrees/s, to torque, PWM."""
    tilt_max: Array = leaf("parameter", 1, (2,), airframe="pid.tilt_max")
    """Limits of the desired roll and pitch, degrees. (2,)"""
    thrust_base: Array = leaf("parameter", 1, (1,), airframe="pid.thrust_base")
    """Thrust to which the output of the velocity loop is added, roughly the hover thrust, PWM. (1,)"""
    thrust_min: Array = leaf("parameter", 1, (1,), airframe="pid.thrust_min")
    """Minimum thrust of the velocity loop, PWM. (1,)"""
    motors: PowerDistributionParams = part(PowerDistributionParams)
    """Power distribution."""


class PIDMemory(PyTree):
    """Memory of the cascade."""

    position: PIDLoopMemory
    """Memory of the position loop."""
    velocity: PIDLoopMemory
    """Memory of the velocity loop."""
    attitude: PIDLoopMemory
    """Memory of the attitude loop."""
    rate: PIDLoopMemory
    """Memory of the rate loop."""
    rpy_des: Array = leaf("drone", 1, (3,))
    """Desired roll, pitch, yaw, degrees. (n_worlds, n_drones, 3)"""
    thrust: Array = leaf("drone", 1, (1,))
    """Desired thrust, PWM. (n_worlds, n_drones, 1)"""
    started: Array = leaf("drone", 1, (1,))
    """True after the first tick. (n_worlds, n_drones, 1)"""


def desired_velocity(
    pos: Array, heading: Array, pos_des: Array, memory: PIDLoopMemory, freq: float, *, loop: PIDLoop
) -> tuple[Array, PIDLoopMemory]:
    """Return the desired velocity in the heading frame, and the new memory of the position loop.

    Args:
        pos: Position, world frame, m. (..., 3)
        heading: Cosine and sine of the yaw. (..., 2)
        pos_des: Desired position, world frame, m. (..., 3)
        freq: Rate of this loop, Hz.

    Returns:
        Desired velocity, heading frame, m/s (..., 3); new memory.
    """
    error = to_heading_frame(heading, pos_des - pos)
    return pid_step(error, to_heading_frame(heading, pos), memory, freq, loop=loop)


def desired_attitude(
    vel: Array, heading: Array, vel_des: Array, memory: PIDLoopMemory, freq: float, *, params: PIDParams
) -> tuple[Array, Array, PIDLoopMemory]:
    """Return the desired roll and pitch, the thrust, and the new memory of the velocity loop.

    Args:
        vel: Velocity, world frame, m/s. (..., 3)
        heading: Cosine and sine of the yaw. (..., 2)
        vel_des: Desired velocity, heading frame, m/s. (..., 3)
        freq: Rate of this loop, Hz.

    Returns:
        Desired roll and pitch, degrees (..., 2); thrust of each motor, PWM (..., 1); new memory.
    """
    p, measured = params, to_heading_frame(heading, vel)
    output, memory = pid_step(vel_des - measured, measured, memory, freq, loop=p.velocity)
    tilt = jnp.stack([-output[..., 1], output[..., 0]], axis=-1)
    thrust = clip(THRUST_SCALE * output[..., 2:] + p.thrust_base, p.thrust_min, p.motors.pwm_max)
    return clip(tilt, -p.tilt_max, p.tilt_max), thrust, memory


def desired_rates(
    rpy: Array, rpy_des: Array, memory: PIDLoopMemory, freq: float, *, loop: PIDLoop
) -> tuple[Array, PIDLoopMemory]:
    """Return the desired body rates, degrees/s (..., 3), and the new memory of the attitude loop.

    As in the firmware, the loop uses Euler angles.

    Args:
        rpy: Roll, pitch, yaw, degrees. (..., 3)
        rpy_des: Desired roll, pitch, yaw, degrees. (..., 3)
        freq: Rate of this loop, Hz.
    """
    return pid_step(rpy_des - rpy, rpy, memory, freq, loop=loop, is_angle=(False, False, True))


def desired_torque(
    ang_vel: Array, ang_vel_des: Array, memory: PIDLoopMemory, freq: float, *, loop: PIDLoop
) -> tuple[Array, PIDLoopMemory]:
    """Return the torque that tracks the desired body rates, PWM (..., 3), and the new memory of the rate loop.

    Args:
        ang_vel: Angular velocity, body frame, degrees/s. (..., 3)
        ang_vel_des: Desired angular velocity, body frame, degrees/s. (..., 3)
        freq: Rate of this loop, Hz.
    """
    torque, memory = pid_step(ang_vel_des - ang_vel, ang_vel, memory, freq, loop=loop)
    return clip(torque, -TORQUE_MAX, TORQUE_MAX), memory


def to_heading_frame(heading: Array, vector: Array) -> Array:
    """Return the components of a world vector along the heading, to the left of it, and up. (..., 3)

    Args:
        heading: Cosine and sine of the yaw. (..., 2)
        vector: Vector, world frame. (..., 3)
    """
    cos, sin, x, y = heading[..., 0], heading[..., 1], vector[..., 0], vector[..., 1]
    return jnp.stack([x * cos + y * sin, y * cos - x * sin, vector[..., 2]], axis=-1)


def heading_vector(quat: Array) -> Array:
    """Return cosine and sine of the yaw of an attitude; (1, 0) where the body x axis is vertical. (..., 2)"""
    x, y, z, w = quat[..., 0], quat[..., 1], quat[..., 2], quat[..., 3]
    projection = jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z)], axis=-1)
    return rotation.safe_normalize(projection, jnp.asarray([1.0, 0.0], quat.dtype))


def wrap_degrees(angle: Array) -> Array:
    """Return angles wrapped to the range from -180 to 180 degrees. (...)"""
    return angle - 360.0 * jnp.round(angle / 360.0)
