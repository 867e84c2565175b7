"""The contact report: contacts and distances of every drone, in pure JAX.

One function serves all worlds, one world, or one drone, so it also works in a stage of the step. It does not use MuJoCo
and allocates nothing per world.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim import rotation
from crazysim.arguments import check_flag
from crazysim.core.branches import table_rows
from crazysim.core.data import SimData, require_states
from crazysim.engine.pair_reductions import reduce_over_others
from crazysim.engine.pytree import PyTree, static
from crazysim.errors import expect, require
from crazysim.geometry import Shape, distance
from crazysim.geometry.points import components
from crazysim.geometry.rays import SizedShapes
from crazysim.geometry.shapes import bounding_box
from crazysim.scene.collision import CollisionBody, CollisionGeom, CollisionModel
from crazysim.scene.mocap import MocapPoses, require_poses, with_mocap_bodies
from crazysim.scene.nearest_geom import nearest_geom
from crazysim.scene.object_poses import ListPlugins, map_index_of, moving_plugins, with_moved_objects
from crazysim.scene.objects import Handle

MAX_UNROLLED_GEOMS = 16
"""Largest number of fixed geoms of one shape whose distances are computed one by one."""
SIZED_KINDS = ("sphere", "capsule", "box", "cylinder")
"""Kinds of the shapes of maps that are searched together, whatever their sizes; other shapes one shape at a time."""
MAX_LISTED_GEOMS = 64
"""Largest number of fixed geoms of one shape in a body whose distances are all computed for one drone; more geoms are
searched in a bounding volume hierarchy."""
DRONES_PER_CHUNK = 64
"""Number of drones whose distances to all other drones of their world are computed at a time."""


class ContactReport(PyTree):
    """Contacts of every drone, and signed distances. Where two bodies overlap, the distance is minus the depth.

    In a stage of one world the arrays have no axis ``n_worlds``; in a stage of one drone, also no axis ``n_drones``.
    Fields that were not requested are None.
    """

    floor: Array | None
    """Whether a drone touches the floor. (n_worlds, n_drones)"""
    floor_distance: Array | None
    """Distance to the floor, m. (n_worlds, n_drones)"""
    objects: Array | None
    """Whether a drone touches an object. (n_worlds, n_drones, n_objects)"""
    object_distance: Array | None
    """Distance to each object, m. (n_worlds, n_drones, n_objects)"""
    nearest_object: Array | None
    """Index of the nearest object in ``object_names``. (n_worlds, n_drones)"""
    drones: Array | None
    """Whether a drone touches another drone. (n_worlds, n_drones)"""
    drone_distance: Array | None
    """Distance to the nearest other drone, m; infinite for a single drone. (n_worlds, n_drones)"""
    nearest_drone: Array | None
    """Index of the nearest other drone; 0 if there is only one drone. None in a stage of one drone. (n_worlds,
    n_drones)"""
    object_names: tuple[str, ...] = static()
    """Names of the objects' bodies."""

    def merge(self, other: ContactReport) -> ContactReport:
        """Return the fields of both reports. Fields of this report take precedence."""
        names = (f.name for f in dataclasses.fields(self))  # type: ignore[arg-type]
        own_fields = {name: x for name in names if (x := getattr(self, name)) is not None}
        return other.replace(**own_fields | {"object_names": self.object_names or other.object_names})

    @property
    def any(self) -> Array:
        """Whether a drone touches anything that was requested. (n_worlds, n_drones)"""
        masks = [x for x in (self.floor, self.drones) if x is not None]
        if self.objects is not None:
            masks.append(jnp.any(self.objects, axis=-1))
        return functools.reduce(jnp.logical_or, masks)


ObjectSelection = Iterable[Handle | str] | Handle | str | None
"""Objects of a report: handles or names of bodies; None for all."""
ContactFn = Callable[..., ContactReport]
"""``contacts(data, mocap=None) -> ContactReport``."""


