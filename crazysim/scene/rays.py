"""Rays through the scene in pure JAX: distance, surface normal and what was hit."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.geometry import Shape, ray_distance
from crazysim.geometry.points import Components, components
from crazysim.geometry.rays import Sized, hit_distance, hit_normal
from crazysim.pytree import PyTree, static
from crazysim.scene.collision import CollisionGeom, CollisionModel
from crazysim.scene.mocap import MocapPoses, require_poses, with_mocap_bodies

MAX_UNROLLED = 16
"""Geoms of equal objects up to which the program is unrolled; more go through a loop, which compiles once."""

GEOMS_A_TURN = 2
"""Geoms in a turn of the loop over many: more take longer to compile, fewer read and write the rays more often."""


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
    if origin.ndim == 3:
        return _cast_in_worlds(model, data, origin, direction, own, drones)
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
        pos, quat = data.objects.pos, data.objects.quat
        for geoms, group in groups.items():
            best = _met_by(best, geoms, pos, quat, np.array(group), origin, direction, None)
    if drones:
        pos, quat = data.states.pos, data.states.quat
        for kind in model.drones:
            rows = np.arange(data.core.n_drones) if kind.drones is None else np.asarray(kind.drones)
            group = np.stack([rows, rows + 1 + len(model.objects)], axis=-1)
            best = _met_by(best, kind.geoms, pos, quat, group, origin, direction, own)
    return best


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


# Rays of all worlds: many, so that a loop over tables of geoms is worth it --------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Alike:
    """Geoms of one kind, over which a loop runs."""

    kind: Shape
    """A shape of the kind; all have it if the kind is a mesh or a height field."""
    carrier: Literal["world", "object", "drone"]
    """Kind of the bodies that carry them."""
    is_turned: bool
    """True if a geom may have a rotation."""
    geoms: list[CollisionGeom]
    """Geoms, in the frames of their bodies."""
    rows: list[int]
    """Row of each body among the objects or drones."""
    numbers: list[int]
    """Number of each body in ``Hits.number``."""

    def table(self, data: SimData, dtype: DTypeLike) -> Array:
        """Return position, rotation by rows if they are turned, and size of each. (n_worlds or 1, n_geoms, k)"""
        pos = np.array([geom.pos for geom in self.geoms])
        rot = np.array([np.eye(3) if geom.rot is None else geom.rot for geom in self.geoms])
        size = jnp.asarray([geom.shape.size for geom in self.geoms], dtype)[None]
        at, axes = jnp.asarray(pos, dtype)[None], [jnp.asarray(rot[:, :, k], dtype)[None] for k in range(3)]
        if self.carrier == "object" and data.objects is not None:
            poses = data.objects.pos[:, 0], data.objects.quat[:, 0]
        else:
            poses = data.states.pos, data.states.quat
        if self.carrier != "world":
            body_pos, quat = (x[:, np.array(self.rows)] for x in poses)
            at = body_pos + rotation.rotate(quat, at)
            axes = [rotation.rotate(quat, axis) for axis in axes]
            size = jnp.broadcast_to(size, (*at.shape[:-1], size.shape[-1]))
        turned = [jnp.stack(axes, axis=-1).reshape(*at.shape[:-1], 9)] if self.is_turned else []
        return jnp.concatenate([at, *turned, size], axis=-1)

    def in_frame(self, row: Sequence[Array], origin: Components, direction: Components) -> _Placed:
        """Return shape and rays in the frames of geoms, whose entries of the table are given."""
        start: Components = tuple(o - p for o, p in zip(origin, row, strict=False))  # type: ignore[assignment]
        if self.is_turned:
            start, direction = (
                tuple(sum(row[3 + 3 * i + k] * v[i] for i in range(3)) for k in range(3)) for v in (start, direction)
            )  # type: ignore[assignment]
        constant = self.kind.kind in ("mesh", "hfield")
        return (self.kind if constant else Sized(self.kind.kind, row[12 if self.is_turned else 3 :])), start, direction


_Placed = tuple[Shape | Sized, Components, Components]


def _all_alike(model: CollisionModel, data: SimData, own: np.ndarray | None, drones: bool) -> list[_Alike]:
    """Return the geoms that rays can meet, by kind."""
    found: dict[Any, _Alike] = {}

    def add(
        carrier: Literal["world", "object", "drone"], geoms: Sequence[CollisionGeom], row: int, number: int
    ) -> None:
        for geom in geoms:
            constant = geom.shape.kind in ("mesh", "hfield")
            is_turned = carrier != "world" or geom.rot is not None
            key = carrier, geom.shape if constant else geom.shape.kind, is_turned
            alike = found.setdefault(key, _Alike(geom.shape, carrier, is_turned, [], [], []))
            alike.geoms.append(geom)
            alike.rows.append(row)
            alike.numbers.append(number)

    add("world", model.floor, 0, 0)
    for number, body in enumerate(model.objects, start=1):
        add("world" if body.row is None else "object", body.geoms, body.row or 0, number)
    for kind in model.drones if drones else ():
        for row in range(data.core.n_drones) if kind.drones is None else kind.drones:
            if own is None or not np.all(own == row):
                add("drone", kind.geoms, row, 1 + len(model.objects) + row)
    return list(found.values())


def _cast_in_worlds(
    model: CollisionModel, data: SimData, origin: Array, direction: Array, own: np.ndarray | None, drones: bool
) -> Hits:
    """Return the first surfaces that rays of all worlds meet; see ``cast``.

    A loop over all geoms computes the distance, without a derivative. Another finds which geom is the nearest, and for
    that geom alone the normal and the derivative of the distance are computed. A compiler drops the second loop where
    only distances are used.
    """
    groups = _all_alike(model, data, own, drones)
    tables = [group.table(data, origin.dtype) for group in groups]
    fixed = jax.lax.stop_gradient((tables, origin, direction))
    distance, which = _nearest(*fixed, groups, own), _which(*fixed, groups, own)
    starts = np.cumsum([0, *(len(group.geoms) for group in groups)])
    placed, exact = [], jnp.full(distance.shape, jnp.inf, distance.dtype)
    for group, table, first in zip(groups, tables, starts, strict=False):
        mine = (which >= first) & (which < first + len(group.geoms))
        place = jnp.clip(which - first, 0, len(group.geoms) - 1)
        if group.carrier == "world":
            table = jnp.take(table[0], place, axis=0)
        else:
            table = jnp.take_along_axis(table, place[..., None], axis=1)
        row = [table[..., k] for k in range(table.shape[-1])]
        here = group.in_frame(row, components(origin), components(direction))
        exact = jnp.where(mine, _distance(*here), exact)
        placed.append((group, mine, row, *here))
    distance = _with_derivative_of(distance, exact)
    normal = jnp.zeros_like(origin)
    for group, mine, row, shape, start, along in placed:
        begin, way = jnp.stack(start, axis=-1), jnp.stack(along, axis=-1)
        if shape.kind == "hfield":
            _, across = ray_distance(shape, begin, way)
        else:
            across = hit_normal(shape, begin, way, distance)
        if group.is_turned:
            across = jnp.stack([sum(row[3 + 3 * i + k] * across[..., k] for k in range(3)) for i in range(3)], axis=-1)
        normal = jnp.where(mine[..., None], across, normal)
    numbers = jnp.asarray([*(n for group in groups for n in group.numbers), -1], jnp.int32)
    return Hits(distance, normal, numbers[which], names(model, data.core.n_drones if drones else 0))


def _distance(shape: Shape | Sized, origin: Components, direction: Components) -> Array:
    """Return the distance along rays in the frame of a shape, m. (...)"""
    if isinstance(shape, Shape) and shape.kind == "hfield":
        return ray_distance(shape, jnp.stack(origin, axis=-1), jnp.stack(direction, axis=-1))[0]
    return hit_distance(shape, origin, direction)


def _nearest(
    tables: Sequence[Array], origin: Array, direction: Array, groups: Sequence[_Alike], own: np.ndarray | None
) -> Array:
    """Return the distance to the nearest geom, m. (..., n_rays)"""

    def nearer(best: Array, far: Array, _: Array) -> Array:
        return jnp.where(far < best, far, best)

    best = jnp.full(origin.shape[:-1], jnp.inf, origin.dtype)
    return _over_geoms(tables, origin, direction, groups, own, nearer, best)


def _which(
    tables: Sequence[Array], origin: Array, direction: Array, groups: Sequence[_Alike], own: np.ndarray | None
) -> Array:
    """Return the index of the nearest geom among those of all groups, -1 for none. (..., n_rays)

    Beside the distance it is slow on CPUs, where XLA computes every geom once for each of the two.
    """

    def nearer(best: tuple[Array, Array], far: Array, k: Array) -> tuple[Array, Array]:
        return jnp.where(far < best[0], far, best[0]), jnp.where(far < best[0], k, best[1])

    best = jnp.full(origin.shape[:-1], jnp.inf, origin.dtype), jnp.full(origin.shape[:-1], -1, jnp.int32)
    return _over_geoms(tables, origin, direction, groups, own, nearer, best)[1]


Best = TypeVar("Best")


def _over_geoms(
    tables: Sequence[Array],
    origin: Array,
    direction: Array,
    groups: Sequence[_Alike],
    own: np.ndarray | None,
    nearer: Callable[[Best, Array, Array], Best],
    best: Best,
) -> Best:
    """Return what a loop over all geoms leaves of ``best = nearer(best, distance, index of the geom)``."""
    rays, first = (components(origin), components(direction)), 0
    for group, table in zip(groups, tables, strict=True):
        # Geoms in front, so that a turn of the loop reads what is contiguous.
        rows = jnp.moveaxis(table, 0, -1)[..., None]
        turn = functools.partial(_turn, group, rows, rays, own, first, nearer)
        best = jax.lax.fori_loop(0, len(group.geoms), turn, best, unroll=min(len(group.geoms), GEOMS_A_TURN))
        first += len(group.geoms)
    return best


def _turn(
    group: _Alike,
    rows: Array,
    rays: tuple[Components, Components],
    own: np.ndarray | None,
    first: int,
    nearer: Callable[[Best, Array, Array], Best],
    k: Array,
    best: Best,
) -> Best:
    far = _distance(*group.in_frame(list(rows[k]), *rays))
    if own is not None and group.carrier == "drone":
        far = jnp.where(jnp.asarray(own) == jnp.asarray(group.rows)[k], jnp.inf, far)
    return nearer(best, far, first + k)


@jax.custom_jvp
def _with_derivative_of(value: Array, other: Array) -> Array:
    """Return a value whose derivative is that of another."""
    del other
    return value


@_with_derivative_of.defjvp
def _(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    return primals[0], tangents[1]
