"""Signed distances from a point to shapes of all kinds except for height fields, negative inside.

Formulas are in components, with selections instead of branches. Most take a few dozen scalar operations for a point,
and an ellipsoid takes a few hundred; for a mesh, their number grows with its planes and triangles. Where the gradient
jumps, the gradient of one side is returned.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from crazysim.engine.jaxcompat import fori_loop
from crazysim.geometry.shapes import Shape
from crazysim.geometry.triangle import closest_point, from_barycentric
from crazysim.geometry.vector import Vector, to_vector
from crazysim.rotation import clip, safe_sqrt

ELLIPSOID_STEPS = 12
"""Newton steps for the nearest point of an ellipsoid. The error is 3e-6 of its size for a ratio of semi-axes of 1,000,
and rounding for a ratio of 10."""


Components = tuple[Array, Array, Array]
"""The three components of vectors. (...) each"""


def components(x: Array) -> Components:
    """Return the three components of vectors. (...) each"""
    return x[..., 0], x[..., 1], x[..., 2]


def maximum(a: Array | float, b: Array | float) -> Array:
    """Return the larger of two values, with the gradient of one of them even where they are equal. (...)"""
    return jnp.where(a > b, a, b)


def magnitude(x: Array) -> Array:
    """Return ``|x|``, with gradient one at zero. (...)"""
    return jnp.where(x < 0, -x, x)


def _plane(_: Shape, point: Array) -> Array:
    return point[..., 2]


def _sphere(shape: Shape, point: Array) -> Array:
    x, y, z = components(point)
    return safe_sqrt(x * x + y * y + z * z) - shape.size[0]


def _capsule(shape: Shape, point: Array) -> Array:
    radius, half = shape.size
    x, y, z = components(point)
    outside_z = z - clip(z, -half, half)
    return safe_sqrt(x * x + y * y + outside_z * outside_z) - radius


def _box(shape: Shape, point: Array) -> Array:
    return box_distance(shape.size, components(point))


def box_distance(half: tuple[float, ...], point: tuple[Array, Array, Array]) -> Array:
    """Return the signed distance from a point, 3 components of (...), to a box of given half lengths, m. (...)"""
    x, y, z = (magnitude(p) - h for p, h in zip(point, half, strict=True))
    face_distance = maximum(maximum(x, y), z)
    x, y, z = maximum(x, 0.0), maximum(y, 0.0), maximum(z, 0.0)
    return jnp.where(face_distance > 0, safe_sqrt(x * x + y * y + z * z), face_distance)


def _cylinder(shape: Shape, point: Array) -> Array:
    radius, half = shape.size
    x, y, z = components(point)
    side, cap = safe_sqrt(x * x + y * y) - radius, magnitude(z) - half
    surface_distance = maximum(side, cap)
    side, cap = maximum(side, 0.0), maximum(cap, 0.0)
    return jnp.where(surface_distance > 0, safe_sqrt(side * side + cap * cap), surface_distance)


def _ellipsoid(shape: Shape, point: Array) -> Array:
    # For the point p and the semi-axes a it is ``(n.p - |a n|) / |n|``. It is stationary in the normal n, so an error
    # of n changes it only in second order.
    normal = ellipsoid_normal(shape, components(point))
    projection = sum(n * p for n, p in zip(normal, components(point), strict=True))
    support = jnp.sqrt(sum((a * n) ** 2 for a, n in zip(shape.size, normal, strict=True)))
    return (projection - support) / jnp.sqrt(sum(n * n for n in normal))


def ellipsoid_normal(shape: Shape, point: Components) -> Components:
    """Return the normal, not normalised, of an ellipsoid at its point nearest to a point. (...) each

    The nearest point to p has the normal w_i = p_i / (t + a_i^2), where t solves |a w| = 1 (Eberly 2013, Distance from
    a Point to an Ellipse, an Ellipsoid, or a Hyperellipsoid). 1 / |a w| is concave in t, so Newton's steps from below
    never pass the root (Conn, Gould and Toint 2000, section 7.3.3).

    The unknown is s = t + min(a)^2, which keeps its precision where the point is near the centre.
    """
    semi_axes = np.asarray(shape.size)
    square_gaps = (semi_axes**2 - semi_axes.min() ** 2).tolist()
    # A point on a plane of symmetry may have two nearest points. Every point is therefore moved away from these planes,
    # by twice the machine epsilon times the semi-axis.
    displacements = (2 * float(jnp.finfo(point[0].dtype).eps) * semi_axes).tolist()
    displaced_point = [p + jnp.where(p < 0, -e, e) for p, e in zip(point, displacements, strict=True)]
    scaled_point = [a * p for a, p in zip(shape.size, displaced_point, strict=True)]

    def newton_step(s: Array, scaled_point: list[Array]) -> Array:
        inverses = [1 / (s + gap) for gap in square_gaps]
        terms = [(x * i) ** 2 for x, i in zip(scaled_point, inverses, strict=True)]
        square = sum(terms)
        slope = sum(term * i for term, i in zip(terms, inverses, strict=True))
        return s + square * (jnp.sqrt(square) - 1) / slope

    constant_point = [lax.stop_gradient(x) for x in scaled_point]
    start = constant_point[0] * 0
    for x, gap in zip(constant_point, square_gaps, strict=True):
        start = maximum(start, jnp.abs(x) - gap)
    s = fori_loop(ELLIPSOID_STEPS - 1, lambda _, s: newton_step(s, constant_point), start)
    s = newton_step(s, scaled_point)  # the last step carries the derivative of the root
    x, y, z = (p / (s + gap) for p, gap in zip(displaced_point, square_gaps, strict=True))
    return x, y, z


def _mesh(shape: Shape, point: Array) -> Array:
    position = to_vector(point)
    signed_distance = plane_distance(shape.array("normals"), shape.array("offsets"), position)
    triangles = shape.array("vertices")[shape.array("faces")]
    corners = [Vector(*jnp.asarray(triangles[:, k].T, point.dtype)) for k in range(3)]
    return jnp.where(signed_distance > 0, triangles_distance(position, *corners), signed_distance)


def plane_distance(normals: np.ndarray, offsets: np.ndarray, point: Vector) -> Array:
    """Return the largest signed distance from a point to planes, m. (...)

    The plane is selected first and its distance computed afterwards, because the gradient of the maximum, in a step
    under ``vmap``, lacked a component with XLA for CPUs in JAX 0.10.1.
    """
    constant_point = lax.stop_gradient(point)
    columns = [jnp.asarray(column, point.x.dtype) for column in (*normals.T, offsets)]
    x, y, z, offset = columns
    heights = (
        x * constant_point.x[..., None] + y * constant_point.y[..., None] + z * constant_point.z[..., None] - offset
    )
    is_highest = jnp.arange(len(offsets)) == jnp.argmax(heights, axis=-1)[..., None]
    x, y, z, offset = (jnp.sum(jnp.where(is_highest, column, 0.0), axis=-1) for column in columns)
    return x * point.x + y * point.y + z * point.z - offset


def triangles_distance(point: Vector, a: Vector, b: Vector, c: Vector) -> Array:
    """Return the distance from a point to the nearest triangle, m. (...)

    Args:
        point: Point. (...)
        a: First corners. (..., n_triangles) or (n_triangles,)
        b: Second corners.
        c: Third corners.
    """
    constant_point = lax.stop_gradient(point)
    constant_point = Vector(constant_point.x[..., None], constant_point.y[..., None], constant_point.z[..., None])
    a, b, c = a - constant_point, b - constant_point, c - constant_point
    nearest_points = from_barycentric(closest_point(a, b, c), a, b, c)
    squares = nearest_points.dot(nearest_points)
    nearest = lax.argmin(squares, squares.ndim - 1, np.int32)
    is_nearest = jnp.arange(squares.shape[-1], dtype=np.int32) == nearest[..., None]
    nearest_points = Vector(
        *(
            jnp.sum(jnp.where(is_nearest, v, 0.0), axis=-1)
            for v in (nearest_points.x, nearest_points.y, nearest_points.z)
        )
    )
    offset = point - lax.stop_gradient(point) - nearest_points
    return safe_sqrt(offset.dot(offset))


POINT_DISTANCE = {
    "plane": _plane,
    "sphere": _sphere,
    "capsule": _capsule,
    "box": _box,
    "cylinder": _cylinder,
    "ellipsoid": _ellipsoid,
    "mesh": _mesh,
}
"""Function ``(shape, point) -> distance`` of each kind of shape."""