def build_contact_fn(
    model: CollisionModel,
    objects: ObjectSelection = None,
    floor: bool = True,
    drones: bool = True,
    plugins: ListPlugins = tuple,
) -> ContactFn:
    """Return ``contacts(data, mocap=None) -> ContactReport``, pure: for all worlds, one world, or one drone.

    Args:
        objects: Handles or names of the objects to report; None for all, () for none.
        drones: Whether to report other drones. With data of one drone this works only in a stage, and ``nearest_drone``
            is None.
        plugins: Function that returns the plugins of the simulation. Their objects are moved before distances are
            computed.
    """
    floor, drones = check_flag("floor", floor), check_flag("drones", drones)
    bodies = select_bodies(model, objects, require_data=False)
    names = tuple(body.name for body in bodies)
    require(bodies or floor or drones, "expected floor, drones or at least one object, got a contact report of nothing")
    groups = [list(group) for _, group in groupby(bodies, _group_key)]

    def contacts(data: SimData, mocap: MocapPoses = None) -> ContactReport:
        require_states(data, ("pos", "quat"), batched=False)
        require_poses(model, names, mocap)
        data = with_moved_objects(data, moving_plugins(plugins(), names))
        data = with_mocap_bodies(model, data, mocap)
        pos, quat = data.states.pos, data.states.quat
        # Every geom of every airframe, at its drone.
        all_geoms = [geom for drone_geoms in model.drones for geom in drone_geoms.geoms]
        drone_rot = rotation.matrix(quat) if any(geom.shape.kind != "sphere" for geom in all_geoms) else None
        parts = [
            (geom, pos + rotation.rotate(quat, jnp.asarray(geom.pos, pos.dtype)), is_present)
            for drone_geoms in model.drones
            for is_present in (drone_geoms.drone_mask(data.core.drone_id),)
            for geom in drone_geoms.geoms
        ]
        fields: dict[str, Array | None] = dict.fromkeys(
            ("floor", "floor_distance", "objects", "object_distance", "nearest_object", "drones", "drone_distance",
             "nearest_drone")
        )  # fmt: skip
        # Distances to floor, objects and other drones.
        if floor:
            gaps = [
                _mask_absent(is_present, _geom_distance(part, part_pos, drone_rot, geom))
                for part, part_pos, is_present in parts
                for geom in model.floor
            ]
            gap = _minimum(gaps, pos)
            fields |= {"floor": gap < 0, "floor_distance": gap}
        if bodies:
            gap = jnp.concatenate([_group_distances(parts, drone_rot, group, data) for group in groups], axis=-1)
            fields |= {"objects": gap < 0, "object_distance": gap, "nearest_object": _argmin(gap)}
        if drones:
            gap, nearest_index = (
                (_nearest_other(parts, drone_rot), None) if pos.ndim == 1 else _nearest_drones(parts, drone_rot)
            )
            fields |= {"drones": gap < 0, "drone_distance": gap, "nearest_drone": nearest_index}
        return ContactReport(**fields, object_names=names)

    return contacts


def list_objects(objects: ObjectSelection) -> tuple[Handle | str, ...] | None:
    """Return selected objects as a tuple after a check of their types; None (all objects) stays None."""
    if objects is None:
        return None
    if isinstance(objects, (Handle, str)):
        return (objects,)
    selection = tuple(objects) if np.iterable(objects) else (objects,)
    expect(
        all(isinstance(x, (Handle, str)) for x in selection),
        "objects as handles or names of bodies",
        objects,
        "Use None for all, () for none.",
    )
    return selection


