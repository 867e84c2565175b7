"""Contacts of loads and hooks: with surfaces of the scene, with drones, and with each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Simulation
from crazysim.geometry import Shape, distance
from crazysim.plugins.contacts.contact_points import DroneBoxes, Surface, load_points, select_airframe
from crazysim.plugins.contacts.impulse import (
    BOUNCE_SPEED,
    MAX_PUSH_SPEED,
    STICKING_SPEED,
    Material,
    inertia_matrix,
    velocity_after_contact,
)
from crazysim.plugins.payloads.colliders import Collider, CollidingPlugin

SELF_GAP = 1e3
"""Distance that is assumed between a body and itself, m, so that it never touches itself."""


def load_plugins(sim: Simulation) -> list[CollidingPlugin]:
    """Return the plugins with loads that are objects of the scene and can collide."""
    names = () if sim.data.objects is None else sim.data.objects.names
    return [p for p in sim.scene.plugins() if isinstance(p, CollidingPlugin) and f"{p.name}:0" in names]


def load_names(sim: Simulation, plugins: Sequence[CollidingPlugin]) -> set[str]:
    """Return the names of the plugins' loads and hooks in the scene."""
    kinds = {kind for p in plugins for kind in p.solid_kinds}
    return {name for name in (sim.data.objects.names if plugins else ()) if name.rpartition(":")[0] in kinds}


def resolve_surface_contacts(
    data: SimData, collider: Collider, surfaces: list[Surface], material: Material, iterations: int
) -> SimData:
    """Return the data of one drone or one world with the velocities of bodies after the impulses of surfaces.

    The velocity after contact does not depend on the mass. The effect of the impulse on a drone with a taut link
    follows in the next step, from the constraint.
    """
    body = collider.body(data)
    # A load that the drones of a world share has the material of the first drone.
    material = Material(*(x[:1] if x.ndim > 1 else x for x in material))
    points, unit_mass = load_points(data, body, collider.shape, surfaces), jnp.ones_like(body.mass)
    vel = velocity_after_contact(points, body.vel, unit_mass, inertia_matrix(unit_mass), material, iterations)
    vel = vel if body.exists is None else jnp.where(body.exists[..., None], vel, body.vel)
    return collider.with_vel(data, vel)


def resolve_drone_contacts(
    data: SimData, collider: Collider, material: Material, boxes: DroneBoxes
) -> tuple[SimData, Array]:
    """Return one world after the impulses between loads or hooks and drones, and the impulses on the drones, N s.

    The impulse acts on both bodies at the load's centre, which conserves momentum and angular momentum. The normal
    impulse, with restitution, is computed first, and then friction, limited by Coulomb's law and by the impulse that
    stops the slip. Each impulse is divided by the larger number of contacts of its two bodies, so that all impulses
    together create no energy. A load and a drone that a rod joins do not touch.

    Args:
        data: Data of one world.
        collider: The loads, or the hooks.
        boxes: Collision boxes of the drones.
    """
    body, s, p = collider.body(data), data.states, data.params
    mass, quat = body.mass[:, None], s.quat[None]
    # Axes are (n_loads, n_drones), vectors are in the body frame of the drone.
    lever = rotation.rotate_inverse(quat, body.pos[:, None] - s.pos)
    eye = jnp.eye(3, dtype=lever.dtype)
    axes = [rotation.rotate_inverse(quat, rotation.rotate(body.quat[:, None], eye[k])) for k in range(3)]
    shape, rot = collider.shape, jnp.stack(axes, axis=-1)

    def to_box(box: np.ndarray) -> tuple[Array, Array]:
        target = Shape("box", tuple(map(float, box[3:])))
        gap, pull_back = jax.vjp(lambda x: distance(shape, target, x - jnp.asarray(box[:3], x.dtype), rot), lever)
        return gap[..., None], pull_back(jnp.ones_like(gap))[0]

    gap, normal = select_airframe([(drone_group, to_box(box)) for drone_group, box in boxes], data.core.drone_id)
    gap = gap[..., 0]
    is_touching = (gap < 0) & ~collider.joined_mask(data)
    is_touching = is_touching if body.exists is None else is_touching & body.exists[:, None]

    def response(change: Array) -> Array:
        ang_vel_change = rotation.matvec(p.J_inv, rotation.cross(lever, change))
        return change + mass * (change / p.mass + rotation.cross(ang_vel_change, lever))

    vel = rotation.rotate_inverse(quat, body.vel[:, None] - s.vel) - rotation.cross(s.ang_vel[None], lever)
    load_vel_change = velocity_change(gap, normal, vel, material, response)
    n_load, n_drone = (jnp.sum(is_touching, axis=axis, keepdims=True, dtype=gap.dtype) for axis in (1, 0))
    weight = jnp.where(is_touching, 1 / jnp.maximum(jnp.maximum(n_load, n_drone), 1.0), 0.0)[..., None]
    load_vel_change = weight * load_vel_change

    ang_vel_change = rotation.matvec(p.J_inv, rotation.cross(lever, load_vel_change))
    load_vel_change = rotation.rotate(quat, load_vel_change)
    impulse = -jnp.sum(mass * load_vel_change, axis=0)
    states = s.replace(vel=s.vel + impulse / p.mass, ang_vel=s.ang_vel - jnp.sum(mass * ang_vel_change, axis=0))
    data = collider.with_vel(data, body.vel + jnp.sum(load_vel_change, axis=1))
    return data.replace(states=states), impulse


