"""Contacts of free bodies: the solids that can touch, and the states after their impulses.

A carrier is anything that geoms belong to: the static scene, an object or a member (``contact_points.Carrier``).
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import combinations, product
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Simulation
from crazysim.drones.body import body_shape
from crazysim.engine.stage import vmap_worlds
from crazysim.errors import ConfigError
from crazysim.lab.bodies.manifold import N_BOX_POINTS
from crazysim.lab.bodies.pairs import (
    CORNERS,
    PairContacts,
    Solids,
    contacts_between,
    contacts_on_ground,
    contacts_on_surface,
    join_contacts,
)
from crazysim.lab.bodies.small_matrices import matmul, matvec
from crazysim.lab.bodies.solver import Bodies, Impulses, SolvedBodies, solve_contacts
from crazysim.plugins.contacts.contact_points import Carrier, find_carriers
from crazysim.plugins.effects.ground import HeightField
from crazysim.scene.collision import CollisionGeom

MAX_CONTACTS = 250_000
"""Largest number of contact points in a world; 250 drones or boxes have about as many."""
EXACT_KINDS = ("sphere", "box")
"""Kinds of geoms with the same contacts as free bodies. Geoms of other kinds touch a box only at its corners and at its
nearest point."""


class BodyContacts:
    """Contacts of the free bodies of a simulation."""

    def __init__(self, sim: Simulation, plugin: Any):
        self.plugin, self.shapes = plugin, plugin.shapes
        self.n_drones = sim.n_drones if plugin.drones else 0
        self.boxes = drone_box_extents(sim)
        self.carriers = find_carriers(sim, plugin.objects, (plugin.name,))

    def n_contacts(self, terrains: Collection[str]) -> int:
        """Return the number of contact points in a world, including points that are not in contact.

        Args:
            terrains: Names of the plugins that are terrain.
        """
        is_ball = [shape.kind == "sphere" for shape in self.shapes]
        geoms = [geom for carrier in self.carriers for geom in carrier.geoms]
        is_other_ball = [False] * self.n_drones
        is_other_ball += [geom.shape.kind == "sphere" for geom in geoms if geom.shape.kind in EXACT_KINDS]
        pairs = [*combinations(is_ball, 2), *product(is_ball, is_other_ball)]
        n = sum(1 if any(pair) else N_BOX_POINTS for pair in pairs)
        for geom in geoms:
            if geom.shape.kind not in EXACT_KINDS:
                has_only_corners = geom.shape.kind == "plane" or geom.name in terrains
                n += sum(1 if ball else len(CORNERS) + (not has_only_corners) for ball in is_ball)
        return n

    def respond(self, data: SimData) -> SimData:
        """Return the data of all worlds with the velocities after contact."""
        return vmap_worlds(self.respond_in_world)(data)

    def respond_in_world(self, data: SimData) -> SimData:
        """Return the data of one world with the velocities of bodies and drones after contact."""
        plugin, record, s = self.plugin, self.plugin.read(data), data.states
        n_free, n_drones = record.pos.shape[0], self.n_drones
        bodies, first_carrier = self._bodies(data, record), n_free + n_drones
        solids = self._solids(data, record)
        free_solids = [k for k, body in enumerate(solids.body) if body < n_free]
        groups = contacts_between(solids, self._pairs(solids, n_free))
        for k, carrier in enumerate(self.carriers):
            groups += self._contacts_on_carrier(data, solids, free_solids, carrier, first_carrier + k)
        if not groups:
            return data
        n_others = bodies.pos.shape[0] - n_free
        friction, restitution = (
            jnp.concatenate([x[:, 0], jnp.zeros(n_others, x.dtype)]) for x in (record.friction, record.restitution)
        )
        contacts = join_contacts(groups, friction, restitution)
        old_impulses = Impulses(record.normal_impulse, record.friction_impulse)
        solved = solve_contacts(bodies, contacts, old_impulses, 1 / data.core.freq, plugin.softness, plugin.iterations)
        record = states_after_contact(record, solved, slice(n_free))
        changes: Any = {
            "impulse": solved.impulse[:n_free],
            "normal_impulse": solved.contact_impulses.normal,
            "friction_impulse": solved.contact_impulses.friction,
        }
        data = plugin.write(data, record.replace(**changes))
        if n_drones:
            data = data.replace(states=states_after_contact(s, solved, slice(n_free, first_carrier)))
        return data

    def _bodies(self, data: SimData, record: Any) -> Bodies:
        dtype = record.pos.dtype
        rows = [(record.pos, record.vel, rotation.rotate(record.quat, record.ang_vel), 1 / record.mass[:, 0],
                 _rotate_diagonal(record.quat, 1 / record.inertia))]  # fmt: skip
        if self.n_drones:
            rows.append(drones_as_bodies(data))
        for carrier in self.carriers:
            pos, quat, vel, ang_vel = _carrier_motion(data, carrier)
            ang_vel = rotation.rotate(quat, ang_vel)
            rows.append((pos[None], vel[None], ang_vel[None], jnp.zeros(1, dtype), jnp.zeros((1, 3, 3), dtype)))
        return Bodies(*(jnp.concatenate(column) for column in zip(*rows, strict=True)))

    def _solids(self, data: SimData, record: Any) -> Solids:
        n_free = record.pos.shape[0]
        dtype = record.pos.dtype
        body, is_ball = list(range(n_free)), [x.kind == "sphere" for x in self.shapes]
        sizes = [np.resize(x.size, 3) for x in self.shapes]
        pos, rot = [record.pos], [rotation.matrix(record.quat)]
        if self.n_drones:
            body += range(n_free, n_free + self.n_drones)
            is_ball += [False] * self.n_drones
            sizes += list(self.boxes[:, 3:])
            drone_pos, drone_rot = drones_as_boxes(data, self.boxes)
            pos.append(drone_pos)
            rot.append(drone_rot)
        for k, carrier in enumerate(self.carriers):
            for geom in carrier.geoms:
                if geom.shape.kind in EXACT_KINDS:
                    geom_pos, geom_rot = _geom_pose(data, carrier, geom, dtype)
                    body.append(n_free + self.n_drones + k)
                    is_ball.append(geom.shape.kind == "sphere")
                    sizes.append(np.resize(geom.shape.size, 3))
                    pos.append(geom_pos[None])
                    rot.append(geom_rot[None])
        return Solids(np.array(body), np.array(is_ball), np.array(sizes), jnp.concatenate(pos), jnp.concatenate(rot))

    def _pairs(self, solids: Solids, n_free: int) -> np.ndarray:
        pairs = [pair for pair in combinations(range(len(solids.body)), 2) if solids.body[pair[0]] < n_free]
        return np.array(pairs, np.int64).reshape(-1, 2)

    def _contacts_on_carrier(
        self, data: SimData, solids: Solids, free_solids: list[int], carrier: Carrier, carrier_index: int
    ) -> list[PairContacts]:
        contacts = []
        for geom in carrier.geoms:
            terrain = data.plugins.get(geom.name) if carrier.row is None else None
            for k in free_solids if geom.shape.kind not in EXACT_KINDS else ():
                if isinstance(terrain, HeightField):
                    contacts.append(contacts_on_ground(solids, k, carrier_index, terrain.gap_at))
                else:
                    contacts.append(
                        contacts_on_surface(
                            solids, k, geom, carrier_index, _geom_pose(data, carrier, geom, solids.pos.dtype)
                        )
                    )
        return contacts


def require_few_contacts(n_contacts: int, bodies: str) -> int:
    """Return the number of contact points, or raise an error if it is too large.

    Args:
        n_contacts: Number of contact points in a world.
        bodies: Number and kind of the bodies, for the message.
    """
    if n_contacts > MAX_CONTACTS:
        raise ConfigError(
            f"expected at most {MAX_CONTACTS} contact points in a world, got {n_contacts} of {bodies}. Use fewer "
            f"bodies or fewer objects: every pair has up to {N_BOX_POINTS}."
        )
    return n_contacts


def states_after_contact(states: Any, solved: SolvedBodies, rows: slice) -> Any:
    """Return states of bodies or drones after contact.

    Args:
        states: Record with ``pos``, ``quat``, ``vel`` and ``ang_vel``. (n, ...)
        rows: Rows of these states among the solved bodies.
    """
    ang_vel, angle = (rotation.rotate_inverse(states.quat, x[rows]) for x in (solved.bodies.ang_vel, solved.rotvec))
    quat = rotation.integrate_attitude(states.quat, angle, 1.0)
    return states.replace(pos=solved.bodies.pos[rows], quat=quat, vel=solved.bodies.vel[rows], ang_vel=ang_vel)


def drones_as_bodies(data: SimData) -> Bodies:
    s, p, n = data.states, data.params, data.states.pos.shape[0]
    rot, inv_inertia = rotation.matrix(s.quat), jnp.broadcast_to(p.J_inv, (n, 3, 3))
    inv_inertia = matmul(matmul(rot, inv_inertia), jnp.swapaxes(rot, -1, -2))
    inv_mass = jnp.broadcast_to(1 / p.mass, (n, 1))[:, 0]
    return Bodies(s.pos, s.vel, rotation.rotate(s.quat, s.ang_vel), inv_mass, inv_inertia)


def drone_box_extents(sim: Simulation) -> np.ndarray:
    """Return centre and half extents of each drone's collision box, body frame, m. (n_drones, 6)"""
    return np.array([body_shape(airframe)["collision_box"] for airframe in sim.airframes])