def select_bodies(model: CollisionModel, objects: ObjectSelection, require_data: bool = True) -> list[CollisionBody]:
    """Return the selected objects of a model.

    Args:
        objects: Handles or names; None for all, () for none.
        require_data: Whether to refuse bodies whose poses are not part of the data, for use in a step.
    """
    by_name = {body.name: body for body in model.objects}
    selection = list_objects(objects)
    if selection is None:
        names = list(by_name)
    else:
        names = [name for x in selection for name in (x.bodies if isinstance(x, Handle) else (x,))]
    for name in names:
        require(
            name in by_name,
            f"expected an object that drones can touch, {', '.join(by_name) or 'but the scene has none'}, got {name!r}",
        )
        require(
            not require_data or name not in model.mocap_bodies,
            f"expected objects whose poses are in the data, got body {name!r}, which is moved through "
            f"sim.mjx_data. Add it with sim.scene.add, or leave it out with objects=.",
        )
    return [by_name[name] for name in names]


def _group_key(body: CollisionBody) -> tuple[Any, ...]:
    # Its first entry is True for objects that can move.
    if body.n_maps:
        return (False, body.name)
    if body.row is not None:
        return (True, body.geoms)
    kinds = tuple([(geom.shape, geom.rot is None) for geom in body.geoms])
    # Geoms of a body that cannot move are in the world frame, so bodies with one equal geom differ only in its pose.
    return (False, *kinds) if len(kinds) == 1 else (False, body.name)


def kernel_size(model: CollisionModel, objects: ObjectSelection) -> int:
    """Return a measure of the length of a contact kernel: the number of fixed geoms plus four times the movable geoms.

    More than ``MAX_LISTED_GEOMS`` fixed geoms of one shape in a body count as ``MAX_LISTED_GEOMS``, since the kernel
    searches them in a hierarchy.
    """
    bodies = select_bodies(model, objects, require_data=False)
    return sum(
        sum(min(len(geoms), MAX_LISTED_GEOMS) for geoms in _geoms_by_kind(body.geoms))
        if body.row is None
        else 4 * len(body.geoms)
        for body in bodies
    )


DroneParts = Sequence[tuple[CollisionGeom, Array, Array | None]]
"""For each geom of drones: the geom; its position on each drone, world frame, m (..., 3); True for the drones that have
it (...), None if all do."""


def _mask_absent(is_present: Array | None, gap: Array) -> Array:
    return gap if is_present is None else jnp.where(is_present, gap, jnp.inf)


def _group_distances(parts: DroneParts, drone_rot: Array | None, group: list[CollisionBody], data: SimData) -> Array:
    geoms = group[0].geoms
    if group[0].n_maps:
        return map_distance(parts, drone_rot, group[0], map_index_of(data))[..., None]
    if group[0].row is None:
        if len(group) > MAX_UNROLLED_GEOMS:
            stacked_geoms = StackedGeoms.from_geoms([body.geoms[0] for body in group])
            return _minimum(
                [
                    _stacked_distances(part, part_pos, drone_rot, stacked_geoms, is_present)
                    for part, part_pos, is_present in parts
                ],
                parts[0][1],
            )
        return jnp.stack([_fixed_distance(parts, drone_rot, body.geoms) for body in group], axis=-1)
    objects = data.objects
    rows = [body.row for body in group if body.row is not None]
    row_selection = slice(rows[0], rows[-1] + 1) if rows == list(range(rows[0], rows[-1] + 1)) else np.array(rows)
    pos, quat = objects.pos[..., row_selection, :], objects.quat[..., row_selection, :]
    rot = None
    if drone_rot is not None:
        rot = _matrix_product(jnp.swapaxes(rotation.matrix(quat), -1, -2), drone_rot[..., None, :, :])
    gaps = []
    for part, part_pos, is_present in parts:
        local_pos = rotation.rotate_inverse(quat, part_pos[..., None, :] - pos)
        presence = None if is_present is None else is_present[..., None]
        gaps += [_mask_absent(presence, _geom_distance(part, local_pos, rot, geom)) for geom in geoms]
    return _minimum(gaps, parts[0][1])


