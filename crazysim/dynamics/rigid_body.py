"""Newton and Euler for one rigid body."""

from __future__ import annotations

from jax import Array

from crazysim.rotation import cross, matvec


def linear_acceleration(force: Array, mass: Array, gravity_vec: Array) -> Array:
    """Return the acceleration under a force, world frame, m/s^2 (Newton's second law).

    Args:
        force: Sum of all forces but gravity, world frame, N. (..., 3)
        mass: Mass, kg. (..., 1)
        gravity_vec: Gravitational acceleration, world frame, m/s^2. (..., 3)

    Returns:
        Acceleration of the centre of mass, world frame, m/s^2. (..., 3)
    """
    return force / mass + gravity_vec


def angular_acceleration(torque: Array, ang_vel: Array, J: Array, J_inv: Array) -> Array:
    """Return the angular acceleration under a torque, body frame, rad/s^2 (Euler's equation).

    ``J w' = torque - w x J w``; the second term does no work.

    Args:
        torque: Torque about the centre of mass, body frame, N m. (..., 3)
        ang_vel: Angular velocity, body frame, rad/s. (..., 3)
        J: Inertia about the centre of mass, body frame, kg m^2. (..., 3, 3)
        J_inv: Its inverse, 1/(kg m^2). (..., 3, 3)

    Returns:
        Angular acceleration, body frame, rad/s^2. (..., 3)
    """
    return matvec(J_inv, torque - cross(ang_vel, matvec(J, ang_vel)))
