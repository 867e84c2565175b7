"""Small systems of linear equations, unrolled, and products of small matrices."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array


def solve_symmetric(matrix: Array, b: Array) -> Array:
    """Solve ``matrix x = b`` for a symmetric positive definite matrix, unrolled. (..., n)

    The matrix is first scaled to a unit diagonal, because mass and moments of inertia differ by four orders of
    magnitude.
    """
    n = b.shape[-1]
    scale = [jax.lax.rsqrt(matrix[..., k, k]) for k in range(n)]
    a = [[matrix[..., i, j] * scale[i] * scale[j] for j in range(i + 1)] for i in range(n)]
    y = [b[..., k] * scale[k] for k in range(n)]
    lower: list[list[Array]] = []
    for i in range(n):
        lower.append([])
        for j in range(i):
            lower[i].append((a[i][j] - sum(lower[i][k] * lower[j][k] for k in range(j))) / lower[j][j])
        lower[i].append(jnp.sqrt(a[i][i] - sum(lower[i][k] ** 2 for k in range(i))))
    for i in range(n):
        y[i] = (y[i] - sum(lower[i][k] * y[k] for k in range(i))) / lower[i][i]
    for i in reversed(range(n)):
        y[i] = (y[i] - sum(lower[k][i] * y[k] for k in range(i + 1, n))) / lower[i][i]
    return jnp.stack([y[k] * scale[k] for k in range(n)], axis=-1)


def matvec(matrix: Array, vector: Array) -> Array:
    """Return ``matrix @ vector`` in three operations, which compile faster than the unrolled form.

    On a GPU, a matrix product may be rounded to 10 bits; sums of products have full precision there.

    Args:
        matrix: (..., m, n)
        vector: (..., n)

    Returns:
        (..., m)
    """
    return jnp.sum(matrix * vector[..., None, :], axis=-1)


def matmul(a: Array, b: Array) -> Array:
    """Return ``a @ b`` as a sum of products, as in ``matvec``. (..., m, k)"""
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)
