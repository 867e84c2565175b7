"""Contact manifolds: the points at which two balls or boxes touch, with normals and gaps.

The functions take one pair of bodies, as small arrays; use ``jax.vmap`` for many. The number of points depends only on
the kinds of the two bodies, and points that do not exist have a large gap.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from crazysim import rotation
from crazysim.geometry.heightfield import OUTSIDE_DISTANCE
from crazysim.lab.bodies.small_matrices import matmul, matvec

N_BOX_POINTS = 13
"""Number of contact points between two boxes."""
MIN_EDGE_SINE = 1e-3
"""Sine of the angle between two edges below which their cross product is not used as a separating axis."""
EDGE_SHARE, EDGE_BIAS = 0.95, 0.01
"""An axis of two edges is chosen if its overlap is less than ``EDGE_SHARE`` times the overlap of the best face minus
``EDGE_BIAS`` times the smallest half length. Faces are preferred because their several points rest more steadily."""
FACE_BIAS = 1e-3
"""Preference for faces of the first box, as a fraction of the smallest half length: a face of the second box is chosen
only if its overlap is smaller by this length. Otherwise rounding would choose between the faces of aligned boxes, and
the impulses of the last step, from which a solver may start, would not match the points."""
FACE_SHARE = 1 - 1e-4
"""Fraction of a face within which the corners of the other face are separate points. Closer to the border, the clipped
edges give the points; they are clipped at ``2 - FACE_SHARE`` times the half lengths of the face."""


class Manifold(NamedTuple):
    """Points at which two bodies touch or may touch next, world frame."""

    gap: Array
    """Distance along the normal, m, negative where they overlap. (n,)"""
    normal: Array
    """Unit normal, from the second body to the first. (n, 3)"""
    point: Array
    """Middle of the gap, m. (n, 3)"""


def ball_contacts(radius_a: Array, pos_a: Array, radius_b: Array, pos_b: Array) -> Manifold:
    """Return the contact point of two balls, of radii, m (), and positions, world frame, m (3,)."""
    offset = pos_a - pos_b
    up = jnp.asarray([0.0, 0.0, 1.0], offset.dtype)
    normal = rotation.safe_normalize(offset, up)
    gap = rotation.safe_norm(offset) - (radius_a + radius_b)
    return Manifold(gap, normal[None], (pos_b + normal * (radius_b + 0.5 * gap))[None])


def ball_box_contacts(radius: Array, pos: Array, size: Array, pos_box: Array, rot_box: Array) -> Manifold:
    """Return the contact point of a ball, the first body, and a box.

    Args:
        radius: Radius of the ball, m. ()
        pos: Position of its centre, world frame, m. (3,)
        size: Half lengths of the box, m. (3,)
        pos_box: Position of its centre, world frame, m. (3,)
        rot_box: Rotation matrix from its frame to the world. (3, 3)
    """
    centre = matvec(rot_box.T, pos - pos_box)
    nearest = rotation.clip(centre, -size, size)
    offset = centre - nearest
    distance = rotation.safe_norm(offset)
    # A centre inside the box leaves through the nearest face.
    depth = size - jnp.abs(centre)
    is_nearest_face = jnp.arange(3) == jnp.argmin(depth)
    face = jnp.where(is_nearest_face, jnp.where(centre < 0, -1.0, 1.0), 0.0)
    is_outside = distance > 0
    normal = jnp.where(is_outside, offset / jnp.where(is_outside, distance, 1.0), face)
    gap = jnp.where(is_outside, distance, -jnp.min(depth)) - radius
    normal = matvec(rot_box, normal)
    return Manifold(gap, normal[None], (pos - normal * (radius + 0.5 * gap))[None])


def box_contacts(half_a: Array, pos_a: Array, rot_a: Array, half_b: Array, pos_b: Array, rot_b: Array) -> Manifold:
    """Return the contact points of two boxes.

    The contact normal is the axis of least overlap among the normals of their faces and the cross products of their
    edges (Gottschalk, Lin and Manocha 1996). For a face, the nearest face of the other box is clipped against it, which
    gives up to twelve points. Two edges meet at one point.

    Args:
        half_a: Half lengths of the first box, m. (3,)
        pos_a: Position of its centre, world frame, m. (3,)
        rot_a: Rotation matrix from its frame to the world. (3, 3)
        half_b: Half lengths of the second box, m. (3,)
        pos_b: Position of its centre, world frame, m. (3,)
        rot_b: Rotation matrix from its frame to the world. (3, 3)
    """
    offset = pos_a - pos_b
    relative_rot = matmul(rot_b.T, rot_a)
    abs_rot = jnp.abs(relative_rot)
    offset_in_a, offset_in_b = matvec(rot_a.T, offset), matvec(rot_b.T, offset)
    face_gaps = jnp.concatenate([
        jnp.abs(offset_in_a) - half_a - matvec(abs_rot.T, half_b),
        jnp.abs(offset_in_b) - half_b - matvec(abs_rot, half_a),
    ])  # fmt: skip
    min_half = jnp.minimum(jnp.min(half_a), jnp.min(half_b))
    best_face = jnp.argmax(
        lax.stop_gradient(face_gaps + FACE_BIAS * min_half * jnp.asarray([1, 1, 1, 0, 0, 0], face_gaps.dtype))
    )
    axes = rotation.cross(rot_b.T[:, None], rot_a.T[None])  # (3 of b, 3 of a, 3)
    length = rotation.safe_norm(axes)
    is_defined = length[..., 0] > MIN_EDGE_SINE
    axes = axes / jnp.where(length > MIN_EDGE_SINE, length, 1.0)
    half_extent = jnp.sum(half_a * jnp.abs(jnp.sum(axes[..., None] * rot_a, axis=-2)), axis=-1)
    half_extent = half_extent + jnp.sum(half_b * jnp.abs(jnp.sum(axes[..., None] * rot_b, axis=-2)), axis=-1)
    edge_gaps = jnp.where(
        is_defined, jnp.abs(jnp.sum(axes * offset, axis=-1)) - half_extent, -OUTSIDE_DISTANCE
    ).reshape(-1)
    edge_pair = jnp.argmax(lax.stop_gradient(edge_gaps))
    is_edge_contact = edge_gaps[edge_pair] > EDGE_SHARE * face_gaps[best_face] + EDGE_BIAS * min_half
    # If the boxes are apart, the axis with the largest distance is chosen, of a face or of two edges. Without the bias,
    # rounding would choose between level faces that touch.
    is_edge_contact = jnp.where(
        face_gaps[best_face] > 0, edge_gaps[edge_pair] > face_gaps[best_face] + FACE_BIAS * min_half, is_edge_contact
    )

    is_a = best_face < 3
    boxes = (half_a, pos_a, rot_a), (half_b, pos_b, rot_b)
    face_box = tuple(jnp.where(is_a, x, y) for x, y in zip(*boxes, strict=True))
    other_box = tuple(jnp.where(is_a, y, x) for x, y in zip(*boxes, strict=True))
    gap, normal, point = _clip_face(face_box, best_face % 3, other_box)
    gap_edge, normal_edge, point_edge = _edge_contact(boxes, edge_pair, axes.reshape(-1, 3)[edge_pair], offset)
    gap = jnp.concatenate(
        [
            jnp.where(is_edge_contact, OUTSIDE_DISTANCE, gap),
            jnp.where(is_edge_contact, gap_edge, OUTSIDE_DISTANCE)[None],
        ]
    )
    normal = jnp.where(is_a, -normal, normal)
    normal = jnp.concatenate([jnp.broadcast_to(normal, point.shape), normal_edge[None]])
    return Manifold(gap, normal, jnp.concatenate([point, point_edge[None]]))


def _clip_face(face: tuple[Array, ...], axis: Array, other: tuple[Array, ...]) -> tuple[Array, Array, Array]:
    # The normal points towards the other box. The face of the other box is clipped to the face of the first.
    half, pos, rot = _renumber_axes(face, axis)
    offset = other[1] - pos
    side = jnp.where(jnp.sum(offset * rot[:, 0]) < 0, -1.0, 1.0)
    normal = side * rot[:, 0]
    other_normal = matvec(other[2].T, normal)
    other_axis = jnp.argmax(lax.stop_gradient(jnp.abs(other_normal)))
    half_other, _, rot_other = _renumber_axes(other, other_axis)
    # Middle and half edges of the other box's nearest face, in the frame of the face: two axes in it and its normal.
    sign = jnp.where(other_normal[other_axis] > 0, -1.0, 1.0)
    frame = jnp.stack([rot[:, 1], rot[:, 2], normal])
    middle = matvec(frame, offset + sign * half_other[0] * rot_other[:, 0]) - jnp.stack([0 * side, 0 * side, half[0]])
    edge_1, edge_2 = half_other[1] * matvec(frame, rot_other[:, 1]), half_other[2] * matvec(frame, rot_other[:, 2])
    other_corners = jnp.stack([middle + x * edge_1 + y * edge_2 for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))])
    edges = jnp.roll(other_corners, -1, axis=0) - other_corners
    limit = half[1:] * (2 - FACE_SHARE)
    # Part of each edge within the limits, as fractions of the edge.
    start, end = jnp.zeros(4, pos.dtype), jnp.ones(4, pos.dtype)
    for k in range(2):
        rate = edges[:, k]
        is_crossing = jnp.abs(rate) > 1e-9
        inverse = 1 / jnp.where(is_crossing, rate, 1.0)
        bounds = (-limit[k] - other_corners[:, k]) * inverse, (limit[k] - other_corners[:, k]) * inverse
        is_within = jnp.abs(other_corners[:, k]) <= limit[k]
        start = jnp.maximum(start, jnp.where(is_crossing, jnp.minimum(*bounds), jnp.where(is_within, 0.0, 2.0)))
        end = jnp.minimum(end, jnp.where(is_crossing, jnp.maximum(*bounds), 1.0))
    is_clipped = start <= end
    valid = [is_clipped, is_clipped & (end < 1)]  # the end of an edge is the beginning of the next
    # Clip to the edge: for an edge parallel to the border up to rounding, the computed ends can be kilometres away.
    candidates = [other_corners + jnp.clip(x, 0.0, 1.0)[:, None] * edges for x in (start, end)]
    # Corners of the face, projected along its normal onto the other box's nearest face.
    face_corners = jnp.stack([jnp.stack([x * limit[0], y * limit[1]]) for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))])
    det = edge_1[0] * edge_2[1] - edge_1[1] * edge_2[0]
    det = jnp.where(jnp.abs(det) > 1e-12, det, 1e-12)
    face_offsets = face_corners - middle[:2]
    # Position on the other face, from -1 to 1 along each of its half edges.
    p = (face_offsets[:, 0] * edge_2[1] - face_offsets[:, 1] * edge_2[0]) / det
    q = (edge_1[0] * face_offsets[:, 1] - edge_1[1] * face_offsets[:, 0]) / det
    valid.append((jnp.abs(p) < FACE_SHARE) & (jnp.abs(q) < FACE_SHARE))
    height = middle[2] + p * edge_1[2] + q * edge_2[2]
    candidates.append(jnp.concatenate([face_corners, height[:, None]], axis=-1))
    points = jnp.concatenate(candidates)
    gap = jnp.where(jnp.concatenate(valid), points[:, 2], OUTSIDE_DISTANCE)
    local_points = jnp.concatenate([points[:, :2], half[0] + 0.5 * points[:, 2:]], axis=-1)
    return gap, normal, pos + jnp.sum(local_points[:, :, None] * frame[None], axis=-2)


def _edge_contact(
    boxes: tuple[tuple[Array, ...], ...], edge_pair: Array, axis: Array, offset: Array
) -> tuple[Array, Array, Array]:
    normal = jnp.where(jnp.sum(axis * offset) < 0, -1.0, 1.0) * axis
    edges = []  # middle, direction and half length of the edge of each box
    for (half, pos, rot), number, side in zip(boxes, (edge_pair % 3, edge_pair // 3), (-1.0, 1.0), strict=True):
        local_normal = matvec(rot.T, normal)
        is_edge = jnp.arange(3) == number
        local_middle = jnp.where(is_edge, 0.0, side * jnp.where(local_normal < 0, -1.0, 1.0) * half)
        direction = jnp.sum(jnp.where(is_edge, rot, 0.0), axis=-1)
        edges.append((pos + matvec(rot, local_middle), direction, jnp.sum(jnp.where(is_edge, half, 0.0))))
    (p, u, half_p), (q, v, half_q) = edges
    offset_pq = p - q
    c, d, e = (jnp.sum(x * y) for x, y in ((u, v), (u, offset_pq), (v, offset_pq)))
    det = jnp.maximum(1 - c * c, MIN_EDGE_SINE**2)
    s = rotation.clip((c * e - d) / det, -half_p, half_p)
    t = rotation.clip((e - c * d) / det, -half_q, half_q)
    point_a, point_b = p + s * u, q + t * v
    return jnp.sum((point_a - point_b) * normal), normal, 0.5 * (point_a + point_b)


def _renumber_axes(box: tuple[Array, ...], axis: Array) -> tuple[Array, ...]:
    half, pos, rot = box

    def select_axis(options: list[Array]) -> Array:
        return jnp.where(axis == 0, options[0], jnp.where(axis == 1, options[1], options[2]))

    return (
        select_axis([jnp.roll(half, -k) for k in range(3)]),
        pos,
        select_axis([jnp.roll(rot, -k, axis=1) for k in range(3)]),
    )
