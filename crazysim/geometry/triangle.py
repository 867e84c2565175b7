"""The point of a triangle that is nearest to the origin."""

from __future__ import annotations

import jax.numpy as jnp

from crazysim.geometry.vector import Vector, margin, select

THIN = 1e-10
"""Square of the sine below which a triangle has no normal: what float32 leaves of it is rounding."""


def foot(a: Vector, b: Vector, c: Vector) -> Vector:
    """Return the point of a triangle nearest to the origin."""
    return _nearer(segment_foot(b, c - b), open_foot(a, b, c))


def open_foot(a: Vector, b: Vector, c: Vector) -> Vector:
    """Return the point of a triangle nearest to the origin, unless it is on the side from ``b`` to ``c``.

    It is a mean of the corners with positive weights, so that rounding never leaves the triangle.
    """
    ab, ac = b - a, c - a
    on_side = _nearer(segment_foot(a, ac), segment_foot(a, ab))
    normal = ab.cross(ac)
    u, v, w = normal.dot(b.cross(c)), normal.dot(c.cross(a)), normal.dot(a.cross(b))
    inside = (u > 0) & (v > 0) & (w > 0) & (normal.dot(normal) > THIN * ab.dot(ab) * ac.dot(ac))
    within = (a * u + b * v + c * w) * (1 / jnp.where(inside, u + v + w, 1.0))
    return select(inside, within, on_side)


def segment_foot(a: Vector, side: Vector) -> Vector:
    """Return the point of the segment from ``a`` to ``a + side`` that is nearest to the origin."""
    square = side.dot(side)
    t = -a.dot(side) / jnp.where(square > 0, square, 1.0)
    return a + side * jnp.clip(t, 0.0, 1.0)


def _nearer(new: Vector, old: Vector) -> Vector:
    """Return which of two points is nearer to the origin; of two that tie, the old."""
    square = old.dot(old)
    return select(new.dot(new) < square * (1 - margin(square.dtype)), new, old)
