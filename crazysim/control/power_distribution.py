"""Power distribution of the Crazyflie firmware, from thrust and torque to the PWM of each motor."""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from crazysim.control.levels import allocation_matrix, count_rotors, mask_rotors
from crazysim.drones import Airframe
from crazysim.dynamics.models import AirframeParams
from crazysim.dynamics.rotor import quadratic_curve, rotor_vel_of_thrust
from crazysim.engine.pytree import leaf
from crazysim.rotation import clip, matvec


class PowerDistributionParams(AirframeParams):
    """Parameters of the power distribution, each shared or one per drone."""

    pwm_max: Array = leaf("parameter", 1, (1,), airframe="controller.pwm_max")
    """Maximum PWM of a motor, PWM. (1,)"""
    thrust_max: Array = leaf("parameter", 1, (1,), airframe="rotors.thrust_max")
    """Thrust of one rotor at maximum PWM, N. (1,)"""
    rpm2thrust: Array = leaf("parameter", 2, airframe="rotors.thrust_curve")
    """Coefficients of the thrust curve that the controller assumes, N, N/rpm, N/rpm^2. (1, 3)"""
    torque_allocation: Array = leaf("parameter", 2, airframe=lambda airframe: torque_allocation(airframe))
    """Matrix from torque commands to PWM of the rotors, with the firmware's factor 1/2 for roll and pitch, 1.
    (n_rotors, 3)"""
    torque_of_pwm: Array = leaf("parameter", 2, airframe=lambda airframe: np.linalg.pinv(torque_allocation(airframe)))
    """Matrix from PWM of the rotors to torque commands: pseudoinverse of ``torque_allocation``, 1. (3, n_rotors)"""
    rotors: Array | None = leaf("parameter", 1, default=None)
    """True for the rotors that the drone has; None if all drones have the same number of rotors. (n_rotors,)"""


def torque_allocation(airframe: Airframe) -> np.ndarray:
    """Return the matrix from roll, pitch and yaw torque commands to PWM of the rotors. (n_rotors, 3)

    The firmware adds roll/2, pitch/2 and yaw with each rotor's sign: twice, twice and four times the least-norm
    allocation of a quadrotor in X. Other layouts get the same factors.
    """
    # Rounded, because ``truncate`` would amplify the rounding errors of the pseudoinverse.
    return np.round(allocation_matrix(airframe)[:, 1:] * [2.0, 2.0, 4.0], 12)


def distribute_power(
    thrust: Array, torque: Array, *, params: PowerDistributionParams, whole_numbers: bool = False
) -> Array:
    """Distribute a thrust and a torque over the motors; return the PWM of each. (..., n_rotors)

    If a motor would exceed its maximum, all motors are lowered by the largest excess, which keeps the torque at the
    expense of thrust. Then negative PWM is raised to zero, the firmware's default idle thrust. A thrust of zero or less
    switches the motors off. Source: ``powerDistributionLegacy`` and ``powerDistributionCap`` in
    power_distribution_quadrotor.c of bitcraze/crazyflie-firmware, commit 2a18fc29.

    The firmware truncates three numbers to integers: the torque, half of the roll and pitch torque, and the PWM.
    Without truncation, the PWM differs by less than 4, or by less than 5 where a motor is at its maximum.

    Args:
        thrust: Thrust of each motor, PWM. (..., 1)
        torque: Torque about the body axes, PWM. (..., 3)
        params: Parameters, shared or with the leading axes of the command.
        whole_numbers: Whether to truncate to integers where the firmware does; the gradient ignores the truncation.
    """
    p = params
    if whole_numbers:
        shares = truncate(p.torque_allocation * truncate(torque)[..., None, :])
        pwm = truncate(thrust + jnp.sum(shares, axis=-1))
    else:
        pwm = thrust + matvec(p.torque_allocation, torque)
    # The gradient of jnp.max divides by the number of equal elements, which is zero if XLA rounds a copy differently.
    max_pwm = functools.reduce(jnp.maximum, [pwm[..., i : i + 1] for i in range(pwm.shape[-1])])
    excess = max_pwm - p.pwm_max
    pwm = pwm - jnp.where(excess > 0, excess, 0.0)
    return jnp.where(thrust <= 0, 0.0, jnp.where(pwm < 0, 0.0, pwm))


def truncate(x: Array) -> Array:
    """Return numbers truncated toward zero, as a conversion to integers in C does; the gradient is one. (...)"""
    return x + lax.stop_gradient(jnp.trunc(x) - x)


def rotor_vel_of_pwm(pwm: Array, *, params: PowerDistributionParams) -> Array:
    """Return the rotor speeds for the PWM of the motors, rpm; zero for zero PWM. (..., n_rotors)

    The thrust is proportional to the PWM, as with the firmware's battery compensation.

    Args:
        pwm: PWM of each motor. (..., n_rotors)
        params: Parameters, shared or with the leading axes of the command.
    """
    p = params
    rotor_vel = rotor_vel_of_thrust(clip(pwm, 0.0, p.pwm_max) * (p.thrust_max / p.pwm_max), p.rpm2thrust)
    return jnp.where(pwm <= 0, 0.0, rotor_vel)


def pwm_of_thrust(thrust: Array, *, params: PowerDistributionParams) -> Array:
    """Return the PWM of each motor at which all motors together give a collective thrust in N. (..., 1)"""
    p = params
    n_rotors = count_rotors(p.rotors, p.torque_allocation.shape[-2])
    return thrust * (p.pwm_max / (n_rotors * p.thrust_max))


def command_of_rotor_vel(rotor_vel: Array, *, params: PowerDistributionParams) -> tuple[Array, Array]:
    """Return the thrust of each motor (..., 1) and the torque (..., 3), both in PWM, that give rotor speeds.

    Args:
        rotor_vel: Rotor speeds, rpm. (..., n_rotors)
        params: Parameters, shared or with the leading axes of the rotor speeds.
    """
    p = params
    pwm = jnp.where(rotor_vel > 0, quadratic_curve(rotor_vel, p.rpm2thrust), 0.0) * (p.pwm_max / p.thrust_max)
    if p.rotors is None:
        return jnp.mean(pwm, axis=-1, keepdims=True), matvec(p.torque_of_pwm, pwm)
    pwm = mask_rotors(p.rotors, pwm, 0.0)
    return jnp.sum(pwm, axis=-1, keepdims=True) / count_rotors(p.rotors, 0), matvec(p.torque_of_pwm, pwm)
