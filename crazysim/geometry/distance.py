"""Signed distances, negative inside: from a point to a shape, and from the shape of a drone to another shape.

The shape of a drone has a core, which is a point, a segment or a box, and a radius around it. This module has the
closed forms; ``overlap.convex_distance`` computes the distances of all other pairs.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim.errors import require
from crazysim.geometry.heightfield import drone_to_field, field_distance
from crazysim.geometry.overlap import convex_distance
from crazysim.geometry.points import POINT_DISTANCE, components, magnitude
from crazysim.geometry.segments import segment_to_box, segment_to_segment
from crazysim.geometry.shapes import Shape

DRONE_KINDS = ("sphere", "capsule", "box")
"""Kinds that the shape of a drone may have."""


def point_distance(shape: Shape, point: Array) -> Array:
    """Measure the signed distance from a point to the surface of a shape, m, negative inside. (...)

    Exact for plane, sphere, capsule, box, cylinder (Ericson 2005, section 5.1) and mesh. For an ellipsoid it is solved
    by Newton's method; for a height field see ``field_distance``.

    Args:
        point: Points in the frame of the shape, m. (..., 3)
    """
    _require_solid(shape)
    if shape.kind == "hfield":
        return field_distance(shape, jnp.asarray(point))
    return POINT_DISTANCE[shape.kind](shape, jnp.asarray(point))


def _require_solid(shape: Shape) -> None:
    require(
        shape.kind != "rectangle", "expected a solid, got a rectangle, which is for rays. Use plane, or a thin box."
    )


def distance(a: Shape, b: Shape, pos: Array, rot: Array) -> Array:
    """Measure the signed distance between two shapes: between their nearest points, or minus their overlap, m. (...)

    The overlap is the length of the shortest translation that separates them. For a sphere ``a``, the distance is as
    exact as ``point_distance``. The distance is exact for capsules and boxes against a plane, sphere or capsule, and
    for a capsule against a box, where MuJoCo's overlap is up to half a metre too small. For other pairs see
    ``convex_distance`` and, for height fields, ``drone_to_field``. First derivatives follow the nearest points; second
    derivatives of shapes other than spheres treat the nearest points as fixed on their shapes.

    Args:
        a: Shape of the drone: a sphere, capsule or box.
        b: Other shape, of any kind.
        pos: Position of the centre of ``a`` in the frame of ``b``, m. (..., 3)
        rot: Rotation matrix from the frame of ``a`` to the frame of ``b``. (..., 3, 3)
    """
    require(
        a.kind in DRONE_KINDS,
        f"expected a drone shape of kind {', '.join(DRONE_KINDS)}, got {a.kind}; use one of these",
    )
    _require_solid(b)
    pos, rot = jnp.asarray(pos), jnp.asarray(rot)
    if b.kind == "hfield" and a.kind == "sphere":
        return field_distance(b, pos, a.size[0]) - a.size[0]
    if b.kind == "hfield":
        half, radius = ((0.0, 0.0, a.size[1]), a.size[0]) if a.kind == "capsule" else (a.size, 0.0)
        return drone_to_field(half, b, pos, rot) - radius
    if a.kind == "sphere":
        return point_distance(b, pos) - a.size[0]
    if b.kind == "plane":
        return pos[..., 2] - _support_function(a, rot[..., 2, :])
    if b.kind == "sphere":
        return point_distance(a, _inverse_position(pos, rot)) - b.size[0]
    if a.kind == "capsule" and b.kind == "capsule":
        axis_distance = segment_to_segment(components(pos), components(rot[..., 2]), a.size[1], b.size[1])
        return axis_distance - a.size[0] - b.size[0]
    if a.kind == "capsule" and b.kind == "box":
        return segment_to_box(components(pos), components(rot[..., 2]), a.size[1], b.size) - a.size[0]
    if a.kind == "box" and b.kind == "capsule":
        middle, axis = components(_inverse_position(pos, rot)), components(rot[..., 2, :])
        return segment_to_box(middle, axis, b.size[1], a.size) - b.size[0]
    return convex_distance(a, b, pos, rot) - (a.size[0] if a.kind == "capsule" else 0.0)


def _inverse_position(pos: Array, rot: Array) -> Array:
    x, y, z = components(pos)
    return -jnp.stack([rot[..., 0, k] * x + rot[..., 1, k] * y + rot[..., 2, k] * z for k in range(3)], axis=-1)


def _support_function(shape: Shape, direction: Array) -> Array:
    x, y, z = (magnitude(d) for d in components(direction))
    if shape.kind == "capsule":
        return shape.size[1] * z + shape.size[0]
    return shape.size[0] * x + shape.size[1] * y + shape.size[2] * z
