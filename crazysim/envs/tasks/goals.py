"""Parts that tasks share: goals, common observations, limits of the arena, contacts between drones."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import StagePlacement, state
from crazysim.engine.stage import stage
from crazysim.envs.task import TASK_RECORD_NAME, Task
from crazysim.sim.sim import Sim

FLOOR = 0.02
"""Height of the centre of mass below which a drone has crashed, m."""


class GoalTask(Task):
    """Base of tasks in which every drone flies to its own goal, within an arena around the z axis.

    Subclasses define ``spawn`` and ``rewards``.
    """

    half_width: ClassVar[float]
    """Largest distance from the z axis along x and y, m."""
    height: ClassVar[float]
    """Height of the arena, m."""

    goal: Array = state((3,))
    """Goal of the drone, world frame, m."""

    def set_goal(self, data: SimData, pos: Array) -> SimData:
        return self.write(data, goal=pos)

    def observe(self, data: SimData) -> dict[str, Array]:
        return state_of(data) | {"difference_to_goal": self.read(data).goal - data.states.pos}

    def crashed(self, data: SimData) -> Array:
        """Whether a drone has left the arena. (..., n_drones)"""
        return out_of_bounds(data, self.half_width, self.height)

    def terminated(self, data: SimData) -> Array:
        return jnp.any(self.crashed(data))

    def error(self, data: SimData) -> Array:
        return rotation.safe_norm(self.read(data).goal - data.states.pos)[..., 0]


class ProgressTask(Task):
    """Base of tasks that reward progress: the way that is left before an environment step minus that after it.

    The way that is left is the error, unless the class defines ``remaining_way``. A class that extends this and another
    base names this one first.
    """

    remaining_way_before: Array = state(())
    """Result of ``remaining_way`` before this environment step."""

    def remaining_way(self, data: SimData) -> Array:
        """Return the length of the way that is left, m. (n_drones,)"""
        return self.error(data)

    def before_step(self, data: SimData) -> SimData:
        return self.write(super().before_step(data), remaining_way_before=self.remaining_way(data))

    def progress(self, data: SimData) -> Array:
        """Return how much shorter the way has become in this environment step, m. (n_drones,)"""
        return self.read(data).remaining_way_before - self.remaining_way(data)


class OutcomeTask(Task):
    """Base of tasks in which the flight of each drone ends by success or failure, and the episode when all have ended.

    Subclasses define ``install``, ``spawn``, ``observe``, ``rewards`` and ``error``, and call ``judge`` after every
    physics step.
    """

    outcomes: ClassVar[tuple[str, str]]
    """Names of success and failure in ``info``."""

    success: Array = state((), dtype=bool)
    """Whether the drone has done its task."""
    failure: Array = state((), dtype=bool)
    """Whether the drone has failed."""
    flight_over_before: Array = state((), dtype=bool)
    """Whether the flight was over before this environment step."""

    def judge(self, data: SimData, succeeds: Array, fails: Array) -> SimData:
        """Return data in which flights that succeed or fail in a physics step have ended; failing counts first."""
        record = self.read(data)
        failure = record.failure | (~record.success & fails)
        return self.write(data, failure=failure, success=record.success | (~failure & succeeds))

    def before_step(self, data: SimData) -> SimData:
        return self.write(data, flight_over_before=flight_over(self.read(data)))

    def terminated(self, data: SimData) -> Array:
        return jnp.all(flight_over(self.read(data)))

    def info(self, data: SimData) -> dict[str, Array]:
        return dict(zip(self.outcomes, (self.read(data).success, self.read(data).failure), strict=True))

    def succeeded(self, data: SimData) -> Array:
        return self.read(data).success


def flight_over(record: Any) -> Array:
    """Whether a drone has succeeded or failed, by the states of an ``OutcomeTask``."""
    return record.success | record.failure


def state_of(data: SimData) -> dict[str, Array]:
    """Return the state of each drone: ``pos``, m, ``rot``, rotation matrix, ``vel``, m/s, and ``ang_vel``, rad/s.

    Returns:
        (..., n_drones, k) each
    """
    s = data.states
    matrix = rotation.matrix(s.quat)
    return {
        "pos": s.pos,
        "rot": matrix.reshape(*matrix.shape[:-2], 9),
        "vel": s.vel,
        "ang_vel": s.ang_vel,
    }


def motion_of(data: SimData) -> dict[str, Array]:
    """Return attitude, velocities and height, the observations of tasks whose policies use a camera.

    Returns:
        ``ang_vel``: angular velocity, rad/s; ``heading``: horizontal unit vector along the yaw, world frame, x and y;
        ``heading_vel``: velocity ahead, left and up, m/s; ``height``, m; ``up``: upward unit vector, body frame.
        (..., n_drones, k) each
    """
    s = data.states
    return {
        "ang_vel": s.ang_vel,
        "heading": rotation.heading(s.quat)[0][..., :2],
        "heading_vel": to_heading(data, s.vel),
        "height": s.pos[..., 2:],
        "up": rotation.matrix(s.quat)[..., 2, :],
    }


def to_heading(data: SimData, vector: Array) -> Array:
    """Return a vector of the world frame in the frame of each drone's heading: ahead, left, up. (..., 3)"""
    ahead, left = rotation.heading(data.states.quat)
    parts = [jnp.sum(vector * axis, axis=-1) for axis in (ahead, left)]
    return jnp.stack([*parts, vector[..., 2]], axis=-1)


