"""Products of small matrices."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array


def matvec(matrix: Array, vector: Array) -> Array:
    """Return ``matrix @ vector`` in three operations, which compile faster than the unrolled form. (..., m)

    On a GPU, a matrix product may be rounded to 10 bits; sums of products have full precision there.

    Args:
        matrix: (..., m, n)
        vector: (..., n)
    """
    return jnp.sum(matrix * vector[..., None, :], axis=-1)


def matmul(a: Array, b: Array) -> Array:
    """Return ``a @ b`` as a sum of products, as in ``matvec``. (..., m, k)"""
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)
