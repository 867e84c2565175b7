"""Collisions of drones with each other."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Plugin, Simulation, StagePlacement, param, state
from crazysim.core.settings import MAX_FRICTION, MAX_ITERATIONS, MAX_SOFTNESS, check_softness, setting
from crazysim.engine.pytree import device_array
from crazysim.engine.stage import Stage, vmap_worlds
from crazysim.errors import ConfigError
from crazysim.lab.bodies.manifold import N_BOX_POINTS
from crazysim.lab.bodies.pairs import Solids, contacts_between, join_contacts
from crazysim.lab.bodies.rigid_bodies import (
    drone_box_extents,
    drones_as_bodies,
    drones_as_boxes,
    require_few_contacts,
    states_after_contact,
)
from crazysim.lab.bodies.solver import Impulses, solve_contacts


class DroneCollisions(Plugin):
    """Contacts between the drones of a world, which push each other where their collision boxes overlap.

    All pairs are checked, which suits small swarms only. Momentum and angular momentum are conserved.
    """

    friction: Param = param(default=0.6, scope="shared", low=0.0, high=MAX_FRICTION, shapes=((),))
    """Coulomb's coefficient between drones, 1. (1,)"""
    restitution: Param = param(default=0.2, scope="shared", low=0.0, high=1.0, shapes=((),))
    """Ratio of the speeds after and before a bounce, 0 to 1. (1,)"""
    softness: float = setting(default=0.03, positive=True, high=MAX_SOFTNESS)
    """Time constant with which an overlap is pushed out, s; at least two steps."""
    iterations: int = setting(default=12, low=1, high=MAX_ITERATIONS)
    """Iterations of the solver."""
    impulse: Array = state((3,))
    """Impulse of the other drones in the last step, world frame, N s. (n_worlds, n_drones, 3)"""
    normal_impulse: Array = state(("contacts",), scope="world")
    """Impulses along the normals of the contact points, N s; the initial impulses of the next step.
    (n_worlds, 1, n_contacts)"""
    friction_impulse: Array = state(("contacts", 3), scope="world")
    """Impulses across the normals, world frame, N s; the initial impulses of the next step.
    (n_worlds, 1, n_contacts, 3)"""
    name: str = "drone_collisions"

    def bind(self, sim: Simulation) -> DroneCollisions:
        n = sim.n_drones
        if n < 2:
            raise ConfigError(f"expected at least two drones, which can collide, got {n}. Use Sim(n_drones=...).")
        check_softness(sim.data.core.freq, self.softness)
        n_contacts = require_few_contacts(N_BOX_POINTS * n * (n - 1) // 2, f"{n} drones")
        return self.with_arrays(
            sim,
            normal_impulse=device_array(np.zeros((sim.n_worlds, 1, n_contacts))),
            friction_impulse=device_array(np.zeros((sim.n_worlds, 1, n_contacts, 3))),
        )

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        boxes, n = drone_box_extents(sim), sim.n_drones
        pairs = np.array(list(combinations(range(n), 2)))

        def solve_world(data: SimData) -> SimData:
            record = self.read(data)
            pos, rot = drones_as_boxes(data, boxes)
            solids = Solids(np.arange(n), np.zeros(n, bool), boxes[:, 3:], pos, rot)
            materials = (jnp.broadcast_to(x, (n,)) for x in (record.friction, record.restitution))
            contacts = join_contacts(contacts_between(solids, pairs), *materials)
            old_impulses, dt = Impulses(record.normal_impulse, record.friction_impulse), 1 / data.core.freq
            solved = solve_contacts(drones_as_bodies(data), contacts, old_impulses, dt, self.softness, self.iterations)
            changes: Any = {
                "impulse": solved.impulse,
                "normal_impulse": solved.contact_impulses.normal,
                "friction_impulse": solved.contact_impulses.friction,
            }
            states = states_after_contact(data.states, solved, slice(n))
            return self.write(data.replace(states=states), record.replace(**changes))

        solve = Stage(vmap_worlds(solve_world), "batch", unfused_reason="it solves the contacts of all worlds at once")
        return [StagePlacement(solve, before="measurements")]
