"""Parts that tasks share: goals, common observations, limits of the arena, contacts between drones."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import FunctionPlugin, StagePlacement
from crazysim.engine.pytree import PyTree, device_array, leaf
from crazysim.engine.stage import Stage, stage
from crazysim.envs.task import TASK_RECORD_NAME, Task
from crazysim.sim.sim import Sim

FLOOR = 0.02
"""Height of the centre of mass below which a drone has crashed, m."""


class Goal(PyTree):
    """Goal of every drone."""

    pos: Array = leaf("drone", 1)
    """Position, world frame, m. (n_worlds, n_drones, 3)"""
    vel: Array = leaf("drone", 1)
    """Velocity, world frame, m/s. (n_worlds, n_drones, 3)"""


class GoalTask(Task):
    """Base of tasks in which every drone flies to its own goal, within an arena around the z axis.

    Subclasses are frozen dataclasses that define ``spawn`` and ``rewards``.
    """

    Record = Goal
    half_width: ClassVar[float]
    """Largest distance from the z axis along x and y, m."""
    height: ClassVar[float]
    """Height of the arena, m."""

    def install(self, sim: Sim) -> None:
        install_goal(sim)

    def set_goal(self, data: SimData, pos: Array) -> SimData:
        return with_goal(data, pos)

    def observe(self, data: SimData) -> dict[str, Array]:
        """Return the drone's state and the vector to its goal, m."""
        return state_of(data) | {"difference_to_goal": goal_of(data).pos - data.states.pos}

    def crashed(self, data: SimData) -> Array:
        """Return True where a drone has left the arena. (..., n_drones)"""
        return out_of_bounds(data, self.half_width, self.height)

    def terminated(self, data: SimData) -> Array:
        return jnp.any(self.crashed(data))

    def error(self, data: SimData) -> Array:
        """Return the distance from the goal, m."""
        return rotation.safe_norm(goal_of(data).pos - data.states.pos)[..., 0]

    def target(self, data: SimData) -> Array:
        return goal_of(data).pos


class Crossing(PyTree):
    """Goal of each drone behind obstacles, and the outcome of its flight."""

    goal: Array = leaf("drone", 1)
    """Goal, m. (n_worlds, n_drones, 3)"""
    reached: Array = leaf("drone", 0)
    """True where the drone has reached its goal or the goal line. (n_worlds, n_drones)"""
    disabled: Array = leaf("drone", 0)
    """True where the drone has touched something, or left the arena. (n_worlds, n_drones)"""
    flight_over_before: Array = leaf("drone", 0)
    """Value of ``flight_over`` before this environment step. (n_worlds, n_drones)"""

    @property
    def flight_over(self) -> Array:
        """True where the drone has arrived or is disabled. (n_worlds, n_drones)"""
        return self.reached | self.disabled

    def updated(self, must_end: Array, has_arrived: Array) -> Any:
        """Return the record after a step in which drones must end, or else may have arrived. (n_worlds, n_drones)"""
        disabled = self.disabled | (~self.reached & must_end)
        return self.replace(disabled=disabled, reached=self.reached | (~disabled & has_arrived))


class CrossingTask(Task):
    """Base of tasks in which every drone flies past obstacles until it arrives or is disabled.

    Subclasses are frozen dataclasses that define ``install``, ``spawn``, ``observe``, ``rewards`` and ``error``.
    """

    Record = Crossing

    def before_step(self, data: SimData) -> SimData:
        record = crossing_of(data)
        return with_record(data, record.replace(flight_over_before=record.flight_over))

    def terminated(self, data: SimData) -> Array:
        return jnp.all(crossing_of(data).flight_over)

    def info(self, data: SimData) -> dict[str, Array]:
        return {"reached": crossing_of(data).reached, "disabled": crossing_of(data).disabled}

    def target(self, data: SimData) -> Array:
        return crossing_of(data).goal

    def succeeded(self, data: SimData) -> Array:
        return crossing_of(data).reached


def crossing_of(data: SimData) -> Any:
    """Return the task's record, a ``Crossing`` or a subclass."""
    return data.plugins[TASK_RECORD_NAME]


def install_goal(sim: Sim) -> None:
    """Add the record of goals, ``data.plugins["task"]``, with all goals at the origin and at rest."""
    pos = sim.data.states.pos
    zero = device_array(np.zeros(pos.shape), pos.dtype)
    sim.add(FunctionPlugin(TASK_RECORD_NAME, Goal(zero, zero)))