def drones_as_boxes(data: SimData, boxes: np.ndarray) -> tuple[Array, Array]:
    """Return positions, m (n, 3), and attitudes (n, 3, 3) of the collision boxes of one world's drones.

    Args:
        data: One world.
        boxes: Centre and half extents of each drone's box, body frame, m. (n_drones, 6)
    """
    s = data.states
    return s.pos + rotation.rotate(s.quat, jnp.asarray(boxes[:, :3], s.pos.dtype)), rotation.matrix(s.quat)


def _carrier_motion(data: SimData, carrier: Carrier) -> tuple[Array, Array, Array, Array]:
    dtype = data.states.pos.dtype
    zero = jnp.zeros(3, dtype)
    if carrier.population is not None:
        record = data.plugins[carrier.population]
        return tuple(getattr(record, name)[carrier.row] for name in ("pos", "quat", "vel", "ang_vel"))  # type: ignore[return-value]
    if carrier.row is None:
        return zero, jnp.asarray([0.0, 0.0, 0.0, 1.0], dtype), zero, zero
    objects: Any = data.objects
    return objects.pos[carrier.row], objects.quat[carrier.row], objects.vel[carrier.row], zero


def _geom_pose(data: SimData, carrier: Carrier, geom: CollisionGeom, dtype: jnp.dtype) -> tuple[Array, Array]:
    pos, quat, _, _ = _carrier_motion(data, carrier)
    rot = rotation.matrix(quat)
    geom_pos = pos + matvec(rot, jnp.asarray(geom.pos, dtype))
    return geom_pos, rot if geom.rot is None else matmul(rot, jnp.asarray(geom.rot, dtype))


def _rotate_diagonal(quat: Array, diagonal: Array) -> Array:
    rot = rotation.matrix(quat)
    return matmul(rot * diagonal[:, None, :], jnp.swapaxes(rot, -1, -2))
