"""Support functions and support points of convex shapes.

The support point of a shape along a direction is its point farthest in that direction. The support function is the
coordinate of that point along the direction.

A support point is selected by the sign of a number that is often zero up to rounding, for example where two sides are
parallel. A compiler that computes such a number twice with different rounding would mix two corners into a point
outside the shape. Within a small angle of a tie the support point is therefore interpolated between the two.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array, lax

from crazysim.geometry.shapes import Shape
from crazysim.geometry.vector import Vector


def sharpness(dtype: jnp.dtype) -> float:
    """Return the inverse of the angle, 1/rad, within which support points are interpolated between two corners."""
    return 1e3 if dtype == jnp.float32 else 1e7


def segment_support_point(half: float, direction: Array) -> Array:
    """Return the support point as a coordinate along a segment, m, for the direction's component along it. (...)"""
    return half * jnp.clip(direction * sharpness(direction.dtype), -1.0, 1.0)


def support_function(shape: Shape, n: Vector) -> Array:
    """Return the support function of a shape along a unit direction, m. (...)"""
    return SUPPORT_FUNCTION[shape.kind](shape, n)


def support_point(shape: Shape, n: Vector) -> Vector:
    """Return the support point of a shape along a direction, m; interpolated near a tie."""
    return SUPPORT_POINT[shape.kind](shape, n)


def _box_function(shape: Shape, n: Vector) -> Array:
    a, b, c = shape.size
    return a * jnp.abs(n.x) + b * jnp.abs(n.y) + c * jnp.abs(n.z)


def _box_point(shape: Shape, n: Vector) -> Vector:
    a, b, c = shape.size
    return Vector(segment_support_point(a, n.x), segment_support_point(b, n.y), segment_support_point(c, n.z))


def _cylinder_function(shape: Shape, n: Vector) -> Array:
    radius, half = shape.size
    square = n.x * n.x + n.y * n.y
    return radius * jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0) + half * jnp.abs(n.z)


def _cylinder_point(shape: Shape, n: Vector) -> Vector:
    radius, half = shape.size
    square = n.x * n.x + n.y * n.y
    tie_square = 1 / sharpness(square.dtype) ** 2
    scale = radius * lax.rsqrt(jnp.where(square > tie_square, square, tie_square))
    return Vector(n.x * scale, n.y * scale, segment_support_point(half, n.z))


def _ellipsoid_function(shape: Shape, n: Vector) -> Array:
    a, b, c = shape.size
    return jnp.sqrt((a * n.x) ** 2 + (b * n.y) ** 2 + (c * n.z) ** 2)


def _ellipsoid_point(shape: Shape, n: Vector) -> Vector:
    a, b, c = shape.size
    scale = 1 / _ellipsoid_function(shape, n)
    return Vector(a * a * scale * n.x, b * b * scale * n.y, c * c * scale * n.z)


def _mesh_products(shape: Shape, n: Vector) -> tuple[Array, list[Array]]:
    x, y, z = (jnp.asarray(column, n.x.dtype) for column in shape.array("vertices").T)
    return x * n.x[..., None] + y * n.y[..., None] + z * n.z[..., None], [x, y, z]


def _mesh_function(shape: Shape, n: Vector) -> Array:
    return jnp.max(_mesh_products(shape, n)[0], axis=-1)


def _mesh_point(shape: Shape, n: Vector) -> Vector:
    products, columns = _mesh_products(shape, n)
    gaps = jnp.max(products, axis=-1, keepdims=True) - products
    weight = jnp.clip(1 - gaps * (sharpness(gaps.dtype) / float(abs(shape.array("vertices")).max())), 0.0, 1.0)
    scale = 1 / jnp.sum(weight, axis=-1)
    return Vector(*(jnp.sum(weight * v, axis=-1) * scale for v in columns))


SUPPORT_FUNCTION: dict[str, Callable[[Shape, Vector], Array]] = {
    "box": _box_function,
    "cylinder": _cylinder_function,
    "ellipsoid": _ellipsoid_function,
    "mesh": _mesh_function,
}
"""Function ``(shape, unit direction) -> support function`` of each kind of shape."""
SUPPORT_POINT: dict[str, Callable[[Shape, Vector], Vector]] = {
    "box": _box_point,
    "cylinder": _cylinder_point,
    "ellipsoid": _ellipsoid_point,
    "mesh": _mesh_point,
}
"""Function ``(shape, direction) -> support point`` of each kind of shape."""