def velocity_change(
    gap: Array, normal: Array, vel: Array, material: Material, response: Callable[[Array], Array]
) -> Array:
    """Return the change of a body's velocity by a contact with another body, m/s. (..., 3)

    Args:
        gap: Distance of the bodies, negative where they overlap, m. (...)
        normal: Outward normal of the other body. (..., 3)
        vel: Velocity relative to the other body, m/s. (..., 3)
        response: Function from a change of the body's velocity to the change of the relative velocity, both m/s.
    """
    separation_speed = rotation.dot(vel, normal)
    push_speed = jnp.clip(-gap[..., None] / material.softness, 0.0, MAX_PUSH_SPEED)
    target_speed = jnp.where(separation_speed < -BOUNCE_SPEED, -material.restitution * separation_speed, push_speed)
    response_along = response(normal)
    # The product is at least one, except where the normal is zero, between balls with the same centre.
    speed = jnp.maximum(target_speed - separation_speed, 0.0) / jnp.maximum(rotation.dot(normal, response_along), 1.0)
    vel = vel + speed * response_along
    slip = vel - rotation.dot(vel, normal) * normal
    slip_speed = rotation.safe_norm(slip)
    slip_direction = slip / (slip_speed + STICKING_SPEED)
    friction_speed = jnp.minimum(
        material.friction * speed, slip_speed / jnp.maximum(rotation.dot(slip_direction, response(slip_direction)), 1.0)
    )
    return speed * normal - friction_speed * slip_direction


class _VelocityChanges(NamedTuple):
    """Changes of velocity by the contacts between two groups of bodies."""

    is_touching: Array
    """Whether a body of the first group touches a body of the second group. (n, m)"""
    first: Array
    """Change of the velocity of the body of the first group, m/s. (n, m, 3)"""
    second: Array
    """Change of the velocity of the body of the second group, m/s. (n, m, 3)"""


def resolve_load_contacts(data: SimData, colliders: Sequence[Collider], material: Material) -> SimData:
    """Return one world after the impulses of loads and hooks on each other.

    Loads and hooks are point masses, so an impulse changes velocities only. Momentum is conserved. The impulse has a
    normal part with restitution, and friction, limited by Coulomb's law and by the impulse that stops the slip. Each
    impulse is divided by the larger number of contacts of its two bodies, so that all impulses together create no
    energy. The effect on a drone with a taut link follows in the next step, from the constraint.

    Args:
        data: Data of one world.
        colliders: Loads, and hooks.
    """
    index_pairs = list(combinations_with_replacement(range(len(colliders)), 2))
    material = Material(*(x.reshape(-1)[:1] for x in material))
    contacts = {
        (a, b): _pair_velocity_changes(data, colliders[a], colliders[b], material, is_same_kind=a == b)
        for a, b in index_pairs
    }
    n_touches: list[Any] = [
        sum(pairs.is_touching.sum(axis=1, dtype=np.int32) for (a, _), pairs in contacts.items() if a == k)
        + sum(pairs.is_touching.sum(axis=0, dtype=np.int32) for (_, b), pairs in contacts.items() if b == k)
        for k in range(len(colliders))
    ]
    changes: list[Array | float] = [0.0] * len(colliders)
    for (a, b), pairs in contacts.items():
        n = jnp.maximum(n_touches[a][:, None], n_touches[b][None])
        weight = jnp.where(pairs.is_touching, 1 / jnp.maximum(n, 1), 0.0)[..., None].astype(pairs.first.dtype)
        changes[a] = changes[a] + jnp.sum(weight * pairs.first, axis=1)
        changes[b] = changes[b] + jnp.sum(weight * pairs.second, axis=0)
    vels = [collider.body(data).vel + change for collider, change in zip(colliders, changes, strict=True)]
    for collider, vel in zip(colliders, vels, strict=True):
        data = collider.with_vel(data, vel)
    return data


def _pair_velocity_changes(
    data: SimData, first: Collider, second: Collider, material: Material, is_same_kind: bool
) -> _VelocityChanges:
    a, b = first.body(data), second.body(data)
    second_quat = b.quat[None]
    offset = rotation.rotate_inverse(second_quat, a.pos[:, None] - b.pos[None])
    if is_same_kind:
        offset = offset + SELF_GAP * np.eye(len(offset), dtype=offset.dtype)[..., None]
    eye = jnp.eye(3, dtype=offset.dtype)
    axes = [rotation.rotate_inverse(second_quat, rotation.rotate(a.quat[:, None], eye[k])) for k in range(3)]
    rot = jnp.stack(axes, axis=-1)
    gap, pull_back = jax.vjp(lambda x: distance(first.shape, second.shape, x, rot), offset)
    normal = rotation.rotate(second_quat, pull_back(jnp.ones_like(gap))[0])
    is_touching = gap < 0
    if is_same_kind:
        is_touching = is_touching & np.triu(np.ones(gap.shape, bool), 1)
    for is_present in (None if a.exists is None else a.exists[:, None], b.exists):
        is_touching = is_touching if is_present is None else is_touching & is_present

    vel = a.vel[:, None] - b.vel[None]
    change = velocity_change(gap, normal, vel, material, lambda change: change)
    total_mass = a.mass[:, None] + b.mass[None]
    inv_total_mass = 1 / jnp.where(total_mass > 0, total_mass, 1.0)
    return _VelocityChanges(
        is_touching, b.mass[None] * inv_total_mass * change, -a.mass[:, None] * inv_total_mass * change
    )
