"""Signed distances: of a point to a shape, and of a drone's shape to another; negative inside.

A drone's shape has a core, which is a point, a segment or a box, and the radius that is put around it. What has a
closed form is here; the rest is the work of ``convex``.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax

from crazysim.errors import ConfigError
from crazysim.geometry.points import POINT_DISTANCE, Vector, components, larger, magnitude
from crazysim.geometry.shapes import Shape
from crazysim.rotation import safe_clip, safe_sqrt

DRONE_KINDS = ("sphere", "capsule", "box")
"""Kinds that a drone's shape may have."""
PARALLEL = 1e-12
"""Square of a sine below which two directions count as parallel."""


def point_distance(shape: Shape, point: Array) -> Array:
    """Return the signed distance of a point to the surface of a shape, m, negative inside. (...)

    Exact for plane, sphere, capsule, box and cylinder (Ericson 2005, section 5.1); for an ellipsoid by Newton steps,
    of which there are enough.

    Args:
        shape: The shape.
        point: Points in the frame of the shape, m. (..., 3)
    """
    return POINT_DISTANCE[shape.kind](shape, jnp.asarray(point))


def distance(a: Shape, b: Shape, pos: Array, rot: Array) -> Array:
    """Return the signed distance of two shapes, m: of their nearest points, or minus how deep they overlap. (...)

    The depth is the length of the shortest translation that parts them. First derivatives are exact where there are
    any; in second ones, of what is no sphere, the nearest points stay where they are on their shapes.

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
    raise NotImplementedError


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


def segment_to_segment(middle: Vector, axis: Vector, half: float, other_half: float) -> Array:
    """Return the distance of a segment to one along z around the origin, m (Ericson 2005, section 5.1.9). (...)

    Of parallel segments any pair of nearest points will do, and of nearly parallel ones nearly any: no digit is lost.

    Args:
        middle: Its middle, m. 3 of (...)
        axis: Its unit direction. 3 of (...)
        half: Its half length, m.
        other_half: Half length of the other, m.
    """
    (cx, cy, cz), (x, y, z) = map(_fixed, (middle, axis))
    across = x * x + y * y
    s = -(cx * x + cy * y) / jnp.where(across > PARALLEL, across, 1.0)
    s = safe_clip(jnp.where(across > PARALLEL, s, 0.0), -half, half)
    t = safe_clip(cz + s * z, -other_half, other_half)
    s = safe_clip(t * z - (cx * x + cy * y + cz * z), -half, half)
    # The nearest points of lines are where a small move of either changes nothing: they may count as fixed.
    x, y, z = (c + s * a for c, a in zip(middle, axis, strict=True))
    return safe_sqrt(x * x + y * y + (z - t) ** 2)


def segment_to_box(middle: Vector, axis: Vector, half: float, box: tuple[float, ...]) -> Array:
    """Return the signed distance of a segment to a box, m. (...)

    Outside, the squared distance of a point that runs along the segment has a slope that rises, in straight pieces
    between the places where it passes a side's plane; the root lies between the last place of negative and the first
    of positive slope. Inside, the shortest way out is along a normal of one of the faces of the two bodies' Minkowski
    difference: the box's own, and those across one of its edges and the segment (Gottschalk 1996).

    Args:
        middle: Middle of the segment in the frame of the box, m. 3 of (...)
        axis: Its unit direction. 3 of (...)
        half: Its half length, m.
        box: Half lengths of the box, m.
    """
    c, u = _fixed(middle), _fixed(axis)

    def slope(t: Array) -> Array:
        at = [p + t * d for p, d in zip(c, u, strict=True)]
        return sum(d * (p - jnp.clip(p, -h, h)) for d, p, h in zip(u, at, box, strict=True))  # type: ignore[return-value]

    low, high = 0 * c[0] - half, 0 * c[0] + half
    low_slope, high_slope = slope(low), slope(high)
    for p, d, h in zip(c, u, box, strict=True):
        crosses = d * d > PARALLEL
        inverse = 1 / jnp.where(crosses, d, 1.0)
        for side in (-h, h):
            t = jnp.where(crosses, jnp.clip((side - p) * inverse, -half, half), 0.0)
            here = slope(t)
            falls, rises = (here <= 0) & (t > low), (here >= 0) & (t < high)
            low, low_slope = jnp.where(falls, t, low), jnp.where(falls, here, low_slope)
            high, high_slope = jnp.where(rises, t, high), jnp.where(rises, here, high_slope)
    rise = high_slope - low_slope
    between = (low_slope < 0) & (high_slope > 0)
    t = low + (high - low) * jnp.where(between, -low_slope / jnp.where(between, rise, 1.0), 0.0)
    t = jnp.where(high_slope < 0, high, t)
    x, y, z = (larger(magnitude(p + t * d) - h, 0.0) for p, d, h in zip(middle, axis, box, strict=True))
    return jnp.where((inside := _inside_box(middle, axis, half, box)) > 0, safe_sqrt(x * x + y * y + z * z), inside)


def _inside_box(middle: Vector, axis: Vector, half: float, box: tuple[float, ...]) -> Array:
    """Return the largest gap of a segment and a box along the normals of their Minkowski difference, m. (...)"""
    c, u = [magnitude(p) for p in middle], [magnitude(d) for d in axis]
    faces = [p - h - half * d for p, h, d in zip(c, box, u, strict=True)]
    out = larger(larger(faces[0], faces[1]), faces[2])
    for i, j in ((1, 2), (2, 0), (0, 1)):
        square = axis[i] * axis[i] + axis[j] * axis[j]
        crosses = square > PARALLEL
        gap = magnitude(middle[j] * axis[i] - middle[i] * axis[j]) - box[i] * u[j] - box[j] * u[i]
        gap = gap / safe_sqrt(jnp.where(crosses, square, 1.0))
        out = jnp.where(crosses & (gap > out), gap, out)
    return out


def _fixed(vector: Vector) -> Vector:
    """Return a vector as a constant to derivatives. 3 of (...)"""
    x, y, z = vector
    return lax.stop_gradient(x), lax.stop_gradient(y), lax.stop_gradient(z)
