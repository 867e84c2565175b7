"""The contact report: what each drone touches, and how far it is from the rest, in pure JAX.

The same function serves all worlds at once, one world, or one drone, so that it can be asked at every substep in a
stage of the step. Nothing of MuJoCo takes part, and nothing is held per world.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from itertools import groupby

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.errors import ConfigError
from crazysim.geometry import distance
from crazysim.pytree import PyTree, static
from crazysim.scene.collision import CollisionBody, CollisionGeom, CollisionModel
from crazysim.scene.objects import Handle

CHUNK = 64
"""Drones whose distances to all others of their world are held at once."""


class ContactReport(PyTree):
    """What touches what. Distances are signed: negative where two overlap, by the depth of the overlap.

    Of one drone the arrays come without (n_worlds, n_drones), of one world without (n_worlds,). What was not asked for
    is None.
    """

    floor: Array | None
    """Whether a drone touches the floor. (n_worlds, n_drones)"""
    floor_distance: Array | None
    """Distance to the floor, m. (n_worlds, n_drones)"""
    objects: Array | None
    """Whether it touches an object. (n_worlds, n_drones, n_objects)"""
    object_distance: Array | None
    """Distance to the object, m. (n_worlds, n_drones, n_objects)"""
    nearest_object: Array | None
    """Number of the nearest object, in ``object_names``. (n_worlds, n_drones)"""
    drones: Array | None
    """Whether it touches another drone. (n_worlds, n_drones)"""
    drone_distance: Array | None
    """Distance to the nearest other drone, m; infinite for a single drone. (n_worlds, n_drones)"""
    nearest_drone: Array | None
    """Number of that drone; its own for a single drone. (n_worlds, n_drones)"""
    object_names: tuple[str, ...] = static()
    """Names of the objects' bodies."""

    def joined(self, other: ContactReport) -> ContactReport:
        """Return what both report; what both were asked for is this one's."""
        names = (f.name for f in dataclasses.fields(self))  # type: ignore[arg-type]
        mine = {name: x for name in names if (x := getattr(self, name)) is not None}
        return other.replace(**mine | {"object_names": self.object_names or other.object_names})

    @property
    def any(self) -> Array:
        """Whether a drone touches anything that was asked for. (n_worlds, n_drones)"""
        found = [x for x in (self.floor, self.drones) if x is not None]
        if self.objects is not None:
            found.append(jnp.any(self.objects, axis=-1))
        touches = found[0]
        for x in found[1:]:
            touches = touches | x
        return touches


Objects = Iterable[Handle | str] | Handle | str | None
"""Objects that a report is about: handles, names of bodies; None for all."""


def build(
    solids: CollisionModel, objects: Objects = None, floor: bool = True, drones: bool = True
) -> Callable[[SimData], ContactReport]:
    """Return ``report(data) -> ContactReport``, pure: for all worlds, one world, or one drone.

    Args:
        solids: What the scene is made of.
        objects: Handles or names of the objects to report; None for all, () for none.
        floor: Whether to report the floor.
        drones: Whether to report other drones; in a stage of one drone there are none to be seen.

    Raises:
        ConfigError: If nothing is asked for, or an object is not there or is moved by hand.
    """
    chosen = choose(solids, objects)
    if not (chosen or floor or drones):
        raise ConfigError("a contact report of nothing; ask for floor, drones or some object")
    groups = [list(some) for _, some in groupby(chosen, _alike)]

    def report(data: SimData) -> ContactReport:
        pos, quat = data.states.pos, data.states.quat
        turned = rotation.matrix(quat) if any(p.shape.kind != "sphere" for p in solids.drone) else None
        own = [(part, pos + rotation.rotate(quat, jnp.asarray(part.pos, pos.dtype))) for part in solids.drone]
        found: dict[str, Array | None] = dict.fromkeys(
            ("floor", "floor_distance", "objects", "object_distance", "nearest_object", "drones", "drone_distance",
             "nearest_drone")
        )  # fmt: skip
        if floor:
            gap = _nearest([_gap(mine, at, turned, part) for mine, at in own for part in solids.floor], pos)
            found |= {"floor": gap < 0, "floor_distance": gap}
        if chosen:
            gap = jnp.concatenate([_to_group(own, turned, some, data) for some in groups], axis=-1)
            found |= {"objects": gap < 0, "object_distance": gap, "nearest_object": jnp.argmin(gap, axis=-1)}
        if drones:
            if pos.ndim == 1:
                raise ConfigError(
                    "a stage of one drone does not see the others; declare it @stage('world'), or ask with drones=False"
                )
            gap, who = _to_drones(own, turned)
            found |= {"drones": gap < 0, "drone_distance": gap, "nearest_drone": who}
        return ContactReport(**found, object_names=tuple(s.name for s in chosen))

    return report


