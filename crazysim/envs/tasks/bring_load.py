"""Parts that ``deliver`` and ``transport`` share: the base class, the record, the outcome and success."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.engine.pytree import PyTree, device_array, leaf
from crazysim.envs.task import TASK_RECORD_NAME, Task
from crazysim.envs.tasks.goals import with_record
from crazysim.plugins.payloads import load_pos, load_vel

SETTLED_SPEED = 0.2
"""Speed below which a load at its goal is at rest, m/s."""


class Delivery(PyTree):
    """Goal of each load, and the outcome of its flight."""

    goal: Array = leaf("drone", 1)
    """Goal of the load, world frame, m. (n_worlds, n_drones, 3)"""
    remaining_way_before: Array = leaf("drone", 0)
    """Result of ``remaining_way`` before this environment step, m. (n_worlds, n_drones)"""
    steps_at_goal: Array = leaf("drone", 0)
    """Number of consecutive physics steps up to now at which the load was at its goal. (n_worlds, n_drones)"""
    delivered: Array = leaf("drone", 0)
    """True where the load has stayed at its goal for ``hold`` seconds. (n_worlds, n_drones)"""
    crashed: Array = leaf("drone", 0)
    """True where the drone has crashed, as the task defines it. (n_worlds, n_drones)"""


@dataclass(frozen=True, kw_only=True)
class BringLoad(Task):
    """Base of tasks in which every drone brings its load to a goal and holds it there.

    Subclasses are frozen dataclasses that define ``install``, ``spawn``, ``remaining_way``, ``observe`` and
    ``rewards``. Their ``install`` adds the load, as a plugin named ``load``, and a stage of one drone that stores the
    result of ``update_outcome`` in the data. An episode ends when a drone crashes.
    """

    Record = Delivery

    tolerance: float = 0.1
    """Distance below which a load is at its goal, m."""
    hold: float = 0.5
    """Time for which the load must stay at its goal, s."""

    def remaining_way(self, data: SimData) -> Array:
        """Return the length of the remaining way to the goal, m. (...)"""
        raise NotImplementedError(self._undefined("remaining_way(data)"))

    def update_outcome(self, data: SimData, crashed: Array) -> Any:
        """Return the record after a physics step, with crashes and deliveries up to now.

        Args:
            data: Data of one drone.
            crashed: True where the drone crashes in this step. (...)
        """
        record = delivery_of(data)
        crashed = record.crashed | crashed
        steps = jnp.where(self.at_goal(data) & ~crashed, record.steps_at_goal + 1, 0)
        delivered = record.delivered | (steps >= round(self.hold * data.core.freq))
        return record.replace(crashed=crashed, steps_at_goal=steps, delivered=delivered)

    def before_step(self, data: SimData) -> SimData:
        return with_record(data, delivery_of(data).replace(remaining_way_before=self.remaining_way(data)))

    def at_goal(self, data: SimData) -> Array:
        """Return True where a load is near its goal and at rest. (...)"""
        vel = load_vel(data)
        return (rotation.dot(vel, vel)[..., 0] < SETTLED_SPEED**2) & (self.error(data) < self.tolerance)

    def terminated(self, data: SimData) -> Array:
        return jnp.any(delivery_of(data).crashed)

    def error(self, data: SimData) -> Array:
        """Return the distance of the load from its goal, m. (...)"""
        return rotation.safe_norm(delivery_of(data).goal - load_pos(data))[..., 0]

    def info(self, data: SimData) -> dict[str, Array]:
        record = delivery_of(data)
        return {"delivered": record.delivered, "crashed": record.crashed}

    def set_goal(self, data: SimData, pos: Array) -> SimData:
        return with_record(data, delivery_of(data).replace(goal=pos))

    def target(self, data: SimData) -> Array:
        return delivery_of(data).goal

    def succeeded(self, data: SimData) -> Array:
        return delivery_of(data).delivered


def delivery_of(data: SimData) -> Any:
    """Return the task's record, a ``Delivery`` or a subclass."""
    return data.plugins[TASK_RECORD_NAME]


def initial_outcome(data: SimData) -> dict[str, Array]:
    """Return the fields of ``Delivery`` for all worlds before any delivery or crash, by name."""
    pos = data.states.pos
    shape = pos.shape[:2]
    false = device_array(np.zeros(shape), bool)
    return {
        "goal": device_array(np.zeros(pos.shape), pos.dtype),
        "remaining_way_before": device_array(np.zeros(shape), pos.dtype),
        "steps_at_goal": device_array(np.zeros(shape), np.int32),
        "delivered": false,
        "crashed": false,
    }
