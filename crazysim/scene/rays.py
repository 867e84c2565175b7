"""Rays through the scene in pure JAX: how far they go, what they meet, and which way its surface faces."""

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

UNROLLED = 16
"""Shapes of objects made alike up to which each is written out; more go through a loop, which compiles once."""


class Hits(PyTree):
    """What rays meet."""

    distance: Array
    """How far they go, m; infinite where they meet nothing."""
    normal: Array
    """Unit normal of the surface there, world frame; zero where there is none. (..., 3)"""
    number: Array
    """What it is, as a place in ``names``; -1 where there is nothing."""
    names: tuple[str, ...] = static()
    """Floor, objects and drones, in that order."""


def names(solids: CollisionModel, n_drones: int) -> tuple[str, ...]:
    """Return what rays can meet, in the order of their numbers."""
    return ("floor", *(solid.name for solid in solids.objects), *(f"drone:{i}" for i in range(n_drones)))


def cast(
    solids: CollisionModel,
    data: SimData,
    origin: Array,
    direction: Array,
    own: np.ndarray | None = None,
    drones: bool = True,
) -> Hits:
    """Return what rays meet. Of all worlds, of one world, or of one drone, as the data is.

    Args:
        solids: What the scene is made of.
        data: The simulation: where objects and drones are.
        origin: Where rays start, world frame, m. (n_worlds, n_rays, 3), without n_worlds in one world or drone
        direction: Their unit directions, world frame. The same shape
        own: Number of the drone that a ray does not see; None if it sees all. (n_rays,)
        drones: Whether rays see drones; not in a stage of one drone, which knows no others.
    """
    best = Hits(
        distance=jnp.full(origin.shape[:-1], jnp.inf, origin.dtype),
        normal=jnp.zeros_like(origin),
        number=jnp.full(origin.shape[:-1], -1, jnp.int32),
        names=names(solids, data.core.n_drones if drones else 0),
    )
    for part in solids.floor:
        best = _nearer(best, *_meet(part, origin, direction), 0)
    first = 1
    alike: dict[tuple[CollisionGeom, ...], list[tuple[int, int]]] = {}
    for k, solid in enumerate(solids.objects):
        if solid.place is None:
            for part in solid.parts:
                best = _nearer(best, *_meet(part, origin, direction), first + k)
        else:
            alike.setdefault(solid.parts, []).append((solid.place, first + k))
    if data.objects is not None:
        # One row for each object, and an axis for rays behind the worlds.
        pos, quat = (_of_rays(x) for x in (data.objects.pos, data.objects.quat))
        for parts, some in alike.items():
            best = _met_by(best, parts, pos, quat, np.array(some), origin, direction, None)
    if drones:
        pos, quat = data.states.pos, data.states.quat
        some = np.stack([np.arange(data.core.n_drones)] * 2, axis=-1) + [0, first + len(solids.objects)]
        best = _met_by(best, solids.drone, pos, quat, some, origin, direction, own)
    return best


def _of_rays(x: Array) -> Array:
    """Return poses of objects as (n_worlds, n_objects, k), or of one world (n_objects, k)."""
    return x[:, 0] if x.ndim == 4 else x


def _met_by(
    best: Hits,
    parts: tuple[CollisionGeom, ...],
    pos: Array,
    quat: Array,
    some: np.ndarray,
    origin: Array,
    direction: Array,
    own: np.ndarray | None,
) -> Hits:
    """Return the nearer of what was met before, and of movable bodies that are made alike.

    Args:
        best: What was met before.
        parts: What each is made of.
        pos: Where all movable bodies are, m. (..., n, 3)
        quat: Their attitudes. (..., n, 4)
        some: Which of them are meant, and what number each has. (k, 2)
        origin: Where rays start. (..., n_rays, 3)
        direction: Their directions. (..., n_rays, 3)
        own: Which of the bodies a ray does not see. (n_rays,)
    """

    def with_one(best: Hits, place: Array, number: Array) -> Hits:
        p, q = (jnp.take(x, place, axis=-2)[..., None, :] for x in (pos, quat))
        start, along = rotation.rotate_inverse(q, origin - p), rotation.rotate_inverse(q, direction)
        for part in parts:
            far, normal = _meet(part, start, along)
            far = far if own is None else jnp.where(own == place, jnp.inf, far)
            best = _nearer(best, far, rotation.rotate(q, normal), number)
        return best

    if len(some) * len(parts) <= UNROLLED:
        for place, number in some:
            best = with_one(best, place, number)
        return best
    table = jnp.asarray(some, jnp.int32)
    return jax.lax.fori_loop(0, len(some), lambda k, best: with_one(best, table[k, 0], table[k, 1]), best)


def _meet(part: CollisionGeom, origin: Array, direction: Array) -> tuple[Array, Array]:
    """Return how far rays go to a part, and its normal, in the frame that the part is described in."""
    start = origin - jnp.asarray(part.pos, origin.dtype)
    if part.rot is None:
        return ray_distance(part.shape, start, direction)
    rows = np.array(part.rot)
    far, normal = ray_distance(part.shape, _times(rows.T, start), _times(rows.T, direction))
    return far, _times(rows, normal)


def _times(matrix: np.ndarray, vectors: Array) -> Array:
    """Return a constant matrix times vectors, without the products that are zero. (..., 3)"""
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
