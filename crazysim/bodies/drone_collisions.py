"""Collisions of drones with each other."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.bodies.contacts import boxes_of_drones, drones_as_bodies, drones_as_boxes
from crazysim.bodies.pairs import Solids, between, joined
from crazysim.bodies.solver import Impulses, solve_contacts
from crazysim.core.data import SimData
from crazysim.core.plugin import Placement, Plugin, Simulation, parameter
from crazysim.core.stage import Stage, over_worlds
from crazysim.effects.core import zeros
from crazysim.errors import ConfigError
from crazysim.geometry.manifold import N_OF_BOXES
from crazysim.pytree import PyTree, leaf, on_device


class DroneCollisionsData(PyTree):
    """Parameters of the collisions, and the last impulses."""

    friction: Array = leaf("shared", 1)
    """Coulomb's coefficient between drones, 1. (1,)"""
    restitution: Array = leaf("shared", 1)
    """Ratio of the speeds after and before a bounce, 1. (1,)"""
    impulse: Array = leaf("drone", 1)
    """Impulse of the other drones in the last step, world frame, N s. (n_worlds, n_drones, 3)"""
    press: Array = leaf("world", 1)
    """Impulses along the normals of the contact points, N s, with which the next step begins.
    (n_worlds, 1, n_contacts)"""
    drag: Array = leaf("world", 2)
    """The same across the normals, world frame, N s. (n_worlds, 1, n_contacts, 3)"""


class DroneCollisions(Plugin):
    """Drones of a world that push each other where their collision boxes meet.

    All pairs are checked: it is for small swarms. Momentum and angular momentum are kept.
    """

    friction: float = parameter(default=0.6)
    """Coulomb's coefficient between drones."""
    restitution: float = parameter(default=0.2)
    """Ratio of the speeds after and before a bounce, 0 to 1."""
    softness: float = 0.03
    """Time constant with which an overlap is pushed out, s; at least two steps."""
    iterations: int = 10
    """Iterations of the solver."""
    name: str = "drone_collisions"

    def record(self, sim: Simulation) -> DroneCollisionsData:
        """Return the parameters, and no impulse."""
        n = sim.n_drones
        if n < 2:
            raise ConfigError(f"expected at least two drones, which can collide, got {n}. Use Sim(n_drones=...).")
        for name, most in (("friction", np.inf), ("restitution", 1)):
            if not 0 <= getattr(self, name) <= most:
                raise ConfigError(f"expected {name} to be from 0 to {most}, got {getattr(self, name)}")
        if self.softness < 2 / sim.data.core.freq:
            raise ConfigError(
                f"expected softness to be two steps at least, {2 / sim.data.core.freq:.4g} s, got {self.softness} s"
            )
        n_contacts = N_OF_BOXES * n * (n - 1) // 2
        return DroneCollisionsData(
            friction=on_device([self.friction]),
            restitution=on_device([self.restitution]),
            impulse=zeros(sim, 3),
            press=on_device(np.zeros((sim.n_worlds, 1, n_contacts))),
            drag=on_device(np.zeros((sim.n_worlds, 1, n_contacts, 3))),
        )

    def stages(self, sim: Simulation) -> Sequence[Placement]:
        """Return the stage of the collisions."""
        boxes, n = boxes_of_drones(sim), sim.n_drones
        pairs = np.array(list(combinations(range(n), 2)))

        def of_world(data: SimData) -> SimData:
            record, s = self.read(data), data.states
            pos, rot = drones_as_boxes(data, boxes)
            solids = Solids(np.arange(n), np.zeros(n, bool), boxes[:, 3:], pos, rot)
            each = (jnp.broadcast_to(x, (n,)) for x in (record.friction, record.restitution))
            contacts = joined(between(solids, pairs), *each)
            before, dt = Impulses(record.press, record.drag), 1 / data.core.freq
            after, at, impulse = solve_contacts(
                drones_as_bodies(data), contacts, before, dt, self.softness, self.iterations
            )
            states = s.replace(vel=after.vel, ang_vel=rotation.rotate_inverse(s.quat, after.ang_vel))
            changes: Any = {"impulse": impulse, "press": at.press, "drag": at.drag}
            return self.write(data.replace(states=states), record.replace(**changes))

        return [Placement(Stage(over_worlds(of_world), "batch"), before="increment_steps")]