def on_floor(data: SimData) -> Array:
    """Whether a drone is on or below the floor. (..., n_drones)"""
    return data.states.pos[..., 2] < FLOOR


def out_of_bounds(data: SimData, half_width: float, height: float) -> Array:
    """Whether a drone is on the floor, too high, or too far from the z axis. (..., n_drones)"""
    pos = data.states.pos
    return on_floor(data) | (pos[..., 2] > height) | jnp.any(jnp.abs(pos[..., :2]) > half_width, axis=-1)


def pick_entry(x: Array | np.ndarray, index: Array) -> Array:
    """Return the entry with an index, by masking all entries, which is faster than indexing. (..., k)

    Args:
        x: Entries. (..., n, k)
        index: Index of the entry. (...)
    """
    is_entry = index[..., None, None] == np.arange(x.shape[-2], dtype=np.int32)[:, None]
    return jnp.sum(jnp.where(is_entry, x, 0), axis=-2)


def nearest_entries(distance: Array, x: Array, n: int) -> Array:
    """Return the entries with the smallest distances, nearest first, and each once. (..., n, k)

    Args:
        distance: Distances, or other numbers in the same order, such as their squares. Where all that are left are
            infinite, the entry is zero if those of infinite distances are. (..., m)
        x: Entries. (..., m, k)
        n: Number of entries to return, at most m.
    """
    entries = []
    for _ in range(n):
        nearest_index = lax.argmin(distance, distance.ndim - 1, np.int32)
        entries.append(pick_entry(x, nearest_index))
        is_taken = nearest_index[..., None] == np.arange(x.shape[-2], dtype=np.int32)
        distance, x = jnp.where(is_taken, jnp.inf, distance), jnp.where(is_taken[..., None], 0, x)
    return jnp.stack(entries, axis=-2)


def collision_placements(sim: Sim) -> list[StagePlacement]:
    """Return the stage after each physics step in which drones that touch each other fail; none for a single drone.

    It is for an ``OutcomeTask``; a state ``collided`` of the task is set, too. Drones whose flights are over collide
    with nothing.
    """
    if sim.n_drones == 1:
        return []
    contacts = sim.scene.contact_fn((), floor=False)

    @stage("world")
    def collide(data: SimData) -> SimData:
        record, s = data.plugins[TASK_RECORD_NAME], data.states
        is_over = flight_over(record)
        # For this query only, drones whose flight is over are moved far away, to different heights.
        far_pos = 1000.0 * (1 + np.arange(len(is_over)))[:, None] * np.array([0.0, 0.0, 1.0])
        query_pos = jnp.where(is_over[:, None], far_pos.astype(s.pos.dtype), s.pos)
        collides = contacts(data.replace(states=s.replace(pos=query_pos))).any & ~is_over
        names = {"failure", "collided"} & vars(record).keys()
        record = record.replace(**{name: getattr(record, name) | collides for name in names})
        return data.replace(plugins=data.plugins | {TASK_RECORD_NAME: record})

    return [StagePlacement(collide, before="increment_steps", name=f"{TASK_RECORD_NAME}_collisions")]


def nearest_drones(data: SimData, n: int, is_visible: Array | None = None) -> tuple[Array, Array]:
    """Return positions, m, and velocities, m/s, of the nearest other drones of a world relative to each drone.

    Args:
        data: The data of one world.
        n: Largest number of other drones to return.
        is_visible: True for drones that may be returned; None for all drones. If too few drones are visible, the other
            entries are zero. (n_drones,)

    Returns:
        (n_drones, min(n, n_drones - 1), 3) each
    """
    s = data.states
    n_drones = s.pos.shape[0]
    is_other = ~np.eye(n_drones, dtype=bool)
    is_candidate = is_other if is_visible is None else is_visible[None] & is_other
    relative_pos, relative_vel = (jnp.where(is_candidate[..., None], x[None] - x[:, None], 0) for x in (s.pos, s.vel))
    square_distance = jnp.where(is_candidate, jnp.sum(relative_pos * relative_pos, axis=-1), jnp.inf)
    nearest = nearest_entries(
        square_distance, jnp.concatenate([relative_pos, relative_vel], axis=-1), min(n, n_drones - 1)
    )
    return nearest[..., :3], nearest[..., 3:]
