"""Courses: waypoints that a drone passes, hoops in their order or points in any order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import StagePlacement, state
from crazysim.core.settings import setting
from crazysim.envs.tasks.goals import ProgressTask
from crazysim.sim.sim import Sim


class Course(ProgressTask):
    """Base of ``HoopTask`` and ``VisitTask``: waypoints, and which of them each drone has passed."""

    n_waypoints: ClassVar[int] = 1
    """Number of waypoints of a drone."""

    waypoints: Array = state(("waypoints", 3))
    """Waypoints of the drone, m."""
    passed: Array = state(("waypoints",), dtype=bool)
    """True for waypoints that the drone has passed."""

    def add_states(self, sim: Sim, placements: Sequence[StagePlacement] = (), **initial: Any) -> None:
        waypoints, passed = np.zeros((self.n_waypoints, 3)), np.zeros(self.n_waypoints)
        super().add_states(sim, placements, waypoints=waypoints, passed=passed, **initial)

    def ways(self, data: SimData) -> Array:
        """Return the vectors from each drone to its waypoints, m; zero for waypoints that it has passed.

        Returns:
            (n_drones, n_waypoints, 3)
        """
        course = self.read(data)
        return jnp.where(course.passed[..., None], 0.0, course.waypoints - data.states.pos[:, None])


class HoopTask(Course):
    """Base of tasks in which drones fly through hoops in their order, and hover at a goal behind the last.

    A class sets ``n_waypoints``, the number of hoops, and defines ``spawn``, which ends with ``set_course``,
    ``observe``, ``rewards`` and ``terminated``. A hoop counts as passed when the drone crosses its plane and was
    within the opening after the first physics step behind it; otherwise the drone has ``missed`` it. Only the next
    hoop is checked. If its plane is behind the drone, the drone has to come round. The error is the length of the way
    through the middles of all hoops that are left, to the goal. For gates with frames that drones can touch, see
    ``crazysim.envs.tasks.race``.
    """

    radius: float = setting(default=0.5, positive=True)
    """Radius of the hoops, m."""

    goal: Array = state((3,))
    """Goal of the drone, m."""
    heading: Array = state(("waypoints", 2))
    """Unit vector along which each hoop is flown through, x and y. (n_waypoints, 2)"""
    approached: Array = state(("waypoints",), dtype=bool)
    """True for hoops whose plane was ahead of the drone since they were the next."""
    missed: Array = state((), dtype=bool)
    """True where the drone has flown past a hoop."""

    def add_states(self, sim: Sim, placements: Sequence[StagePlacement] = (), **initial: Any) -> None:
        heading, approached = np.zeros((self.n_waypoints, 2)), np.zeros(self.n_waypoints)
        super().add_states(sim, placements, heading=heading, approached=approached, **initial)

    def set_course(self, data: SimData, hoops: Array, goal: Array, yaw: ArrayLike = 0.0) -> SimData:
        """Return the data with hoops and goals, at the start of an episode.

        Args:
            data: The world.
            hoops: Middles of each drone's hoops, m. (n_drones, n_waypoints, 3)
            goal: Goal of each drone, m. (n_drones, 3)
            yaw: Direction in which a hoop is flown through, rad; zero is along x. () or (n_drones, n_waypoints)
        """
        heading = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
        return self.write(data, waypoints=hoops, goal=goal, heading=jnp.broadcast_to(heading, (*hoops.shape[:-1], 2)))

    def set_goal(self, data: SimData, pos: Array) -> SimData:
        return self.write(data, goal=pos)

    def is_inside(self, offset: Array) -> Array:
        """Return True where a drone is within the opening of a hoop; override it for openings that are not round.

        Args:
            offset: Position of the drone relative to the middle of each hoop: ahead, left and up, m. (n_waypoints, 3)

        Returns:
            (n_waypoints,)
        """
        return jnp.sum(offset[..., 1:] ** 2, axis=-1) < self.radius**2

    def after_substep(self, data: SimData) -> SimData:
        course = self.read(data)
        x, y, z = jnp.moveaxis(data.states.pos - course.waypoints, -1, 0)
        cos, sin = course.heading[..., 0], course.heading[..., 1]
        offset = jnp.stack([cos * x + sin * y, cos * y - sin * x, z], axis=-1)
        is_behind, index = offset[..., 0] > 0, np.arange(self.n_waypoints, dtype=np.int32)
        crossed = (index == jnp.sum(course.passed, dtype=jnp.int32)) & course.approached & is_behind
        is_inside = self.is_inside(offset)
        passed = course.passed | (crossed & is_inside)
        approached = course.approached | ((index == jnp.sum(passed, dtype=jnp.int32)) & ~is_behind)
        missed = course.missed | jnp.any(crossed & ~is_inside)
        return self.write(data, approached=approached, passed=passed, missed=missed)

    def ways(self, data: SimData) -> Array:
        """Return the vectors from each drone to its hoops and its goal, m; zero for hoops that it has passed.

        Returns:
            (n_drones, n_waypoints + 1, 3)
        """
        to_goal = (self.read(data).goal - data.states.pos)[:, None]
        return jnp.concatenate([super().ways(data), to_goal], axis=1)

    def legs(self, data: SimData) -> Array:
        """Return the legs of the way that is left, m: from the drone to the next hoop, on to the one after it, ..., to
        the goal; zero for legs that end at a hoop that was passed. (n_drones, n_waypoints + 1, 3)
        """
        ways = self.ways(data)
        return ways - jnp.concatenate([jnp.zeros_like(ways[:, :1]), ways[:, :-1]], axis=1)

    def error(self, data: SimData) -> Array:
        return jnp.sum(rotation.safe_norm(self.legs(data))[..., 0], axis=-1)

    def rings(self, data: SimData) -> Array:
        course = self.read(data)
        zero = jnp.zeros_like(course.waypoints[..., :1])
        rings = jnp.concatenate([course.waypoints, course.heading, zero, zero + self.radius], axis=-1)
        return rings.reshape(-1, 7)


class VisitTask(Course):
    """Base of tasks in which drones come within ``tolerance`` of points, in any order.

    A class sets ``n_waypoints``, the number of points, and defines ``spawn``, which ends with
    ``self.write(..., waypoints=points)``, ``observe``, ``rewards`` and ``terminated``. A drone succeeds when it has
    passed all its points. Progress counts points: it is 1 in a step in which a point is reached.
    """

    def after_substep(self, data: SimData) -> SimData:
        course = self.read(data)
        square_distance = jnp.sum((course.waypoints - data.states.pos) ** 2, axis=-1)
        return self.write(data, passed=course.passed | (square_distance < self.tolerance**2))

    def remaining_way(self, data: SimData) -> Array:
        return self.n_waypoints - self.n_passed(data)

    def n_passed(self, data: SimData) -> Array:
        """Return the number of points that each drone has passed. (n_drones,)"""
        return jnp.sum(1.0 * self.read(data).passed, axis=-1)

    def nearest(self, data: SimData) -> Array:
        """Return the distance to the nearest point that is left, m; zero if none is. (n_drones,)"""
        distance = jnp.where(self.read(data).passed, jnp.inf, rotation.safe_norm(self.ways(data))[..., 0])
        return jnp.where(self.succeeded(data), 0.0, jnp.min(distance, axis=-1))

    def error(self, data: SimData) -> Array:
        return self.nearest(data) + self.n_waypoints - self.n_passed(data)

    def succeeded(self, data: SimData) -> Array:
        return jnp.all(self.read(data).passed, axis=-1)

    def target(self, data: SimData) -> Array:
        return jnp.where(self.read(data).passed[..., None], jnp.nan, self.read(data).waypoints)
