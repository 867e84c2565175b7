"""Aerodynamic drag."""

from __future__ import annotations

from jax import Array

from crazysim.rotation import matvec, rotate, rotate_inverse


def drag_force(quat: Array, vel: Array, drag_matrix: Array) -> Array:
    """Return the linear drag of body and rotors, ``R D R^T v``, on the centre of mass, world frame, N. (..., 3)

    Args:
        quat: Attitude, body to world, unit, xyzw. (..., 4)
        vel: Velocity, world frame, m/s. (..., 3)
        drag_matrix: Drag coefficients D in the body frame, N s/m. (..., 3, 3)
    """
    return rotate(quat, body_drag_force(quat, vel, drag_matrix))


def body_drag_force(quat: Array, vel: Array, drag_matrix: Array) -> Array:
    """Return the linear drag of body and rotors, ``D R^T v``, on the centre of mass, body frame, N. (..., 3)

    Blade flapping and induced drag grow with the speed and are fixed to the body (Faessler et al. 2018, eq. 2). With
    D negative semidefinite the drag only dissipates.

    Args:
        quat: Attitude, body to world, unit, xyzw. (..., 4)
        vel: Velocity, world frame, m/s. (..., 3)
        drag_matrix: Drag coefficients D in the body frame, N s/m. (..., 3, 3)
    """
    return matvec(drag_matrix, rotate_inverse(quat, vel))
