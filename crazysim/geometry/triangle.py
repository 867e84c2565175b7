"""Point of a triangle nearest to the origin, in barycentric coordinates."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim.geometry.vector import Vector, rounding_margin

MIN_SQUARED_SINE = 1e-10
"""Square of the sine below which the normal of a triangle is rounding error in float32."""


Barycentric = tuple[Array, Array, Array]
"""Barycentric coordinates of a point of a triangle; they add up to one. (...) each"""


def from_barycentric(weights: Barycentric, a: Vector, b: Vector, c: Vector) -> Vector:
    u, v, w = weights
    return a * u + b * v + c * w


def closest_point(a: Vector, b: Vector, c: Vector) -> Barycentric:
    """Return the barycentric coordinates of the point of a triangle nearest to the origin."""
    t = _nearest_on_segment(b, c - b)
    point_on_bc, point_off_bc = (jnp.zeros_like(t), 1 - t, t), closest_point_off_bc(a, b, c)
    return _nearer_point(point_on_bc, point_off_bc, a, b, c)


def closest_point_off_bc(a: Vector, b: Vector, c: Vector) -> Barycentric:
    """Return the same as ``closest_point``, but without the side from ``b`` to ``c`` as a candidate."""
    ab, ac = b - a, c - a
    s, t = _nearest_on_segment(a, ab), _nearest_on_segment(a, ac)
    point_on_side = _nearer_point((1 - t, jnp.zeros_like(t), t), (1 - s, s, jnp.zeros_like(s)), a, b, c)
    normal = ab.cross(ac)
    u, v, w = normal.dot(b.cross(c)), normal.dot(c.cross(a)), normal.dot(a.cross(b))
    is_inside = (u > 0) & (v > 0) & (w > 0) & (normal.dot(normal) > MIN_SQUARED_SINE * ab.dot(ab) * ac.dot(ac))
    scale = 1 / jnp.where(is_inside, u + v + w, 1.0)
    return _choose(is_inside, (u * scale, v * scale, w * scale), point_on_side)


def _nearest_on_segment(a: Vector, side: Vector) -> Array:
    square = side.dot(side)
    return jnp.clip(-a.dot(side) / jnp.where(square > 0, square, 1.0), 0.0, 1.0)


def _nearer_point(candidate: Barycentric, current: Barycentric, a: Vector, b: Vector, c: Vector) -> Barycentric:
    p, q = from_barycentric(candidate, a, b, c), from_barycentric(current, a, b, c)
    square = q.dot(q)
    return _choose(p.dot(p) < square * (1 - rounding_margin(square.dtype)), candidate, current)


def _choose(condition: Array, candidate: Barycentric, current: Barycentric) -> Barycentric:
    u, v, w = (jnp.where(condition, x, y) for x, y in zip(candidate, current, strict=True))
    return u, v, w
