"""Ray casting against shapes, for depth cameras and range finders: distance to the first hit, and the normal there."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
from jax import Array

from crazysim.geometry.fieldrays import MIN_COMPONENT, field_ray
from crazysim.geometry.points import Components, components
from crazysim.geometry.shapes import Shape
from crazysim.rotation import clip, safe_normalize, safe_sqrt

Interval = tuple[Array, Array, Array]
"""Distances along a line at which it enters and leaves a convex shape, and True if it meets the shape. (...) each"""


@dataclasses.dataclass(frozen=True)
class SizedShapes:
    """Primitives of one kind with arrays as sizes, as in a loop over many objects."""

    kind: str
    """Kind of the shapes; a kind that ``Shape`` describes by its size only."""
    size: Sequence[Array]
    """Size in the convention of the kind, m. (...) each"""


def ray_distance(shape: Shape, origin: Array, direction: Array) -> tuple[Array, Array]:
    """Cast rays at a shape; return the distance to its surface, and its outward normal at the hit.

    The conventions follow MuJoCo's ``mj_ray``: a ray from inside a solid hits the surface where it leaves, and
    the normal still points outward; a plane or rectangle is hit only from above; a height field is also hit at z = 0,
    where the box below its surface ends.

    Args:
        origin: Origin of each ray, in the frame of the shape, m. (..., 3)
        direction: Unit direction of each ray, in the frame of the shape. (..., 3)

    Returns:
        Distance along the ray, m, infinite where it misses. (...)
        Unit normal in the frame of the shape, zero where it misses. (..., 3)
    """
    origin, direction = jnp.broadcast_arrays(origin, direction)
    if shape.kind == "hfield":
        return field_ray(shape, origin, direction)
    t = hit_distance(shape, components(origin), components(direction))
    return t, hit_normal(shape, origin, direction, t)


def hit_distance(shape: Shape | SizedShapes, origin: Components, direction: Components) -> Array:
    """Return the distance along rays to the surface of a shape, m, infinite where they miss. (...)

    For the conventions see ``ray_distance``. With rays in components, a loop over many objects is element-wise
    arithmetic, which compilers fuse and vectorise.

    Args:
        shape: Shape, or shapes of one kind; not a height field.
        origin: Components of the origins of rays, in the frame of the shape, m. (...) each
        direction: Components of the unit directions of rays, in the frame of the shape. (...) each
    """
    if shape.kind not in ("plane", "rectangle"):
        return first_distance(LINE_INTERVALS[shape.kind](shape, origin, direction))
    t, is_hit = _plane_distance(origin, direction)
    for o, d, half in zip(origin, direction, shape.size, strict=False):
        is_hit &= jnp.abs(o + t * d) <= half
    return first_distance((t, t, is_hit))


def hit_normal(shape: Shape | SizedShapes, origin: Array, direction: Array, distance: Array) -> Array:
    """Return the outward unit normal where rays hit a shape, in its frame, zero where they miss. (..., 3)

    Args:
        shape: Shape, or shapes of one kind; not a height field.
        origin: Origin of each ray, in the frame of the shape, m. (..., 3)
        direction: Unit direction of each ray, in the frame of the shape. (..., 3)
        distance: Distance along each ray, m, infinite where it misses. (...)
    """
    is_hit = jnp.isfinite(distance)
    t = jnp.where(is_hit, distance, 0.0)
    normal = SURFACE_NORMALS[shape.kind](shape, origin + t[..., None] * direction)
    return jnp.where(is_hit[..., None], normal, 0.0)


def _plane_distance(origin: Components, direction: Components) -> tuple[Array, Array]:
    height, descent_rate = origin[2], -direction[2]
    is_hit = (descent_rate > MIN_COMPONENT) & (height >= 0)
    return height / jnp.where(is_hit, descent_rate, 1.0), is_hit


def slab_interval(origin: Array, direction: Array, half: Array | float) -> Interval:
    """Return the interval of a line between two parallel planes at ``-half`` and ``half``.

    ``origin`` and ``direction`` are the components of the line along the normal of the planes. (...) each
    """
    is_parallel = jnp.abs(direction) < MIN_COMPONENT
    inverse = 1 / jnp.where(is_parallel, MIN_COMPONENT, direction)
    a, b = (-half - origin) * inverse, (half - origin) * inverse
    return jnp.where(a < b, a, b), jnp.where(a < b, b, a), ~is_parallel | (jnp.abs(origin) <= half)


def intersection(p: Interval, q: Interval) -> Interval:
    near, far = jnp.where(p[0] > q[0], p[0], q[0]), jnp.where(p[1] < q[1], p[1], q[1])
    return near, far, p[2] & q[2] & (near <= far)


def union(p: Interval, q: Interval) -> Interval:
    """Return the interval of a line in the union of two shapes that is convex along the line."""
    near = jnp.where(p[2] & (~q[2] | (p[0] < q[0])), p[0], q[0])
    far = jnp.where(p[2] & (~q[2] | (p[1] > q[1])), p[1], q[1])
    return near, far, p[2] | q[2]


def _ball_interval(origin: Sequence[Array], direction: Sequence[Array], radius: Array | float) -> Interval:
    # It uses the point of the line nearest to the centre, because the usual discriminant loses its precision far from
    # the ball.
    square = sum(d * d for d in direction)
    is_parallel = square < MIN_COMPONENT
    inverse = 1 / jnp.where(is_parallel, 1.0, square)
    middle = -sum(o * d for o, d in zip(origin, direction, strict=True)) * inverse
    closest_point = [o + middle * d for o, d in zip(origin, direction, strict=True)]
    squared_half_chord = radius * radius - sum(c * c for c in closest_point)
    half_chord = safe_sqrt(squared_half_chord * inverse)
    is_outside = sum(o * o for o in origin) > radius * radius
    half_chord = jnp.where(is_parallel, 1 / MIN_COMPONENT, half_chord)
    return middle - half_chord, middle + half_chord, jnp.where(is_parallel, ~is_outside, squared_half_chord >= 0)


def _sphere_interval(shape: Shape | SizedShapes, origin: Components, direction: Components) -> Interval:
    return _ball_interval(origin, direction, shape.size[0])


def _capsule_interval(shape: Shape | SizedShapes, origin: Components, direction: Components) -> Interval:
    radius, half = shape.size
    (x, y, z), d = origin, direction
    interval = intersection(_ball_interval([x, y], d[:2], radius), slab_interval(z, d[2], half))
    for end in (-half, half):
        interval = union(interval, _ball_interval([x, y, z - end], d, radius))
    return interval


def _box_interval(shape: Shape | SizedShapes, origin: Components, direction: Components) -> Interval:
    x, y, z = (slab_interval(o, d, h) for o, d, h in zip(origin, direction, shape.size, strict=True))
    return intersection(intersection(x, y), z)


def _cylinder_interval(shape: Shape | SizedShapes, origin: Components, direction: Components) -> Interval:
    radius, half = shape.size
    (x, y, z), (u, v, w) = origin, direction
    return intersection(_ball_interval([x, y], [u, v], radius), slab_interval(z, w, half))


def _ellipsoid_interval(shape: Shape | SizedShapes, origin: Components, direction: Components) -> Interval:
    scaled_origin, scaled_direction = ([x / a for x, a in zip(v, shape.size, strict=True)] for v in (origin, direction))
    return _ball_interval(scaled_origin, scaled_direction, 1.0)


def _plane_products(shape: Shape, v: Components) -> Array:
    x, y, z = (
        jnp.asarray(column, v[0].dtype) * part[..., None]
        for column, part in zip(shape.array("normals").T, v, strict=True)
    )
    return x + y + z


def _mesh_interval(shape: Shape, origin: Components, direction: Components) -> Interval:
    depths = jnp.asarray(shape.offsets, origin[0].dtype) - _plane_products(shape, origin)
    rates = _plane_products(shape, direction)
    is_parallel = jnp.abs(rates) < MIN_COMPONENT
    t = depths / jnp.where(is_parallel, 1.0, rates)
    near = jnp.max(jnp.where(~is_parallel & (rates < 0), t, -jnp.inf), axis=-1)
    far = jnp.min(jnp.where(~is_parallel & (rates > 0), t, jnp.inf), axis=-1)
    return near, far, (near <= far) & ~jnp.any(is_parallel & (depths < 0), axis=-1)


def first_distance(interval: Interval) -> Array:
    """Return the distance at which a ray first meets the surface of a shape, from the interval of its line. (...)

    The distance is infinite where the ray misses. A ray from inside meets the surface where it leaves the shape.
    """
    near, far, is_crossing = interval
    is_hit = is_crossing & (far >= 0)
    # A miss must not contribute NaN, in gradients either.
    return jnp.where(is_hit, jnp.where(is_hit, jnp.where(near >= 0, near, far), 0.0), jnp.inf)


LINE_INTERVALS = {
    "sphere": _sphere_interval,
    "capsule": _capsule_interval,
    "box": _box_interval,
    "cylinder": _cylinder_interval,
    "ellipsoid": _ellipsoid_interval,
    "mesh": _mesh_interval,
}
"""Function ``(shape, origin, direction) -> interval`` of each kind of convex shape."""


# Normals of surface points -------------------------------------------------------------------------------------------


def _z_axis(vector: Array) -> Array:
    zero = jnp.zeros_like(vector[..., 0])
    return jnp.stack([zero, zero, zero + 1], axis=-1)


def _plane_normal(_: Shape | SizedShapes, point: Array) -> Array:
    return _z_axis(point)


def _sphere_normal(_: Shape | SizedShapes, point: Array) -> Array:
    return safe_normalize(point, _z_axis(point))


def _capsule_normal(shape: Shape | SizedShapes, point: Array) -> Array:
    x, y, z = components(point)
    half = shape.size[1]
    return safe_normalize(jnp.stack([x, y, z - clip(z, -half, half)], axis=-1), _z_axis(point))


def _box_normal(shape: Shape | SizedShapes, point: Array) -> Array:
    x, y, z = (jnp.abs(p) - h for p, h in zip(components(point), shape.size, strict=True))
    is_x_side = (x >= y) & (x >= z)
    is_y_side = ~is_x_side & (y >= z)
    sides = jnp.stack([is_x_side, is_y_side, ~is_x_side & ~is_y_side], axis=-1)
    return jnp.where(sides, jnp.where(point < 0, -1.0, 1.0), 0.0)


def _cylinder_normal(shape: Shape | SizedShapes, point: Array) -> Array:
    radius, half = shape.size
    x, y, z = components(point)
    zero = jnp.zeros_like(z)
    rho = safe_sqrt(x * x + y * y)
    is_side = rho - radius > jnp.abs(z) - half
    safe_rho = jnp.where(is_side, rho, 1.0)
    side = jnp.stack([x / safe_rho, y / safe_rho, zero], axis=-1)
    cap = jnp.stack([zero, zero, jnp.where(z < 0, -1.0, 1.0)], axis=-1)
    return jnp.where(is_side[..., None], side, cap)


def _ellipsoid_normal(shape: Shape | SizedShapes, point: Array) -> Array:
    gradient = [x / (a * a) for x, a in zip(components(point), shape.size, strict=True)]
    return safe_normalize(jnp.stack(gradient, axis=-1), _z_axis(point))


def _mesh_normal(shape: Shape, point: Array) -> Array:
    heights = _plane_products(shape, components(point)) - jnp.asarray(shape.offsets, point.dtype)
    return jnp.take(jnp.asarray(shape.array("normals"), point.dtype), jnp.argmax(heights, axis=-1), axis=0)


SURFACE_NORMALS = {
    "plane": _plane_normal,
    "rectangle": _plane_normal,
    "sphere": _sphere_normal,
    "capsule": _capsule_normal,
    "box": _box_normal,
    "cylinder": _cylinder_normal,
    "ellipsoid": _ellipsoid_normal,
    "mesh": _mesh_normal,
}
"""Function ``(shape, point) -> normal`` of each kind of shape, for points of the surface."""
