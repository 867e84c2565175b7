"""Contact points: the points of a drone's collision box that touch floor and objects, or may touch them next.

They are the corners of the box, and the points of its upper and lower plate that are nearest to each object.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Sequence
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Simulation
from crazysim.core.population import populations
from crazysim.drones.body import body_shape
from crazysim.errors import require
from crazysim.geometry import Shape, distance, point_distance
from crazysim.geometry.heightfield import field_gap
from crazysim.plugins.effects.ground import HeightField
from crazysim.plugins.payloads.colliders import LoadBody
from crazysim.scene.collision import CollisionGeom, DroneGeoms
from crazysim.scene.contact_report import ObjectSelection, select_bodies

DroneBoxes = Sequence[tuple[DroneGeoms, np.ndarray]]
"""For each airframe: its drones, with the centre and half extents of their collision box, body frame, m. (6,)"""
FLAT_KINDS = ("plane", "box", "cylinder")
"""Kinds of geoms with flat faces, which the corners of a drone's box touch."""
PLATE_HEIGHT_FRACTION = 0.05
"""Height of the plates at the top and at the bottom of a drone's box, as a fraction of the box's height. An object next
to the drone touches both plates."""


class Carrier(NamedTuple):
    """The static scene, an object or a member of a population, with its geoms."""

    population: str | None
    """Name of the population; None for the static scene and objects."""
    row: int | None
    """Index among the members or objects; None for the static scene."""
    geoms: tuple[CollisionGeom, ...]
    """Geoms of the carrier, in its frame."""


class Surface(NamedTuple):
    """A geom that drones and loads touch."""

    geom: CollisionGeom
    """The geom, in the frame of its carrier."""
    row: int | None
    """Index of the carrier among the members or objects; None for the static scene."""
    population: str | None = None
    """Name of the carrier's population; None for the static scene and objects."""


def find_carriers(sim: Simulation, objects: ObjectSelection, excluded: Collection[str] = ()) -> list[Carrier]:
    """Return the static scene, the chosen objects, and the chosen members of populations that have an angular velocity.

    Objects that other plugins move, such as loads, are left out.

    Args:
        objects: Handles, or names of objects; None for all.
        excluded: Names of populations that are left out.
    """
    model = sim.scene.collision_model
    carriers = [Carrier(None, None, tuple(model.floor))] if model.floor else []
    moved_kinds = {kind for plugin in sim.scene.plugins() for kind in plugin.moved_kinds or ()}
    members = populations(sim.data)
    for body in select_bodies(model, objects):
        require(
            not body.n_maps,
            f"expected objects that push drones, got {body.name!r}, of which each world has one. Use objects= to "
            f"leave the maps out, and ContactLog for contacts with them.",
        )
        kind, _, number = body.name.rpartition(":")
        if kind in excluded:
            continue
        if kind in members and hasattr(members[kind], "ang_vel"):
            carriers.append(Carrier(kind, int(number), body.geoms))
        elif kind not in moved_kinds:
            carriers.append(Carrier(None, body.row, body.geoms))
    return carriers


def find_surfaces(sim: Simulation, objects: ObjectSelection) -> list[Surface]:
    """Return the surfaces that drones and loads touch, without populations that handle contacts with drones themselves.

    Args:
        objects: Handles, or names of objects; None for all.
    """
    pushing_plugins = [plugin.name for plugin in sim.scene.plugins() if getattr(plugin, "pushes_drones", False)]
    carriers = find_carriers(sim, objects, pushing_plugins)
    return [Surface(geom, x.row, x.population) for x in carriers for geom in x.geoms]


def is_ground(surface: Surface) -> bool:
    """Return True for the plane z = 0, at which every load stops even without a contact response."""
    geom = surface.geom
    return surface.row is None and geom.shape.kind == "plane" and geom.rot is None and geom.pos[2] == 0


class ContactPoints(NamedTuple):
    """Points that are or may come into contact, in the body frame of a drone, or for loads in the world frame."""

    gap: Array
    """Distance to the surface, m, negative below it. (..., n)"""
    normal: Array
    """Outward normal of the surface. (..., n, 3)"""
    point: Array | None
    """Position on the drone relative to its centre of mass, m; None for a load, which is a point mass. (..., n, 3)"""
    vel: Array
    """Velocity of the surface, m/s. (..., n, 3)"""


