"""Fly to a goal through a field of poles and boxes."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import StagePlacement, state
from crazysim.core.settings import setting
from crazysim.engine.pytree import static
from crazysim.engine.stage import stage
from crazysim.envs import terms
from crazysim.envs.random import draw
from crazysim.envs.spawn import flying
from crazysim.envs.tasks.goals import (
    OutcomeTask,
    ProgressTask,
    collision_placements,
    flight_over,
    nearest_drones,
    nearest_entries,
    state_of,
)
from crazysim.envs.tracks import ranks
from crazysim.errors import require
from crazysim.scene.objects import Handle
from crazysim.sim.sim import Sim

CELL_WIDTH, CELL_JITTER = 0.8, 0.15
"""Width of the cells of the field, and largest component of the offset of an obstacle from the middle of its cell, m.
A cell holds at most one obstacle. With these numbers a drone fits between a pole and its neighbours."""
N_CELLS_ALONG = 4
"""Number of cells from the starts to the goals."""
FIELD_GAP = 0.6
"""Smallest distance of starts and goals from the field, m."""
POLE_RADIUS, BOX_WIDTH = 0.05, 0.3
"""Radius of a pole, and width of a box, m."""
HEIGHT = 2.0
"""Height of poles and ceiling, m."""
START_JITTER = 0.15
"""Largest component of the offset of starts and goals from their mean positions, m."""
CRUISE_SPEED = 2.0
"""Speed above which flying faster costs reward, m/s. At the largest tilt of an action, 45 degrees, a drone brakes with
about g and stops from this speed within v^2 / (2 g) = 0.2 m, a quarter of a cell."""
SPACING = 0.6
"""Distance between the mean positions of neighbouring starts, and of neighbouring goals, m."""


class Field(NamedTuple):
    """Dimensions of the field and the arena for a number of drones."""

    n_cells_across: int
    """Number of cells across the flight direction."""
    size: np.ndarray
    """Length and width of the field, along x and y, m. (2,)"""
    arena_half_size: np.ndarray
    """Half the size of the arena along x and y, m. (2,)"""
    goals: np.ndarray
    """Mean positions of the goals, m; mean positions of the starts have the opposite x. (n_drones, 3)"""


class Avoid(ProgressTask, OutcomeTask):
    """Fly about 4.7 m through a field of obstacles, which have new positions in every episode.

    Poles reach from the floor to the ceiling; boxes hang in the air. A drone is disabled when it touches an obstacle,
    the floor or another drone, or leaves the arena. Contacts are checked at every physics step. An episode ends when
    every drone is disabled or has reached its goal.
    """

    name = "avoid"
    outcomes = ("reached", "disabled")
    film_view = {"elevation": -35}

    n_poles: int = setting(default=8, low=0)
    """Number of poles."""
    n_boxes: int = setting(default=4, low=0)
    """Number of boxes."""
    n_seen: int = setting(default=4, low=1)
    """Largest number of nearest obstacles that a drone observes."""
    seconds: float = 8.0
    """Length of an episode, s."""
    tolerance: float = 0.2
    """Distance within which a drone has reached its goal, m."""
    goal: Array = state((3,))
    """Goal of the drone, m."""
    handles: tuple[Handle, ...] = static()
    """Handles of the poles, then of the boxes."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.n_poles + self.n_boxes != 0,
            "expected at least one obstacle, got n_poles=0 and n_boxes=0. Set one of them.",
        )

    def field(self, n_drones: int) -> Field:
        """Return the dimensions of the field: at least a third of the cells is free, and all drones fit in a row."""
        n = self.n_poles + self.n_boxes
        n_cells_across = max(
            4, -(-3 * n // (2 * N_CELLS_ALONG)), -(-int(10 * SPACING * n_drones) // int(10 * CELL_WIDTH))
        )
        size = CELL_WIDTH * np.array([N_CELLS_ALONG, n_cells_across])
        arena_half_size = np.array([size[0] / 2 + FIELD_GAP + START_JITTER + 0.5, size[1] / 2 + 0.5])
        y = SPACING * (np.arange(n_drones) - (n_drones - 1) / 2)
        goals = np.stack(
            [np.full(n_drones, size[0] / 2 + FIELD_GAP + START_JITTER), y, np.full(n_drones, HEIGHT / 2)], axis=-1
        )
        return Field(n_cells_across, size, arena_half_size, goals)

    def install(self, sim: Sim) -> None:
        handles = []
        if self.n_poles:
            handles.append(sim.scene.add("pole", count=self.n_poles, pos=(0, 0, 0), radius=POLE_RADIUS, height=HEIGHT))
        if self.n_boxes:
            handles.append(
                sim.scene.add("box", count=self.n_boxes, pos=(0, 0, HEIGHT / 2), size=(BOX_WIDTH, BOX_WIDTH, BOX_WIDTH))
            )
        contacts = sim.scene.contact_fn(handles, drones=False)
        half_size = self.field(sim.n_drones).arena_half_size

        @stage("drone")
        def judge(data: SimData) -> SimData:
            pos = data.states.pos
            has_left = jnp.any(jnp.abs(pos[:2]) > half_size.astype(pos.dtype), axis=-1) | (pos[2] > HEIGHT)
            offset = pos - self.read(data).goal
            has_arrived = rotation.dot(offset, offset)[0] < self.tolerance**2
            return self.judge(data, has_arrived, has_left | contacts(data).any)

        placements = [*collision_placements(sim), StagePlacement(judge, before="increment_steps")]
        self.add_states(sim, placements, handles=tuple(handles))

    def spawn(self, data: SimData, key: Array) -> SimData:
        n, n_drones, dtype = self.n_poles + self.n_boxes, data.core.n_drones, data.states.pos.dtype
        field = self.field(n_drones)
        x = draw(key, cells=N_CELLS_ALONG * field.n_cells_across, obstacles=(n, 4), drones=(n_drones, 12))
        # Obstacles in different cells of the field.
        cell, shift = ranks(x["cells"], n), 2 * x["obstacles"] - 1
        corner = jnp.asarray((CELL_WIDTH - field.size) / 2, dtype)
        cell_pos = (
            corner
            + CELL_WIDTH * jnp.stack([cell % N_CELLS_ALONG, cell // N_CELLS_ALONG], axis=-1)
            + CELL_JITTER * shift[:, :2]
        )
        height = (np.arange(n) >= self.n_poles) * jnp.asarray(HEIGHT / 2 + (HEIGHT / 2 - BOX_WIDTH) * shift[:, 2])
        angle = jnp.pi * shift[:, 3:] / 2
        pos = jnp.concatenate([cell_pos, height[:, None]], axis=-1)
        quat = jnp.concatenate([0 * angle, 0 * angle, jnp.sin(angle), jnp.cos(angle)], axis=-1)
        # Poses of poles, then of boxes.
        first_row = 0
        for handle in self.read(data).handles:
            rows = slice(first_row, first_row + len(handle))
            data, first_row = handle.set_pose(data, pos[rows], quat[rows]), rows.stop
        # Goals, and starts on the opposite side.
        offset, goal_shift, rpy, vel = jnp.split(2 * x["drones"] - 1, 4, axis=-1)
        goals = field.goals.astype(dtype)
        start = goals * np.array([-1, 1, 1], dtype) + START_JITTER * offset
        data = flying(data, start, rotation.from_rpy(0.1 * rpy), 0.1 * vel)
        return self.write(data, goal=goals + START_JITTER * goal_shift)

    def nearest_obstacles(self, data: SimData) -> tuple[Array, Array]:
        """Return vectors from each drone to its nearest obstacles, and from there to their middles, world frame.

        Returns:
            Vectors to the nearest point of each obstacle, m, and vectors from that point to the middle of a box, m,
            which are zero for poles. (n_drones, n, 3) each, with n at most ``n_seen``
        """
        dtype, handles = data.states.pos.dtype, self.read(data).handles
        rows = slice(handles[0].rows[0], handles[-1].rows[-1] + 1)
        n_poles, n_boxes = self.n_poles, self.n_boxes
        # Middle and half size of each solid, in the object's frame; a pole's radius is subtracted from the distance.
        middle = np.array([[0, 0, HEIGHT / 2]] * n_poles + [[0, 0, 0]] * n_boxes)
        half_sizes = np.array([[0, 0, HEIGHT / 2]] * n_poles + [[BOX_WIDTH / 2] * 3] * n_boxes)
        radius = np.array([POLE_RADIUS] * n_poles + [0.0] * n_boxes)
        is_box = np.arange(n_poles + n_boxes)[:, None] >= n_poles
        pos, quat = (x[..., rows, :] for x in (data.objects.pos, data.objects.quat))  # type: ignore[union-attr]
        local_pos = rotation.rotate_inverse(quat, data.states.pos[..., None, :] - pos) - middle.astype(dtype)
        half_size = jnp.asarray(half_sizes, dtype)
        nearest = rotation.clip(local_pos, -half_size, half_size)
        distance = rotation.safe_norm(nearest - local_pos)
        gap = distance - radius[:, None].astype(dtype)
        to_nearest = rotation.rotate(quat, nearest - local_pos) * (gap / jnp.where(distance > 1e-3, distance, 1))
        to_middle = jnp.where(is_box, rotation.rotate(quat, -nearest), 0)
        vectors = jnp.concatenate([to_nearest, to_middle], axis=-1)
        nearest_vectors = nearest_entries(gap[..., 0], vectors, min(self.n_seen, n_poles + n_boxes))
        return nearest_vectors[..., :3], nearest_vectors[..., 3:]

    def observe(self, data: SimData) -> dict[str, Array]:
        """Return the drone's state, and vectors to its goal, to the nearest obstacles and to other drones, m.

        ``obstacles_near`` has vectors to the nearest points of obstacles; ``obstacles_middle`` has vectors from these
        points to the middles of boxes, and zeros for poles.
        """
        n_drones = data.core.n_drones
        to_nearest, to_middle = self.nearest_obstacles(data)
        obs = state_of(data) | {
            "difference_to_goal": self.read(data).goal - data.states.pos,
            "obstacles_near": to_nearest.reshape(n_drones, -1),
            "obstacles_middle": to_middle.reshape(n_drones, -1),
        }
        if n_drones > 1:
            relative_pos, _ = nearest_drones(data, 2, ~flight_over(self.read(data)))
            obs["drones_near"] = relative_pos.reshape(n_drones, -1)
        return obs

    def rewards(self, data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
        record = self.read(data)
        gap = rotation.safe_norm(self.nearest_obstacles(data)[0][..., 0, :])[..., 0]
        speed = rotation.safe_norm(data.states.vel)[..., 0]
        reward_terms = {
            "progress": 2.0 * self.progress(data),
            "closeness": -0.2 * jnp.exp(-6 * gap),
            "haste": -0.1 * jnp.maximum(speed - CRUISE_SPEED, 0),
            "spin": -0.002 * terms.spin(data),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "reached": 10.0 * record.success,
            "disabled": -10.0 * record.failure,
        }
        return terms.only_where(~record.flight_over_before, reward_terms)

    def error(self, data: SimData) -> Array:
        return rotation.safe_norm(self.read(data).goal - data.states.pos)[..., 0]

    def set_goal(self, data: SimData, pos: Array) -> SimData:
        return self.write(data, goal=pos)