def _fixed_distance(parts: DroneParts, drone_rot: Array | None, geoms: Sequence[CollisionGeom]) -> Array:
    # Distances to many geoms of one shape, or to many boxes, are computed together.
    gaps = []
    for geoms_of_kind in _geoms_by_kind(geoms):
        for part, part_pos, is_present in parts:
            if len(geoms_of_kind) > MAX_LISTED_GEOMS and part_pos.ndim == 1:
                everything = [np.arange(len(geoms_of_kind))]
                gap = _nearest_distance(part, geoms_of_kind, everything, part_pos, drone_rot, jnp.int32(0))
                gaps.append(_mask_absent(is_present, gap))
            elif len(geoms_of_kind) > MAX_UNROLLED_GEOMS:
                gaps.append(
                    jnp.min(
                        _stacked_distances(
                            part, part_pos, drone_rot, StackedGeoms.from_geoms(geoms_of_kind), is_present
                        ),
                        axis=-1,
                    )
                )
            else:
                gaps += [
                    _mask_absent(is_present, _geom_distance(part, part_pos, drone_rot, geom)) for geom in geoms_of_kind
                ]
    return _minimum(gaps, parts[0][1])


def map_distance(parts: DroneParts, drone_rot: Array | None, body: CollisionBody, map_index: Array) -> Array:
    """Return the distance of parts to the geoms of the map that a world has, m; infinite if it has none. (...)

    Args:
        parts: Parts, at positions (..., 3).
        drone_rot: Rotation matrices of all parts; None for the identity. (..., 3, 3)
        body: The maps.
        map_index: Index of the map; it broadcasts with the leading axes. (...)
    """
    kinds: dict[Any, list[int]] = {}
    for k, geom in enumerate(body.geoms):
        kinds.setdefault(geom.shape.kind if geom.shape.kind in SIZED_KINDS else geom.shape, []).append(k)
    maps, gaps = np.array(body.maps), []
    for rows in kinds.values():
        geoms, groups = [body.geoms[k] for k in rows], [np.flatnonzero(maps[rows] == k) for k in range(body.n_maps)]
        for part, part_pos, is_present in parts:
            nearest = functools.partial(_nearest_distance, part, geoms, groups)
            in_axes = (0, None if drone_rot is None else 0, 0)
            index = jnp.broadcast_to(map_index, part_pos.shape[:-1])
            for _ in range(part_pos.ndim - 1):
                nearest = jax.vmap(nearest, in_axes)
            gaps.append(_mask_absent(is_present, nearest(part_pos, drone_rot, index)))
    return _minimum(gaps, parts[0][1])


def _geoms_by_kind(geoms: Sequence[CollisionGeom]) -> list[list[CollisionGeom]]:
    kinds: dict[Any, list[CollisionGeom]] = {}
    for geom in geoms:
        kinds.setdefault(("box" if geom.shape.kind == "box" else geom.shape, geom.rot is None), []).append(geom)
    return list(kinds.values())


class StackedGeoms(NamedTuple):
    """Geoms of one shape, or of one kind, at different poses."""

    shape: Shape
    """Shape of all geoms, in its own frame; if their sizes differ, the shape of the first."""
    pos: NDArray | Array
    """Origins, m. (n, 3)"""
    rot: NDArray | Array | None
    """Rotation matrices; None for the identity. (n, 3, 3)"""
    sizes: NDArray | Array | None
    """Sizes, m; None if all shapes are equal. (n, k)"""

    @staticmethod
    def from_geoms(geoms: Sequence[CollisionGeom]) -> StackedGeoms:
        """Return the stack of geoms of one shape, or of one kind."""
        rot = None
        if any(geom.rot is not None for geom in geoms):
            rot = np.array([np.eye(3) if geom.rot is None else geom.rot for geom in geoms])
        sizes = None
        if any(geom.shape != geoms[0].shape for geom in geoms):
            sizes = np.array([geom.shape.size for geom in geoms])
        return StackedGeoms(geoms[0].shape, np.array([geom.pos for geom in geoms]), rot, sizes)


