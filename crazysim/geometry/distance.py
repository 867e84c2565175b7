"""Signed distances: of a point to a shape, and of a drone's shape to another; negative inside.

A drone's shape has a core, which is a point, a segment or a box, and the radius that is put around it. What has a
closed form is here; the rest is the work of ``convex``.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim.errors import ConfigError
from crazysim.geometry.heightfield import drone_to_field, field_distance
from crazysim.geometry.overlap import convex_distance
from crazysim.geometry.points import POINT_DISTANCE, components, magnitude
from crazysim.geometry.segments import segment_to_box, segment_to_segment
from crazysim.geometry.shapes import Shape

DRONE_KINDS = ("sphere", "capsule", "box")
"""Kinds that a drone's shape may have."""


def point_distance(shape: Shape, point: Array) -> Array:
    """Return the signed distance of a point to the surface of a shape, m, negative inside. (...)

    Exact for plane, sphere, capsule, box and cylinder (Ericson 2005, section 5.1) and for a mesh; for an ellipsoid by
    Newton steps, of which there are enough; for a height field up to the side of a cell, see ``field_distance``.

    Args:
        shape: The shape.
        point: Points in the frame of the shape, m. (..., 3)
    """
    if shape.kind == "hfield":
        return field_distance(shape, jnp.asarray(point))
    return POINT_DISTANCE[shape.kind](shape, jnp.asarray(point))


def distance(a: Shape, b: Shape, pos: Array, rot: Array) -> Array:
    """Return the signed distance of two shapes, m: of their nearest points, or minus how deep they overlap. (...)

    The depth is the length of the shortest translation that parts them. Exact for spheres, and for capsules and boxes
    with a plane, sphere, capsule or, a capsule, with a box; for the rest see ``convex_distance`` and, for height
    fields, ``drone_to_field``. First derivatives are those of the nearest points; in second ones, of what is no
    sphere, these points stay where they are on their shapes.

    Args:
        a: The drone's shape: a sphere, a capsule or a box.
        b: The other shape, of any kind.
        pos: Position of the centre of ``a`` in the frame of ``b``, m. (..., 3)
        rot: Rotation matrix from the frame of ``a`` to that of ``b``. (..., 3, 3)

    Raises:
        ConfigError: If ``a`` is of another kind.
    """
    if a.kind not in DRONE_KINDS:
        raise ConfigError(f"the distance of a {a.kind} as a drone's shape; it may be a {', '.join(DRONE_KINDS)}")
    pos, rot = jnp.asarray(pos), jnp.asarray(rot)
    if b.kind == "hfield" and a.kind == "sphere":
        return field_distance(b, pos, a.size[0]) - a.size[0]
    if b.kind == "hfield":
        half, radius = ((0.0, 0.0, a.size[1]), a.size[0]) if a.kind == "capsule" else (a.size, 0.0)
        return drone_to_field(half, b, pos, rot) - radius
    if a.kind == "sphere":
        return point_distance(b, pos) - a.size[0]
    if b.kind == "plane":
        return pos[..., 2] - _reach(a, rot[..., 2, :])
    if b.kind == "sphere":
        return point_distance(a, _inverse(pos, rot)) - b.size[0]
    if a.kind == "capsule" and b.kind == "capsule":
        between = segment_to_segment(components(pos), components(rot[..., 2]), a.size[1], b.size[1])
        return between - a.size[0] - b.size[0]
    if a.kind == "capsule" and b.kind == "box":
        return segment_to_box(components(pos), components(rot[..., 2]), a.size[1], b.size) - a.size[0]
    if a.kind == "box" and b.kind == "capsule":
        middle, axis = components(_inverse(pos, rot)), components(rot[..., 2, :])
        return segment_to_box(middle, axis, b.size[1], a.size) - b.size[0]
    return convex_distance(a, b, pos, rot) - (a.size[0] if a.kind == "capsule" else 0.0)


def _inverse(pos: Array, rot: Array) -> Array:
    """Return the origin of the other frame in the frame that is at ``pos`` and turned by ``rot``. (..., 3)"""
    x, y, z = components(pos)
    return -jnp.stack([rot[..., 0, k] * x + rot[..., 1, k] * y + rot[..., 2, k] * z for k in range(3)], axis=-1)


def _reach(shape: Shape, direction: Array) -> Array:
    """Return how far a capsule or a box reaches along a unit direction in its own frame, m. (...)"""
    x, y, z = (magnitude(d) for d in components(direction))
    if shape.kind == "capsule":
        return shape.size[1] * z + shape.size[0]
    return shape.size[0] * x + shape.size[1] * y + shape.size[2] * z
