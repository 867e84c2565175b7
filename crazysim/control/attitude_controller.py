"""Inner loop of Crazyflow's cascade, from a command of attitude or body rates, with thrust, to a wrench."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.control.allocation import torque_arms
from crazysim.control.gains import Gains
from crazysim.control.levels import allocation_matrix, count_rotors, mask_rotors
from crazysim.engine.pytree import leaf
from crazysim.rotation import matvec


class AttitudeParams(Gains, controller="crazyflow", needs=("controller.thrust2torque",)):
    """Gains and parameters of the attitude and body-rate controllers, each shared or one per drone."""

    kR: Array = leaf("parameter", 1, (3,), airframe="controller.attitude.kR")
    """Gain on the rotation error, PWM. (3,)"""
    kw: Array = leaf("parameter", 1, (3,), airframe="controller.attitude.kw")
    """Gain on the error of the body rates, PWM s/rad. (3,)"""
    ki_m: Array = leaf("parameter", 1, (3,), airframe="controller.attitude.ki_m")
    """Gain on the integral of the negative rotation error, PWM/(rad s). (3,)"""
    kd_omega: Array = leaf("parameter", 1, (3,), airframe="controller.attitude.kd_omega")
    """Gain on the derivative of the error of the body rates, PWM s^2/rad. (3,)"""
    int_err_max: Array = leaf("parameter", 1, (3,), airframe="controller.attitude.int_err_max")
    """Limit of the integral of the rotation error, rad s. (3,)"""
    torque_pwm_max: Array = leaf("parameter", 1, (3,), airframe="controller.torque_pwm_max")
    """Limit of the torque command, PWM. (3,)"""
    thrust_max: Array = leaf("parameter", 1, (1,), airframe="rotors.thrust_max")
    """Maximum thrust of one rotor, N. (1,)"""
    pwm_min: Array = leaf("parameter", 1, (1,), airframe="controller.pwm_min")
    """Minimum PWM of a rotor that is on. (1,)"""
    pwm_max: Array = leaf("parameter", 1, (1,), airframe="controller.pwm_max")
    """Maximum PWM. (1,)"""
    torque_arms: Array = leaf("parameter", 1, (3,), airframe=torque_arms)
    """Torque per thrust about x and y (arm) and z (drag torque over thrust), m. (3,)"""
    mixing_matrix: Array = leaf("parameter", 2, airframe=lambda airframe: airframe.mixing_matrix)
    """Matrix from rotor thrusts to torque divided by ``torque_arms``, 1. (3, n_rotors)"""
    # The firmware adds roll/2, pitch/2 and yaw with each rotor's sign: twice, twice and four times the least-norm
    # allocation of a quadrotor in X. Other layouts get the same factors.
    torque_allocation: Array = leaf("parameter", 2, airframe=lambda x: allocation_matrix(x)[:, 1:] * [2.0, 2.0, 4.0])
    """Matrix from torque commands to PWM of the rotors, with the firmware's factor 1/2 for roll and pitch, 1.
    (n_rotors, 3)"""
    rotors: Array | None = leaf("parameter", 1, default=None)
    """True for the rotors that the drone has; None if all drones have the same number of rotors. (n_rotors,)"""


def attitude2force_torque(
    quat: Array,
    ang_vel: Array,
    cmd: Array,
    ang_vel_des: Array,
    prev_ang_vel: Array,
    prev_ang_vel_des: Array,
    r_int_error: Array,
    ctrl_freq: float,
    *,
    params: AttitudeParams,
) -> tuple[Array, Array]:
    """Rotate the drone to an attitude; return the wrench and the new integral.

    This is the attitude part of the controller of Mellinger and Kumar (2011, eq. 10 to 13) as in the Crazyflie
    firmware: without the factor one half on the rotation error, with a derivative of the rate error, and in PWM units.
    Each torque and then each rotor is clipped independently, whereas the firmware lowers all rotors by the largest
    excess. A thrust of zero or less switches the motors off.

    Args:
        quat: Attitude, body to world, unit, xyzw. (..., 4)
        ang_vel: Angular velocity, body frame, rad/s. (..., 3)
        cmd: Desired roll, pitch, yaw, rad, and collective thrust, N. (..., 4)
        ang_vel_des: Desired body rates, rad/s. (..., 3)
        prev_ang_vel: Angular velocity at the previous tick, rad/s. (..., 3)
        prev_ang_vel_des: Desired body rates at the previous tick, rad/s. (..., 3)
        r_int_error: Integral of the negative rotation error, rad s. (..., 3)
        ctrl_freq: Rate of this controller, Hz.
        params: Gains, shared or with the leading axes of the state.

    Returns:
        Collective thrust, N, and body torque, N m (..., 4); the new integral, rad s (..., 3).
    """
    p = params
    quat_des = rotation.from_rpy(cmd[..., :3])
    # Rotation error on SO(3), and its derivative and integral.
    quat_error = rotation.multiply(rotation.conjugate(quat_des), quat)
    rotation_error = 4 * quat_error[..., 3:] * quat_error[..., :3]  # vee(Rd^T R - R^T Rd)
    rate_error_dot = ((ang_vel_des - prev_ang_vel_des) - (ang_vel - prev_ang_vel)) * ctrl_freq
    r_int_error = rotation.clip(r_int_error - rotation_error / ctrl_freq, -p.int_err_max, p.int_err_max)
    torque_pwm = -p.kR * rotation_error + p.kw * (ang_vel_des - ang_vel) + p.ki_m * r_int_error
    # The firmware has no derivative about yaw.
    torque_pwm = torque_pwm + p.kd_omega * rate_error_dot * jnp.asarray([1.0, 1.0, 0.0], quat.dtype)
    torque_pwm = rotation.clip(torque_pwm, -p.torque_pwm_max, p.torque_pwm_max)

    # Shares of the motors in PWM, within their limits.
    thrust = cmd[..., 3:4]
    n_rotors = count_rotors(p.rotors, p.mixing_matrix.shape[-1])
    newton_per_pwm = p.thrust_max / p.pwm_max
    pwm = thrust / (n_rotors * newton_per_pwm) + matvec(p.torque_allocation, torque_pwm)
    thrusts = rotation.clip(pwm, p.pwm_min, p.pwm_max) * jnp.where(thrust <= 0, 0.0, newton_per_pwm)
    thrusts = mask_rotors(p.rotors, thrusts, 0.0)
    torque = p.torque_arms * matvec(p.mixing_matrix, thrusts)
    return jnp.concatenate([jnp.sum(thrusts, axis=-1, keepdims=True), torque], axis=-1), r_int_error


def body_rate2force_torque(
    quat: Array,
    ang_vel: Array,
    cmd: Array,
    prev_ang_vel: Array,
    prev_cmd: Array,
    r_int_error: Array,
    ctrl_freq: float,
    *,
    params: AttitudeParams,
) -> tuple[Array, Array]:
    """Follow body rates; return the wrench and the new integral.

    As in Crazyflow, the attitude controller follows the rates and also levels the drone at its current yaw.
    ``Sim(controller="pid")`` follows rates only, as the firmware's rate mode does. This function also follows rates
    only if ``kR`` and ``ki_m`` are zero.

    Args:
        quat: Attitude, body to world, unit, xyzw. (..., 4)
        ang_vel: Angular velocity, body frame, rad/s. (..., 3)
        cmd: Desired body rates, rad/s, and collective thrust, N. (..., 4)
        prev_ang_vel: Angular velocity at the previous tick, rad/s. (..., 3)
        prev_cmd: Command of the previous tick. (..., 4)
        r_int_error: Integral of the negative rotation error, rad s. (..., 3)
        ctrl_freq: Rate of this controller, Hz.
        params: Gains, shared or with the leading axes of the state.

    Returns:
        Collective thrust, N, and body torque, N m (..., 4); the new integral, rad s (..., 3).
    """
    yaw = rotation.yaw(quat)[..., None]
    level_cmd = jnp.concatenate([jnp.zeros_like(ang_vel[..., :2]), yaw, cmd[..., 3:4]], axis=-1)
    return attitude2force_torque(
        quat,
        ang_vel,
        level_cmd,
        cmd[..., :3],
        prev_ang_vel,
        prev_cmd[..., :3],
        r_int_error,
        ctrl_freq,
        params=params,
    )
