"""Contacts of loads: with surfaces of the scene, and with drones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Simulation
from crazysim.geometry import Shape, distance
from crazysim.payloads.body import Colliding
from crazysim.scene.contact_points import Surface, load_points
from crazysim.scene.drone_boxes import Boxes, of_kind
from crazysim.scene.impulse import FASTEST_PUSH, SLOW, STICKING, Material, after_contact, inertia_matrix


def loads_of(sim: Simulation) -> list[Any]:
    """Return the plugins whose loads are objects of the scene, and collide."""
    names = () if sim.data.objects is None else sim.data.objects.names
    return [p for p in sim.scene.plugins() if isinstance(p, Colliding) and f"{p.name}:0" in names]


def names_of(sim: Simulation, plugins: Sequence[Any]) -> set[str]:
    """Return the names of the loads of some plugins in the scene."""
    kinds = {p.name for p in plugins}
    return {name for name in (sim.data.objects.names if plugins else ()) if name.rpartition(":")[0] in kinds}


def stop_loads(data: SimData, plugin: Any, surfaces: list[Surface], material: Material, iterations: int) -> SimData:
    """Return the data with the velocities of loads after the impulses of surfaces; of one drone or one world.

    The velocity after contact does not depend on the mass. What the impulse does to a drone on a taut link follows in
    the next step, from the constraint.
    """
    body = plugin.body(data)
    # A load of a whole world takes the material of its first drone.
    material = Material(*(x[:1] if x.ndim > 1 else x for x in material))
    points, one = load_points(data, body, plugin.shape(), surfaces), jnp.ones_like(body.mass)
    vel = after_contact(points, body.vel, one, inertia_matrix(one), material, iterations)
    return plugin.with_vel(data, vel)


def hit_drones(data: SimData, plugin: Any, material: Material, boxes: Boxes) -> tuple[SimData, Any]:
    """Return one world after the impulses between loads and drones, and the impulses on the drones, N s.

    The impulse acts at the load's centre, on both: momentum and angular momentum are kept. First the normal impulse,
    with restitution, then friction, limited by Coulomb's law and by what stops the slip. Where a body has several
    contacts, each counts by its share, so that together they create no energy. A load and a drone that a rod joins do
    not touch.

    Args:
        data: One world.
        plugin: Plugin with the loads.
        material: Parameters of the contacts.
        boxes: Collision boxes of the drones.
    """
    body, s, p = plugin.body(data), data.states, data.params
    mass, quat = body.mass[:, None], s.quat[None]
    # Axes are (n_loads, n_drones), vectors are in the body frame of the drone.
    lever = rotation.rotate_inverse(quat, body.pos[:, None] - s.pos)
    eye = jnp.eye(3, dtype=lever.dtype)
    axes = [rotation.rotate_inverse(quat, rotation.rotate(body.quat[:, None], eye[k])) for k in range(3)]
    shape, rot = plugin.shape(), jnp.stack(axes, axis=-1)

    def to_box(box: np.ndarray) -> tuple[Array, Array]:
        target = Shape("box", tuple(map(float, box[3:])))
        gap, pull = jax.vjp(lambda x: distance(shape, target, x - jnp.asarray(box[:3], x.dtype), rot), lever)
        return gap[..., None], pull(jnp.ones_like(gap))[0]

    gap, normal = of_kind([(kind, to_box(box)) for kind, box in boxes], data.core.drone_id)
    gap = gap[..., 0]
    touches = (gap < 0) & ~plugin.joined(data)

    def response(change: Any) -> Any:
        """Return the change of the relative velocity at the lever where the load's velocity changes, m/s."""
        turned = rotation.matvec(p.J_inv, rotation.cross(lever, change))
        return change + mass * (change / p.mass + rotation.cross(turned, lever))

    vel = rotation.rotate_inverse(quat, body.vel[:, None] - s.vel) - rotation.cross(s.ang_vel[None], lever)
    out = rotation.dot(vel, normal)
    pushed_out = jnp.clip(-gap[..., None] / material.softness, 0.0, FASTEST_PUSH)
    wanted = jnp.where(out < -SLOW, -material.restitution * out, pushed_out)
    moved = response(normal)
    speed = jnp.maximum(wanted - out, 0.0) / rotation.dot(normal, moved)
    vel = vel + speed * moved
    slip = vel - rotation.dot(vel, normal) * normal
    fast = rotation.safe_norm(slip)
    along = slip / (fast + STICKING)
    brake = jnp.minimum(material.friction * speed, fast / jnp.maximum(rotation.dot(along, response(along)), 1.0))
    n_load, n_drone = (jnp.sum(touches, axis=axis, keepdims=True, dtype=gap.dtype) for axis in (1, 0))
    share = jnp.where(touches, 1 / jnp.maximum(jnp.maximum(n_load, n_drone), 1.0), 0.0)[..., None]
    change = share * (speed * normal - brake * along)

    turned = rotation.matvec(p.J_inv, rotation.cross(lever, change))
    change = rotation.rotate(quat, change)
    impulse = -jnp.sum(mass * change, axis=0)
    states = s.replace(vel=s.vel + impulse / p.mass, ang_vel=s.ang_vel - jnp.sum(mass * turned, axis=0))
    data = plugin.with_vel(data, body.vel + jnp.sum(change, axis=1))
    return data.replace(states=states), impulse
