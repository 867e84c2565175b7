"""Minimum-derivative trajectories as a pure function of JAX, with gradients."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.trajectories import interpolation
from crazysim.trajectories.trajectory import Trajectory


def smoothest(waypoints: Array, durations: Array, order: int = 4) -> tuple[Trajectory, Array]:
    """Return the trajectory through waypoints with the smallest integral of a squared derivative, and this integral.

    The trajectory equals ``minimum_snap`` for order 4 and ``minimum_jerk`` for order 3, at rest at both ends and free
    elsewhere, without corridors and with zero yaw. It has gradients with respect to waypoints and durations, and works
    in ``jax.jit`` and ``jax.vmap``. Nothing is checked. In float32, up to about ten pieces whose durations vary by less
    than a factor of five are accurate to 1e-3 of the distances; use float64 for more.

    Args:
        waypoints: Positions, world frame, m. (n, 3)
        durations: Time from each waypoint to the next, s. (n - 1,)
        order: Derivative whose square is minimised: 2, 3 or 4.

    Returns:
        The trajectory, and the integral, m^2 / s^(2 order - 1). ()
    """
    n_pieces, k = len(durations), order
    dtype = jnp.result_type(waypoints, durations, float)
    waypoints, durations = jnp.asarray(waypoints, dtype), jnp.asarray(durations, dtype)
    unit = jnp.mean(durations)
    lengths = (durations / unit)[:, None]
    powers = jnp.concatenate([lengths**j for j in range(k)] * 2, axis=-1)  # (n_pieces, 2k)
    scaled = (
        jnp.asarray(interpolation.unit_cost(k), dtype)
        * powers[:, :, None]
        * powers[:, None]
        * (lengths ** (1 - 2 * k))[..., None]
    )
    at = k * np.arange(n_pieces)[:, None] + np.arange(2 * k)
    size = k * (n_pieces + 1)
    matrix = jnp.zeros((size, size), dtype).at[at[:, :, None], at[:, None, :]].add(scaled)

    position, inner = np.arange(0, size, k), np.setdiff1d(np.arange(k, size - k), np.arange(0, size, k))
    values = jnp.zeros((size, 3), dtype).at[position].set(waypoints)
    block = matrix[inner[:, None], inner]
    weight = 1 / jnp.sqrt(jnp.diagonal(block))[:, None]  # to a diagonal of ones
    right = -matrix[inner[:, None], position] @ waypoints
    values = values.at[inner].set(weight * jnp.linalg.solve(weight * block * weight.T, weight * right))

    ends = values[at]  # (n_pieces, 2k, 3)
    cost = jnp.sum(ends * jnp.einsum("pij,pja->pia", scaled, ends)) * unit ** (1 - 2 * k)
    paths = jnp.einsum("cj,pj,pja->pac", jnp.asarray(interpolation.hermite_basis(k), dtype), powers, ends)
    coefficients = jnp.concatenate([paths, jnp.zeros_like(paths[:, :1])], axis=1)
    return Trajectory(jnp.cumsum(durations), coefficients, jnp.zeros((), bool)), cost
