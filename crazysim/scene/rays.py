"""Rays through the scene in pure JAX: distance, surface normal and what was hit."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.geometry import ray_distance
from crazysim.pytree import PyTree, static
from crazysim.scene.collision import CollisionGeom, CollisionModel
from crazysim.scene.mocap import MocapPoses, require_poses, with_mocap_bodies

MAX_UNROLLED = 16
"""Geoms of equal objects up to which the program is unrolled; more go through a loop, which compiles once."""


class Hits(PyTree):
    """First surfaces that rays meet."""

    distance: Array
    """Length of the ray, m; infinite where it meets nothing."""
    normal: Array
    """Unit normal of the surface, world frame; zero where the ray meets nothing. (..., 3)"""
    number: Array
    """Index in ``names`` of the body; -1 where the ray meets nothing."""
    names: tuple[str, ...] = static()
    """Floor, objects and drones, in that order."""


def names(model: CollisionModel, n_drones: int) -> tuple[str, ...]:
    """Return the names of everything that rays can meet, in the order of ``Hits.number``."""
    return ("floor", *(body.name for body in model.objects), *(f"drone:{i}" for i in range(n_drones)))


def cast(
    model: CollisionModel,
    data: SimData,
    origin: Array,
    direction: Array,
    own: np.ndarray | None = None,
    drones: bool = True,
    mocap: MocapPoses = None,
) -> Hits:
    """Return the first surfaces that rays meet, in all worlds, in one world, or around one drone, as the data is.

    Args:
        model: Visual or collision model of the scene.
        data: Simulation, for the poses of objects and drones.
        origin: Origins of the rays, world frame, m. (n_worlds, n_rays, 3), without n_worlds in one world or drone
        direction: Unit directions, world frame. The same shape
        own: Index of the drone that a ray passes through; None for no drone. (n_rays,)
        drones: True for rays to meet drones; a stage of one drone has no access to the others.
        mocap: Poses of bodies that are moved through ``mjx_data``; None if there are none.

    Raises:
        ConfigError: If the scene has such bodies and their poses are not given.
    """
    require_poses(model, [body.name for body in model.objects], mocap)
    data = with_mocap_bodies(model, data, mocap)
    best = Hits(
        distance=jnp.full(origin.shape[:-1], jnp.inf, origin.dtype),
        normal=jnp.zeros_like(origin),
        number=jnp.full(origin.shape[:-1], -1, jnp.int32),
        names=names(model, data.core.n_drones if drones else 0),
    )
    for geom in model.floor:
        best = _nearer(best, *_meet(geom, origin, direction), 0)
    groups: dict[tuple[CollisionGeom, ...], list[tuple[int, int]]] = {}
    for number, body in enumerate(model.objects, start=1):
        if body.row is None:
            for geom in body.geoms:
                best = _nearer(best, *_meet(geom, origin, direction), number)
        else:
            groups.setdefault(body.geoms, []).append((body.row, number))
    if data.objects is not None:
        # One row for each object, and an axis for rays behind the worlds.
        pos, quat = (_of_rays(x) for x in (data.objects.pos, data.objects.quat))
        for geoms, group in groups.items():
            best = _met_by(best, geoms, pos, quat, np.array(group), origin, direction, None)
    if drones:
        pos, quat = data.states.pos, data.states.quat
        for kind in model.drones:
            rows = np.arange(data.core.n_drones) if kind.drones is None else np.asarray(kind.drones)
            group = np.stack([rows, rows + 1 + len(model.objects)], axis=-1)
            best = _met_by(best, kind.geoms, pos, quat, group, origin, direction, own)
    return best


def _of_rays(x: Array) -> Array:
    """Return poses of objects as (n_worlds, n_objects, k), or of one world (n_objects, k)."""
    return x[:, 0] if x.ndim == 4 else x


def _met_by(
    best: Hits,
    geoms: tuple[CollisionGeom, ...],
    pos: Array,
    quat: Array,
    group: np.ndarray,
    origin: Array,
    direction: Array,
    own: np.ndarray | None,
) -> Hits:
    """Return the nearer of earlier hits and those of movable bodies with equal geoms.

    Args:
        best: Earlier hits.
        geoms: Geoms of each body, in its frame.
        pos: Positions of all movable bodies, m. (..., n, 3)
        quat: Their attitudes, xyzw. (..., n, 4)
        group: Row of each body of the group in ``pos``, and its number in ``Hits.number``. (k, 2)
        origin: Origins of the rays. (..., n_rays, 3)
        direction: Their directions. (..., n_rays, 3)
        own: Row of the body that a ray passes through. (n_rays,)
    """

    def with_one(best: Hits, row: Array, number: Array) -> Hits:
        p, q = (jnp.take(x, row, axis=-2)[..., None, :] for x in (pos, quat))
        start, along = rotation.rotate_inverse(q, origin - p), rotation.rotate_inverse(q, direction)
        for geom in geoms:
            far, normal = _meet(geom, start, along)
            far = far if own is None else jnp.where(own == row, jnp.inf, far)
            best = _nearer(best, far, rotation.rotate(q, normal), number)
        return best

    if len(group) * len(geoms) <= MAX_UNROLLED:
        for row, number in group:
            best = with_one(best, row, number)
        return best
    table = jnp.asarray(group, jnp.int32)
    return jax.lax.fori_loop(0, len(group), lambda k, best: with_one(best, table[k, 0], table[k, 1]), best)


def _meet(geom: CollisionGeom, origin: Array, direction: Array) -> tuple[Array, Array]:
    """Return the length of rays to a geom, and its normal, in the frame in which the geom is given."""
    start = origin - jnp.asarray(geom.pos, origin.dtype)
    if geom.rot is None:
        return ray_distance(geom.shape, start, direction)
    rows = np.array(geom.rot)
    far, normal = ray_distance(geom.shape, _times(rows.T, start), _times(rows.T, direction))
    return far, _times(rows, normal)


def _times(matrix: np.ndarray, vectors: Array) -> Array:
    """Return a constant matrix times vectors, without products by zero. (..., 3)"""
    x = [vectors[..., k] for k in range(3)]
    terms = [[float(m) * v for m, v in zip(row, x, strict=True) if m] for row in matrix]
    return jnp.stack([functools.reduce(jnp.add, row) for row in terms], axis=-1)


def _nearer(best: Hits, far: Array, normal: Array, number: Array | int) -> Hits:
    closer = far < best.distance
    return best.replace(
        distance=jnp.where(closer, far, best.distance),
        normal=jnp.where(closer[..., None], normal, best.normal),
        number=jnp.where(closer, jnp.asarray(number, jnp.int32), best.number),
    )