def _stacked_distances(
    part: CollisionGeom, part_pos: Array, drone_rot: Array | None, geoms: StackedGeoms, is_present: Array | None
) -> Array:
    rot = None
    if drone_rot is not None:
        rot = jnp.broadcast_to(drone_rot[..., None, :, :], (*drone_rot.shape[:-2], len(geoms.pos), 3, 3))
    gap = _geom_distance(part, part_pos[..., None, :], rot, geoms)
    return _mask_absent(None if is_present is None else is_present[..., None], gap)


def _nearest_distance(
    part: CollisionGeom,
    all_geoms: Sequence[CollisionGeom],
    groups: Sequence[NDArray],
    part_pos: Array,
    drone_rot: Array | None,
    group: Array,
) -> Array:
    geoms, n, dtype = StackedGeoms.from_geoms(all_geoms), len(all_geoms), part_pos.dtype
    offsets, halves = (np.array(x) for x in zip(*(bounding_box(geom.shape) for geom in all_geoms), strict=True))
    middles = geoms.pos + (offsets if geoms.rot is None else np.einsum("nij,nj->ni", geoms.rot, offsets))
    aligned_halves = halves if geoms.rot is None else np.einsum("nij,nj->ni", np.abs(geoms.rot), halves)
    columns = [
        geoms.pos,
        np.zeros((n, 9)) if geoms.rot is None else geoms.rot.reshape(n, 9),
        np.zeros((n, 0)) if geoms.sizes is None else geoms.sizes,
    ]
    table = jnp.asarray(np.concatenate(columns, axis=1), dtype)

    def distance_to_row(row: list[Array], part_pos: Array, drone_rot: Array | None) -> Array:
        rot = None if geoms.rot is None else jnp.stack(row[3:12]).reshape(3, 3)
        sizes = None if geoms.sizes is None else jnp.stack(row[12:])
        stacked = StackedGeoms(geoms.shape, jnp.stack(row[:3]), rot, sizes)
        return _geom_distance(part, part_pos, drone_rot, stacked)

    fixed_pos, fixed_rot = jax.lax.stop_gradient((part_pos, drone_rot))
    index = nearest_geom(
        np.asarray(middles - aligned_halves),
        np.asarray(middles + aligned_halves),
        list(components(part_pos)),
        float(np.linalg.norm(bounding_box(part.shape)[1])) if part.shape.kind != "sphere" else part.shape.size[0],
        lambda k: distance_to_row(table_rows(table, k), fixed_pos, fixed_rot),
        groups,
        group,
    )
    gap = distance_to_row(list(jnp.take(table, jnp.maximum(index, 0), axis=0)), part_pos, drone_rot)
    return jnp.where(index < 0, jnp.inf, gap)


def _geom_distance(
    part: CollisionGeom, part_pos: Array, drone_rot: Array | None, geom: CollisionGeom | StackedGeoms
) -> Array:
    local_pos = part_pos - jnp.asarray(geom.pos, part_pos.dtype)
    rot = drone_rot
    if geom.rot is not None:
        geom_rot = jnp.asarray(geom.rot, part_pos.dtype)
        x, y, z = (local_pos[..., k, None] * geom_rot[..., k, :] for k in range(3))
        local_pos = x + y + z
        rot = None if drone_rot is None else _matrix_product(jnp.swapaxes(geom_rot, -1, -2), drone_rot)
    if rot is not None and part.rot is not None:
        rot = _matrix_product(rot, jnp.asarray(part.rot, part_pos.dtype))
    shape: Shape | SizedShapes = geom.shape
    if isinstance(geom, StackedGeoms) and geom.sizes is not None:
        shape = SizedShapes(geom.shape.kind, [jnp.asarray(half, part_pos.dtype) for half in geom.sizes.T])
    return distance(part.shape, shape, local_pos, jnp.eye(3) if rot is None else rot)  # type: ignore[arg-type]