def choose(solids: CollisionModel, objects: Objects) -> list[CollisionBody]:
    """Return the objects that are meant.

    Raises:
        ConfigError: If one is not there, or is moved by hand, so that the data does not know where it is.
    """
    by_name = {solid.name: solid for solid in solids.objects}
    if objects is None:
        wanted = list(by_name)
    else:
        some = [objects] if isinstance(objects, (Handle, str)) else list(objects)
        wanted = [name for x in some for name in (x.bodies if isinstance(x, Handle) else (x,))]
    for name in wanted:
        if name not in by_name:
            raise ConfigError(
                f"the scene has no object {name!r} that drones can touch; it has {', '.join(by_name) or 'none'}"
            )
        if name in solids.by_hand:
            raise ConfigError(
                f"body {name!r} is moved by hand through sim.mjx_data, which a contact report does not look at. Add it "
                f"with sim.scene.add, which returns a handle to move it by; or leave it out with objects="
            )
    return [by_name[name] for name in wanted]


def _alike(solid: CollisionBody) -> tuple[bool, tuple[CollisionGeom, ...] | str]:
    """Return what objects must have in common to be computed side by side."""
    return (True, solid.parts) if solid.place is not None else (False, solid.name)


Own = Sequence[tuple[CollisionGeom, Array]]
"""The drone's parts with their positions in the world, m. (..., 3)"""


def _to_group(own: Own, turned: Array | None, some: list[CollisionBody], data: SimData) -> Array:
    """Return the distances to objects that are made alike, m. (..., n)"""
    parts = some[0].parts
    if some[0].place is None:
        return _nearest([_gap(mine, at, turned, part) for mine, at in own for part in parts], own[0][1])[..., None]
    objects = data.objects
    places = [s.place for s in some if s.place is not None]
    run = slice(places[0], places[-1] + 1) if places == list(range(places[0], places[-1] + 1)) else np.array(places)
    pos, quat = objects.pos[..., run, :], objects.quat[..., run, :]
    rot = None
    if turned is not None:
        rot = _product(jnp.swapaxes(rotation.matrix(quat), -1, -2), turned[..., None, :, :])
    gaps = []
    for mine, at in own:
        inside = rotation.rotate_inverse(quat, at[..., None, :] - pos)
        gaps += [_gap(mine, inside, rot, part) for part in parts]
    return _nearest(gaps, own[0][1])


def _gap(mine: CollisionGeom, at: Array, turned: Array | None, part: CollisionGeom) -> Array:
    """Return the distance of a drone's part to another part, m. (...)

    Args:
        mine: The drone's part.
        at: Where it is, in the frame that the other is described in, m. (..., 3)
        turned: The drone's attitude in that frame, where a part of it is no sphere. (..., 3, 3)
        part: The other.
    """
    inside = at - jnp.asarray(part.pos, at.dtype)
    rot = turned
    if part.rot is not None:
        columns = jnp.asarray(part.rot, at.dtype)
        x, y, z = (inside[..., k, None] * columns[k] for k in range(3))
        inside = x + y + z
        rot = None if turned is None else _product(columns.T, turned)
    if rot is not None and mine.rot is not None:
        rot = _product(rot, jnp.asarray(mine.rot, at.dtype))
    return distance(mine.shape, part.shape, inside, jnp.eye(3) if rot is None else rot)


def _product(a: Array, b: Array) -> Array:
    """Return ``a @ b`` of 3 x 3 matrices, written out: on a GPU a product may be rounded to 10 bits. (..., 3, 3)"""
    return jnp.stack([rotation.matvec(a, b[..., k]) for k in range(3)], axis=-1)


def _nearest(gaps: list[Array], pos: Array) -> Array:
    """Return the least of some distances, infinite if there are none. (...)"""
    if not gaps:
        return jnp.full(pos.shape[:-1], jnp.inf, pos.dtype)
    return functools.reduce(lambda a, b: jnp.where(b < a, b, a), gaps)


def _to_drones(own: Own, turned: Array | None) -> tuple[Array, Array]:
    """Return the distance to the nearest other drone, m, and its number. (..., n_drones)

    Of a large swarm, distances of ``CHUNK`` drones to all others are held at once: memory grows with the swarm, not
    with its square.
    """
    n = own[0][1].shape[-2]
    numbers = jnp.arange(n)

    def of_some(some: Array) -> tuple[Array, Array]:
        gaps = []
        for mine, at in own:
            here = jnp.take(at, some, axis=-2)[..., :, None, :]
            for part, other in own:
                apart = here - other[..., None, :, :]
                if turned is None:
                    gaps.append(distance(mine.shape, part.shape, apart, jnp.eye(3)))
                    continue
                back = jnp.swapaxes(turned, -1, -2)[..., None, :, :, :]
                inside = rotation.matvec(back, apart)
                rot = _product(back, jnp.take(turned, some, axis=-3)[..., :, None, :, :])
                gaps.append(distance(mine.shape, part.shape, inside, rot))
        gap = jnp.where(some[:, None] == numbers, jnp.inf, _nearest(gaps, own[0][1]))
        return jnp.min(gap, axis=-1), jnp.argmin(gap, axis=-1)

    if n <= CHUNK:
        return of_some(numbers)
    n_chunks = -(-n // CHUNK)
    padded = jnp.minimum(jnp.arange(n_chunks * CHUNK), n - 1).reshape(n_chunks, CHUNK)
    gap, who = jax.lax.map(of_some, padded)
    return tuple(jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], -1)[..., :n] for x in (gap, who))  # type: ignore[return-value]
