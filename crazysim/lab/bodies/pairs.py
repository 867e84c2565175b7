"""Contact points between the balls and boxes of a world, and with its ground and other objects."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.geometry import Shape, distance, point_distance
from crazysim.lab.bodies.manifold import Manifold, ball_box_contacts, ball_contacts, box_contacts
from crazysim.lab.bodies.small_matrices import matvec
from crazysim.lab.bodies.solver import Contacts
from crazysim.scene.collision import CollisionGeom

GapFn = Callable[[Array], tuple[Array, Array]]
"""Function that maps points (n, 3) to gaps (n,) and normals (n, 3)."""
CORNERS = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
"""Corners of a box whose half lengths are one. (8, 3)"""


class Solids(NamedTuple):
    """Balls and boxes of a world: shapes and owners are static, poses are data."""

    body: np.ndarray
    """Index of the body that carries each solid. (n,)"""
    is_ball: np.ndarray
    """True for balls. (n,)"""
    size: np.ndarray
    """Half lengths of each box, or the radius of a ball, repeated three times, m. (n, 3)"""
    pos: Array
    """Positions of the centres, world frame, m. (n, 3)"""
    rot: Array
    """Rotation matrices to the world frame. (n, 3, 3)"""


class PairContacts(NamedTuple):
    """Contact points of pairs of bodies, with the same number of points for every pair."""

    first: np.ndarray
    """Indices of the first bodies. (n_pairs,)"""
    second: np.ndarray
    """Indices of the second bodies. (n_pairs,)"""
    points: Manifold
    """Gaps (k,), normals (k, 3) and points (k, 3), sorted by pair."""


def contacts_between(solids: Solids, pairs: np.ndarray) -> list[PairContacts]:
    """Return the contact points of pairs of solids, one record for each kind of pair, such as ball and box.

    Args:
        pairs: Indices of the two solids of each pair. (n_pairs, 2)
    """
    contacts = []
    kinds = solids.is_ball[pairs]
    for is_a_ball, is_b_ball in ((True, True), (True, False), (False, True), (False, False)):
        pairs_of_kind = pairs[(kinds[:, 0] == is_a_ball) & (kinds[:, 1] == is_b_ball)]
        if not len(pairs_of_kind):
            continue
        if is_b_ball and not is_a_ball:
            pairs_of_kind = pairs_of_kind[:, ::-1]
        a, b = pairs_of_kind.T
        size = jnp.asarray(solids.size, solids.pos.dtype)
        if is_a_ball and is_b_ball:
            points = jax.vmap(ball_contacts)(size[a, 0], solids.pos[a], size[b, 0], solids.pos[b])
        elif is_a_ball or is_b_ball:
            points = jax.vmap(ball_box_contacts)(size[a, 0], solids.pos[a], size[b], solids.pos[b], solids.rot[b])
        else:
            points = jax.vmap(box_contacts)(
                size[a], solids.pos[a], solids.rot[a], size[b], solids.pos[b], solids.rot[b]
            )
        contacts.append(PairContacts(solids.body[a], solids.body[b], _flatten_manifolds(points)))
    return contacts


def contacts_on_surface(
    solids: Solids, solid_index: int, geom: CollisionGeom, carrier: int, pose: tuple[Array, Array]
) -> PairContacts:
    """Return the contact points of a solid with a geom of any kind.

    A ball has one point; a box has its corners and, unless the geom is a plane, its point nearest to the geom.

    Args:
        carrier: Index of the body that carries the geom.
        pose: Position, m (3,), and rotation matrix (3, 3) of the geom, world frame.
    """
    (surface_pos, surface_rot), shape = pose, geom.shape

    def gap_at(points: Array) -> tuple[Array, Array]:
        gap, normal = _distance_and_normal(shape, matvec(surface_rot.T, points - surface_pos))
        return gap, matvec(surface_rot, normal)

    contacts = contacts_on_ground(solids, solid_index, carrier, gap_at)
    if solids.is_ball[solid_index] or shape.kind == "plane":
        return contacts
    box = Shape("box", tuple(map(float, solids.size[solid_index])))
    nearest_point = _nearest_point(
        box, solids.pos[solid_index], solids.rot[solid_index], shape, surface_pos, surface_rot
    )
    return contacts._replace(
        points=Manifold(*(jnp.concatenate(x) for x in zip(contacts.points, nearest_point, strict=True)))
    )


def contacts_on_ground(solids: Solids, solid_index: int, carrier: int, gap_at: GapFn) -> PairContacts:
    """Return the contact points of a solid with a surface, whose gaps and normals ``gap_at`` returns."""
    pos, rot = solids.pos[solid_index], solids.rot[solid_index]
    if solids.is_ball[solid_index]:
        radius = float(solids.size[solid_index, 0])
        gap, normal = gap_at(pos[None])
        gap = gap - radius
        manifold = Manifold(gap, normal, pos - normal * (radius + 0.5 * gap[:, None]))
    else:
        corners = pos + matvec(rot, jnp.asarray(CORNERS * solids.size[solid_index], pos.dtype))
        manifold = Manifold(*gap_at(corners), corners)
    return PairContacts(solids.body[solid_index : solid_index + 1], np.array([carrier]), manifold)


def join_contacts(pairs: list[PairContacts], friction: Array, restitution: Array) -> Contacts:
    """Return all contact points, each with the larger friction and the larger restitution of its two bodies.

    Args:
        pairs: Contact points of pairs of bodies.
        friction: Coulomb's coefficients of the bodies, 1. (n,)
        restitution: Coefficients of restitution of the bodies, 1. (n,)
    """
    pairs = sorted(pairs, key=_n_points)
    first, second = (np.concatenate([pair[k] for pair in pairs]) for k in range(2))
    n_points = np.concatenate([np.full(len(pair.first), _n_points(pair)) for pair in pairs])
    gap, normal, point = (jnp.concatenate([pair.points[k] for pair in pairs]) for k in range(3))
    mixed_materials = (
        jnp.maximum(x[first], x[second])[np.repeat(np.arange(len(first)), n_points)] for x in (friction, restitution)
    )
    return Contacts(first, second, n_points, gap, normal, point, *mixed_materials)


def _n_points(contacts: PairContacts) -> int:
    return contacts.points.gap.shape[0] // len(contacts.first)


def _distance_and_normal(shape: Shape, point: Array) -> tuple[Array, Array]:
    gap, pull_back = jax.vjp(lambda p: point_distance(shape, p), point)
    return gap, pull_back(jnp.ones_like(gap))[0]


def _nearest_point(box: Shape, pos: Array, rot: Array, shape: Shape, shape_pos: Array, shape_rot: Array) -> Manifold:
    def gap_at(displacement: Array, rotvec: Array) -> Array:
        turned_rot = rot + jnp.stack([rotation.cross(rotvec, rot[:, k]) for k in range(3)], axis=-1)
        columns = [matvec(shape_rot.T, turned_rot[:, k]) for k in range(3)]
        return distance(box, shape, matvec(shape_rot.T, pos + displacement - shape_pos), jnp.stack(columns, axis=-1))

    gap, pull_back = jax.vjp(gap_at, jnp.zeros_like(pos), jnp.zeros_like(pos))
    normal, torque = pull_back(jnp.ones_like(gap))
    half_lengths = jnp.asarray(box.size, pos.dtype)
    reach = jnp.sum(jnp.abs(matvec(rot.T, normal)) * half_lengths)
    point = pos + rotation.cross(normal, torque) - reach * normal
    return Manifold(gap[None], normal[None], point[None])


def _flatten_manifolds(points: Manifold) -> Manifold:
    return Manifold(points.gap.reshape(-1), points.normal.reshape(-1, 3), points.point.reshape(-1, 3))
