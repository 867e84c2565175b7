"""Air drag."""

from __future__ import annotations

from jax import Array

from crazysim.rotation import matvec, rotate, rotate_inverse


def drag_force(quat: Array, vel: Array, drag_matrix: Array) -> Array:
    """Return the linear drag of body and rotors, world frame, N.

    ``R D R^T v``: blade flapping and induced drag grow with speed and turn with the body (Faessler et al.
    2018, eq. 2). With D negative semidefinite it only dissipates.

    Args:
        quat: Attitude, body to world, unit, xyzw. (..., 4)
        vel: Velocity, world frame, m/s. (..., 3)
        drag_matrix: Drag coefficients D in the body frame, N s/m. (..., 3, 3)

    Returns:
        Force on the centre of mass, world frame, N. (..., 3)
    """
    return rotate(quat, matvec(drag_matrix, rotate_inverse(quat, vel)))