def _matrix_product(a: Array, b: Array) -> Array:
    return jnp.stack([rotation.matvec(a, b[..., k]) for k in range(3)], axis=-1)


def _minimum(gaps: list[Array], pos: Array) -> Array:
    if not gaps:
        return jnp.full(pos.shape[:-1], jnp.inf, pos.dtype)
    return functools.reduce(lambda a, b: jnp.where(b < a, b, a), gaps)


def _nearest_other(parts: DroneParts, drone_rot: Array | None) -> Array:
    def pair_distance(other: tuple[list[Array], list[Array | None], Array | None], is_self: Array) -> Array:
        positions, presences, rot = other
        inverse = None if rot is None else rot.T
        relative_rot = jnp.eye(3) if inverse is None or drone_rot is None else _matrix_product(inverse, drone_rot)
        gaps = []
        for part, part_pos, is_present in parts:
            for (geom, *_), other_pos, other_present in zip(parts, positions, presences, strict=True):
                local_pos = part_pos - other_pos if inverse is None else rotation.matvec(inverse, part_pos - other_pos)
                are_present = None if is_present is None or other_present is None else is_present & other_present
                gaps.append(_mask_absent(are_present, distance(part.shape, geom.shape, local_pos, relative_rot)))
        return jnp.where(is_self, jnp.inf, _minimum(gaps, parts[0][1]))

    return reduce_over_others(
        pair_distance,
        ([part_pos for _, part_pos, _ in parts], [is_present for *_, is_present in parts], drone_rot),
        "min",
    )


def _nearest_drones(parts: DroneParts, drone_rot: Array | None) -> tuple[Array, Array]:
    # In a large swarm the distances of ``DRONES_PER_CHUNK`` drones to all others are computed at a time, so memory
    # grows linearly with the swarm.
    n = parts[0][1].shape[-2]
    indices = jnp.arange(n, dtype=np.int32)

    def nearest_of_chunk(chunk: Array) -> tuple[Array, Array]:
        gaps = []
        for part, part_pos, is_present in parts:
            chunk_pos = jnp.take(part_pos, chunk, axis=-2)[..., :, None, :]
            for geom, other_pos, other_present in parts:
                are_present = None
                if is_present is not None and other_present is not None:
                    are_present = jnp.take(is_present, chunk, axis=-1)[..., :, None] & other_present[..., None, :]
                offset = chunk_pos - other_pos[..., None, :, :]
                if drone_rot is None:
                    gaps.append(_mask_absent(are_present, distance(part.shape, geom.shape, offset, jnp.eye(3))))
                    continue
                inverse = jnp.swapaxes(drone_rot, -1, -2)[..., None, :, :, :]
                local_pos = rotation.matvec(inverse, offset)
                rot = _matrix_product(inverse, jnp.take(drone_rot, chunk, axis=-3)[..., :, None, :, :])
                gaps.append(_mask_absent(are_present, distance(part.shape, geom.shape, local_pos, rot)))
        gap = jnp.where(chunk[:, None] == indices, jnp.inf, _minimum(gaps, parts[0][1]))
        return jnp.min(gap, axis=-1), _argmin(gap)

    if n <= DRONES_PER_CHUNK:
        return nearest_of_chunk(indices)
    n_chunks = -(-n // DRONES_PER_CHUNK)
    chunk_indices = jnp.minimum(jnp.arange(n_chunks * DRONES_PER_CHUNK, dtype=np.int32), n - 1).reshape(
        n_chunks, DRONES_PER_CHUNK
    )
    gap, nearest_drones = jax.lax.map(nearest_of_chunk, chunk_indices)
    return tuple(jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], -1)[..., :n] for x in (gap, nearest_drones))  # type: ignore[return-value]


def _argmin(gaps: Array) -> Array:
    return jax.lax.argmin(gaps, gaps.ndim - 1, np.int32)
