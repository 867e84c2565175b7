"""Vectors as three components, each an array of any shape.

Without an axis of length three, all arithmetic is element-wise: a compiler can fuse it, and cannot reorder the short
sums over components.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax

from crazysim.engine.pytree import PyTree


class Vector(PyTree):
    """Vector as three components."""

    x: Array
    """Component along x. (...)"""
    y: Array
    """Component along y. (...)"""
    z: Array
    """Component along z. (...)"""

    def __add__(self, other: Vector) -> Vector:
        return Vector(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: Vector) -> Vector:
        return Vector(self.x - other.x, self.y - other.y, self.z - other.z)

    def __neg__(self) -> Vector:
        return Vector(-self.x, -self.y, -self.z)

    def __mul__(self, factor: Array | float) -> Vector:
        return Vector(self.x * factor, self.y * factor, self.z * factor)

    def __getitem__(self, k: int) -> Vector:
        return Vector(self.x[k], self.y[k], self.z[k])

    def dot(self, other: Vector) -> Array:
        """Return the scalar product. (...)"""
        return self.x * other.x + self.y * other.y + self.z * other.z

    def cross(self, other: Vector) -> Vector:
        """Return the vector product."""
        return Vector(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )


def to_vector(x: Array) -> Vector:
    return Vector(x[..., 0], x[..., 1], x[..., 2])


def stack_vectors(vectors: list[Vector]) -> Vector:
    return Vector(*(jnp.stack(xs) for xs in zip(*((v.x, v.y, v.z) for v in vectors), strict=True)))


def axis_vector(axis: int, array: Array) -> Vector:
    """Return the unit vector along a coordinate axis, 0 to 2, with the batch shape of an array. (...)"""
    zero = jnp.zeros_like(array)
    return Vector(*(zero + 1 if k == axis else zero for k in range(3)))


def select_vector(condition: Array, a: Vector, b: Vector) -> Vector:
    return Vector(*(jnp.where(condition, p, q) for p, q in ((a.x, b.x), (a.y, b.y), (a.z, b.z))))


def normalize(v: Vector, fallback: Vector, min_square: float = 0.0) -> Vector:
    """Return a vector scaled to unit length, or ``fallback`` where its squared length is at most ``min_square``."""
    square = v.dot(v)
    is_long = square > min_square
    return select_vector(is_long, v * lax.rsqrt(jnp.where(is_long, square, 1.0)), fallback)


def rounding_margin(dtype: jnp.dtype) -> float:
    """Return the relative margin by which a number must exceed another to be treated as larger despite rounding.

    A compiler may recompute a comparison for each component of a selected vector with different rounding, and so mix
    the components of two vectors that tie.
    """
    return 1e-5 if dtype == jnp.float32 else 1e-12