def goal_of(data: SimData) -> Goal:
    """Return the task's record of goals."""
    return data.plugins[TASK_RECORD_NAME]


def with_goal(data: SimData, pos: ArrayLike, vel: ArrayLike = 0.0) -> SimData:
    """Return the data with new goals: positions, m, and velocities, m/s. (..., n_drones, 3) each"""
    pos = jnp.broadcast_to(pos, data.states.pos.shape)
    return with_record(data, Goal(pos, jnp.broadcast_to(vel, pos.shape)))


def with_record(data: SimData, record: PyTree) -> SimData:
    """Return the data with a new record of the task."""
    return data.replace(plugins=data.plugins | {TASK_RECORD_NAME: record})


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
    """Return True where a drone is on or below the floor. (..., n_drones)"""
    return data.states.pos[..., 2] < FLOOR


def out_of_bounds(data: SimData, half_width: float, height: float) -> Array:
    """Return True where a drone is on the floor, too high, or too far from the z axis. (..., n_drones)"""
    pos = data.states.pos
    return on_floor(data) | (pos[..., 2] > height) | jnp.any(jnp.abs(pos[..., :2]) > half_width, axis=-1)


def pick_entry(x: Array, index: Array) -> Array:
    """Return the entry with an index, by masking all entries, which is faster than indexing.

    Args:
        x: Entries. (..., n, k)
        index: Index of the entry. (...)

    Returns:
        (..., k)
    """
    is_entry = index[..., None, None] == np.arange(x.shape[-2], dtype=np.int32)[:, None]
    return jnp.sum(jnp.where(is_entry, x, 0), axis=-2)


def nearest_entries(distance: Array, x: Array, n: int) -> Array:
    """Return the entries with the smallest distances, nearest first.

    Args:
        distance: Distances, or other numbers in the same order, such as their squares. (..., m)
        x: Entries. (..., m, k)
        n: Number of entries to return, at most m.

    Returns:
        (..., n, k)
    """
    entries = []
    for _ in range(n):
        nearest_index = lax.argmin(distance, distance.ndim - 1, np.int32)
        entries.append(pick_entry(x, nearest_index))
        distance = jnp.where(nearest_index[..., None] == np.arange(x.shape[-2], dtype=np.int32), jnp.inf, distance)
    return jnp.stack(entries, axis=-2)


def install_rules(sim: Sim, record: PyTree, rules: Stage, checks_collisions: bool = False) -> None:
    """Add a task's record, and a stage with the task's rules that updates it at the end of every physics step.

    Args:
        sim: The simulation.
        record: Record of all worlds, for ``data.plugins["task"]``.
        rules: Stage that updates the record, such as the marks of drones that are disabled or at their goals.
        checks_collisions: True to disable drones that touch each other, in a stage before ``rules``.
    """
    placements = [StagePlacement(rules, before="increment_steps")]
    if checks_collisions and sim.n_drones > 1:
        placements.insert(
            0, StagePlacement(collision_stage(sim), before="increment_steps", name=f"{TASK_RECORD_NAME}_collisions")
        )
    sim.add(FunctionPlugin(TASK_RECORD_NAME, record, placements))


def collision_stage(sim: Sim) -> Stage:
    """Return a stage that disables drones that touch each other, in the task's record.

    The record needs ``disabled`` and ``flight_over``, (n_worlds, n_drones) each. Drones with ``flight_over`` collide
    with nothing.
    """
    contacts = sim.scene.contact_fn((), floor=False)

    @stage("world")
    def collide(data: SimData) -> SimData:
        record, s = data.plugins[TASK_RECORD_NAME], data.states
        flight_over = record.flight_over
        # For this query only, drones whose flight is over are moved far away, to different heights.
        far_pos = 1000.0 * (1 + np.arange(len(flight_over)))[:, None] * np.array([0.0, 0.0, 1.0])
        query_pos = jnp.where(flight_over[:, None], far_pos.astype(s.pos.dtype), s.pos)
        collides = contacts(data.replace(states=s.replace(pos=query_pos))).any & ~flight_over
        return with_record(data, record.replace(disabled=record.disabled | collides))

    return collide


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
