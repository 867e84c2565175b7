"""Parts that ``deliver`` and ``transport`` share: the base class, the record, the outcome and success."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import state
from crazysim.envs.tasks.goals import OutcomeTask, ProgressTask
from crazysim.plugins.payloads import load_pos, load_vel

SETTLED_SPEED = 0.2
"""Speed below which a load at its goal is at rest, m/s."""


class BringLoad(ProgressTask, OutcomeTask):
    """Base of tasks in which every drone brings its load to a goal and holds it there.

    Subclasses define ``install``, ``spawn``, ``remaining_way``, ``observe`` and
    ``rewards``. Their ``install`` adds the load, as a plugin named ``load``, and a stage of one drone that stores the
    result of ``update_outcome``. An episode ends when a drone crashes.
    """

    outcomes = ("delivered", "crashed")

    tolerance: float = 0.1
    """Distance below which a load is at its goal, m."""
    hold: float = 0.5
    """Time for which the load must stay at its goal, s."""
    goal: Array = state((3,))
    """Goal of the load, world frame, m."""
    steps_at_goal: Array = state((), dtype=np.int32)
    """Number of consecutive physics steps up to now at which the load was at its goal."""

    def remaining_way(self, data: SimData) -> Array:
        """Return the length of the remaining way to the goal, m. (...)"""
        raise NotImplementedError(self._undefined("remaining_way(data)"))

    def update_outcome(self, data: SimData, crashes: Array) -> SimData:
        """Return the data of one drone after a physics step, with crashes and deliveries up to now."""
        record = self.read(data)
        crashed = record.failure | crashes
        steps = jnp.where(self.at_goal(data) & ~crashed, record.steps_at_goal + 1, 0)
        delivered = record.success | (steps >= round(self.hold * data.core.freq))
        return self.write(data, failure=crashed, steps_at_goal=steps, success=delivered)

    def at_goal(self, data: SimData) -> Array:
        """Whether a load is near its goal and at rest. (...)"""
        vel = load_vel(data)
        return (rotation.dot(vel, vel)[..., 0] < SETTLED_SPEED**2) & (self.error(data) < self.tolerance)

    def terminated(self, data: SimData) -> Array:
        return jnp.any(self.read(data).failure)

    def error(self, data: SimData) -> Array:
        return rotation.safe_norm(self.read(data).goal - load_pos(data))[..., 0]

    def set_goal(self, data: SimData, pos: Array) -> SimData:
        return self.write(data, goal=pos)