def contact_points(data: SimData, surfaces: list[Surface], box: np.ndarray) -> ContactPoints:
    """Return all contact points of every drone.

    Args:
        data: Data of all drones or of one drone.
        box: Centre and half extents of the drone's collision box, body frame, m. (6,)
    """
    pos, quat = data.states.pos, data.states.quat
    dtype = pos.dtype
    # Corners of the box, and its upper and lower plate.
    corners = jnp.asarray(box[:3] + box[3:] * np.array(list(product((-1, 1), repeat=3))), dtype)
    plate = Shape("box", (*box[3:5].tolist(), PLATE_HEIGHT_FRACTION * box[5]))
    plate_centres = [
        jnp.asarray(box[:3] + np.array([0, 0, side * (1 - PLATE_HEIGHT_FRACTION) * box[5]]), dtype) for side in (-1, 1)
    ]
    drone_quat = quat[..., None, :]
    world_corners = pos[..., None, :] + rotation.rotate(drone_quat, corners)
    points = []
    for surface in surfaces:
        geom = surface.geom
        to_geom, to_world, velocity_at = _geom_frame(data, surface)
        surface_vel = (
            jnp.zeros_like(world_corners)
            if velocity_at is None
            else rotation.rotate_inverse(drone_quat, velocity_at(world_corners))
        )
        # Corners that touch terrain.
        if geom.shape.kind == "hfield":
            gap, normal = _height_above_field(data, geom, world_corners, to_geom, to_world)
            normal = rotation.rotate_inverse(drone_quat, normal)
            points.append(
                ContactPoints(gap, normal, *(jnp.broadcast_to(x, normal.shape) for x in (corners, surface_vel)))
            )
        # Corners that touch flat faces.
        if geom.shape.kind in FLAT_KINDS:
            gap, pull_back = jax.vjp(lambda p, s=geom.shape: point_distance(s, p), to_geom(world_corners, True))
            normal = rotation.rotate_inverse(drone_quat, to_world(pull_back(jnp.ones_like(gap))[0]))
            points.append(
                ContactPoints(gap, normal, *(jnp.broadcast_to(x, normal.shape) for x in (corners, surface_vel)))
            )
        # Points of the plates that are nearest to the object.
        if geom.shape.kind not in ("plane", "hfield"):
            points += [
                _nearest_plate_point(data, geom, to_geom, plate, plate_centre, velocity_at)
                for plate_centre in plate_centres
            ]
    arrays = (jnp.concatenate(xs, axis=-1 if k == 0 else -2) for k, xs in enumerate(zip(*points, strict=True)))
    return ContactPoints(*arrays)


def load_points(data: SimData, body: LoadBody, shape: Shape, surfaces: list[Surface]) -> ContactPoints:
    """Return the points of loads that are nearest to each surface.

    Args:
        data: Data of one drone or one world.
        surfaces: At least one surface.
    """
    pos, quat = body.pos[..., None, :], body.quat[..., None, :]
    axes = [rotation.rotate(quat, jnp.eye(3, dtype=pos.dtype)[k]) for k in range(3)]
    gaps, normals, vels = [], [], []
    for surface in surfaces:
        geom = surface.geom
        to_geom, to_world, velocity_at = _geom_frame(data, surface)
        if geom.shape.kind == "hfield":
            gap, normal = _height_above_field(data, geom, pos, to_geom, to_world)
            gap = gap - _extent_along(shape, jnp.stack([rotation.dot(axis, normal)[..., 0] for axis in axes], axis=-1))
        else:
            rot = jnp.stack([to_geom(axis, False) for axis in axes], axis=-1)
            gap, pull_back = jax.vjp(lambda x, s=geom.shape, f=to_geom, r=rot: distance(shape, s, f(x, True), r), pos)
            normal = pull_back(jnp.ones_like(gap))[0]
        gaps.append(gap)
        normals.append(normal)
        vels.append(jnp.zeros_like(pos) if velocity_at is None else velocity_at(pos))
    return ContactPoints(
        jnp.concatenate(gaps, axis=-1), jnp.concatenate(normals, axis=-2), None, jnp.concatenate(vels, axis=-2)
    )


def _height_above_field(
    data: SimData, geom: CollisionGeom, points: Array, to_geom: Callable, to_world: Callable
) -> tuple[Array, Array]:
    terrain = data.plugins.get(geom.name)
    if isinstance(terrain, HeightField):
        return terrain.gap_at(points)
    gap, normal = field_gap(geom.shape, to_geom(points, True))
    return gap, to_world(normal)


def _extent_along(shape: Shape, direction: Array) -> Array:
    if shape.kind == "sphere":
        return jnp.full(direction.shape[:-1], shape.size[0], direction.dtype)
    return jnp.sum(jnp.abs(direction) * jnp.asarray(shape.size, direction.dtype), axis=-1)


