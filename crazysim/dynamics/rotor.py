"""Rotors: lag, thrust and drag torque curves, and the torques on the body."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jax import Array

from crazysim.rotation import along_z, matvec, safe_sqrt

RPM_TO_RAD_S = 2 * math.pi / 60


def rotor_acceleration(cmd: Array, rotor_vel: Array, rotor_dyn_coef: Array) -> Array:
    """Return the accelerations of the rotors towards their command, rpm/s. (..., n_rotors)

    The acceleration at the speed r is ``a (cmd - r) + b (cmd^2 - r^2)``. A motor's back-EMF gives the linear term, the
    propeller's drag the quadratic one. Spinning up is driven and spinning down is coasting, so each has its own pair
    (a, b).

    Args:
        cmd: Commanded rotor speeds, rpm. (..., n_rotors)
        rotor_vel: Rotor speeds, rpm. (..., n_rotors)
        rotor_dyn_coef: a, b on spin-up, then a, b on spin-down, 1/s and 1/(s rpm). (..., 1 or n_rotors, 4)
    """
    is_spin_up = cmd > rotor_vel
    a = jnp.where(is_spin_up, rotor_dyn_coef[..., 0], rotor_dyn_coef[..., 2])
    b = jnp.where(is_spin_up, rotor_dyn_coef[..., 1], rotor_dyn_coef[..., 3])
    return (cmd - rotor_vel) * (a + b * (cmd + rotor_vel))


def quadratic_curve(rotor_vel: Array, coefficients: Array) -> Array:
    """Evaluate a quadratic curve over the rotor speed: thrust, N, or drag torque, N m. (..., n_rotors)

    Args:
        rotor_vel: Rotor speeds, rpm. (..., n_rotors)
        coefficients: Constant, linear and quadratic term over rpm. (..., 1 or n_rotors, 3)
    """
    k0, k1, k2 = coefficients[..., 0], coefficients[..., 1], coefficients[..., 2]
    return k0 + rotor_vel * (k1 + rotor_vel * k2)


def rotor_torque(thrust: Array, drag_torque: Array, L: Array, mixing_matrix: Array) -> Array:
    """Return the torque of the thrusts' lever arms and the propellers' drag, body frame, N m. (..., 3)

    Args:
        thrust: Thrust of each rotor, N. (..., n_rotors)
        drag_torque: Magnitude of each propeller's drag torque, N m. (..., n_rotors)
        L: Arm that scales the first two rows of the mixing matrix, m. (..., 1 or n_rotors)
        mixing_matrix: Rotor positions over L, and signs of the drag torque. (..., 3, n_rotors)
    """
    positions = mixing_matrix[..., :2, :]
    # One arm scales two sums, which costs less than to scale each thrust.
    roll_pitch_torque = L * matvec(positions, thrust) if L.shape[-1] == 1 else matvec(positions, L * thrust)
    return jnp.concatenate([roll_pitch_torque, matvec(mixing_matrix[..., 2:, :], drag_torque)], axis=-1)


def rotor_momentum(rotor_vel: Array, yaw_torque_sign: Array, prop_inertia: Array) -> Array:
    """Return the angular momentum of the spinning rotors relative to the body, body frame, N m s. (..., 3)

    It points along body z, against the sign of the drag torques.

    Args:
        rotor_vel: Rotor speeds, rpm. (..., n_rotors)
        yaw_torque_sign: Signs of the rotors' drag torques about body z. (..., n_rotors)
        prop_inertia: Inertia of one propeller with its motor, kg m^2. (..., 1 or n_rotors)
    """
    return along_z(jnp.sum(-RPM_TO_RAD_S * yaw_torque_sign * prop_inertia * rotor_vel, axis=-1))


def reaction_torque(rotor_acc: Array, yaw_torque_sign: Array, prop_inertia: Array) -> Array:
    """Return the torque that accelerating rotors exert on the body, ``-dh/dt``, body frame, N m. (..., 3)

    Args:
        rotor_acc: Rotor accelerations, rpm/s. (..., n_rotors)
        yaw_torque_sign: Signs of the rotors' drag torques about body z. (..., n_rotors)
        prop_inertia: Inertia of one propeller with its motor, kg m^2. (..., 1 or n_rotors)
    """
    return -rotor_momentum(rotor_acc, yaw_torque_sign, prop_inertia)


def rotor_vel_of_thrust(thrust: Array, rpm2thrust: Array) -> Array:
    """Solve for the rotor speed that gives a thrust, rpm: the upper root of the thrust curve. (..., n_rotors)

    For a thrust below the minimum of the curve, which has no root, the speed at the minimum is returned.

    Args:
        thrust: Thrust of each rotor, N. (..., n_rotors)
        rpm2thrust: Constant, linear and quadratic term over rpm. (..., 1 or n_rotors, 3)
    """
    return (thrust_slope(thrust, rpm2thrust) - rpm2thrust[..., 1]) / (2 * rpm2thrust[..., 2])


def thrust_slope(thrust: Array, rpm2thrust: Array) -> Array:
    """Return the slope of the thrust curve at the speed with a given thrust, N/rpm; zero below the curve's minimum.

    Args:
        thrust: Thrust of each rotor, N. (..., n_rotors)
        rpm2thrust: Constant, linear and quadratic term over rpm. (..., 1 or n_rotors, 3)

    Returns:
        Slope for each rotor, N/rpm. (..., n_rotors)
    """
    k0, k1, k2 = rpm2thrust[..., 0], rpm2thrust[..., 1], rpm2thrust[..., 2]
    return safe_sqrt(k1 * k1 - 4 * k2 * k0 + 4 * k2 * thrust)