def _nearest_plate_point(
    data: SimData,
    geom: CollisionGeom,
    to_geom: Callable,
    shape: Shape,
    plate_centre: Array,
    velocity_at: Callable | None,
) -> ContactPoints:
    # The gradient of the gap with respect to the drone's position is the normal. The gradient with respect to the
    # drone's attitude is the cross product of the lever and the normal, which determines the torque of a normal force.
    # The position of the point along the normal affects friction only; it is on the plate's face.
    pos, quat = data.states.pos[..., None, :], data.states.quat[..., None, :]

    def pose(displacement: Array, rotvec: Array) -> tuple[Array, Array]:
        q = rotation.integrate_attitude(quat, rotvec, 1.0, normalize=False)
        columns = [to_geom(rotation.rotate(q, jnp.eye(3, dtype=pos.dtype)[k]), False) for k in range(3)]
        return to_geom(pos + displacement + rotation.rotate(q, plate_centre), True), jnp.stack(columns, axis=-1)

    frame, pull_back = jax.vjp(pose, jnp.zeros_like(pos), jnp.zeros_like(pos))
    gap, slopes = _distance_and_slopes(shape, geom.shape, *frame)
    force, torque = pull_back(slopes)
    normal = rotation.rotate_inverse(quat, force)
    reach = jnp.sum(jnp.abs(normal) * jnp.asarray(shape.size, pos.dtype), axis=-1, keepdims=True)
    point = rotation.cross(normal, torque) - reach * normal
    if velocity_at is None:
        return ContactPoints(gap, normal, point, jnp.zeros_like(normal))
    surface_vel = rotation.rotate_inverse(quat, velocity_at(pos + rotation.rotate(quat, point)))
    return ContactPoints(gap, normal, point, surface_vel)


@functools.partial(jax.jit, static_argnums=(0, 1), inline=True)
def _distance_and_slopes(shape: Shape, other: Shape, pos: Array, rot: Array) -> tuple[Array, tuple[Array, Array]]:
    # JAX traces it only once for both plates and all geoms of one shape, such as the wheels of cars.
    gap, pull_back = jax.vjp(lambda pos, rot: distance(shape, other, pos, rot), pos, rot)
    return gap, pull_back(jnp.ones_like(gap))


def _geom_frame(data: SimData, surface: Surface) -> tuple[Callable, Callable, Callable | None]:
    # The first transforms points or directions from the world frame to the geom's frame, the second directions back to
    # the world frame. The third returns the velocity of the surface at points in the world frame; None for a fixed
    # surface.
    geom, row = surface.geom, surface.row
    dtype = data.states.pos.dtype
    pos = jnp.asarray(geom.pos, dtype)
    rot = None if geom.rot is None else jnp.asarray(geom.rot, dtype)
    # Pose and velocity of the object that carries the geom.
    object_pos = object_quat = vel = world_ang_vel = None
    if surface.population is not None:
        record = data.plugins[surface.population]
        object_pos, object_quat, vel, ang_vel = (
            getattr(record, name)[..., row, :] for name in ("pos", "quat", "vel", "ang_vel")
        )
        world_ang_vel = rotation.rotate(object_quat, ang_vel)
    elif row is not None:
        objects: Any = data.objects
        object_pos, object_quat, vel = (x[..., row, :] for x in (objects.pos, objects.quat, objects.vel))

    def to_geom(x: Array, is_point: bool) -> Array:
        if object_quat is not None and object_pos is not None:
            x = rotation.rotate_inverse(object_quat[..., None, :], x - object_pos[..., None, :] if is_point else x)
        x = x - pos if is_point else x
        return x if rot is None else rotation.matvec(rot.T, x)

    def to_world(x: Array) -> Array:
        x = x if rot is None else rotation.matvec(rot, x)
        return x if object_quat is None else rotation.rotate(object_quat[..., None, :], x)

    def velocity_at(x: Array) -> Array:
        point_vel = jnp.broadcast_to(vel[..., None, :], x.shape)  # type: ignore[index]
        if world_ang_vel is None or object_pos is None:
            return point_vel
        return point_vel + rotation.cross(
            jnp.broadcast_to(world_ang_vel[..., None, :], x.shape), x - object_pos[..., None, :]
        )

    return to_geom, to_world, None if vel is None else velocity_at


def collision_boxes(sim: Simulation) -> DroneBoxes:
    drone_groups = [DroneGeoms((), drones) for drones in sim.scene.drone_groups]
    first_drones = [0 if group.drones is None else group.drones[0] for group in drone_groups]
    boxes = [body_shape(sim.airframes[k])["collision_box"] for k in first_drones]
    return list(zip(drone_groups, boxes, strict=True))


def select_airframe(results: Sequence[tuple[DroneGeoms, Any]], drone_id: Array) -> Any:
    """Return for each drone the result that belongs to its airframe.

    Args:
        results: For each airframe: its drones, with a result that was computed as if all drones had this airframe. A
            result is a tree of arrays, (k,) for one drone, else (..., n_drones, k).
        drone_id: Index of the drone, or indices of all drones. () or (n_drones,)
    """
    (_, result), *others = results
    for group, other in others:
        is_in_group: Any = group.drone_mask(drone_id)
        mask = is_in_group[..., None] if is_in_group.ndim else is_in_group
        result = jax.tree.map(lambda x, y, mask=mask: x if y is x else jnp.where(mask, y, x), result, other)
    return result
