"""Fly through a forest, with the trees observed in a depth image."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import StagePlacement, state
from crazysim.core.settings import setting
from crazysim.drones.body import body_shape
from crazysim.engine.stage import stage
from crazysim.envs import terms
from crazysim.envs.random import draw
from crazysim.envs.spawn import flying
from crazysim.envs.tasks.goals import (
    OutcomeTask,
    collision_placements,
    motion_of,
    nearest_entries,
    on_floor,
    to_heading,
)
from crazysim.plugins.scenery.forest import Forest as Trees
from crazysim.plugins.sensors.camera import Camera
from crazysim.sim.sim import Sim

HALF_WIDTH, CEILING = 8.0, 4.0
"""Half the width of the corridor with one drone, and the height of the corridor, m. At the default density about four
trees stand side by side in it; all trees are higher than the corridor."""
HEIGHT = 1.5
"""Height of starts and goals, m."""
TREE_HEIGHT = 5.0
"""Height of the trees, m."""
EDGE_DISTANCE = 2.0
"""Distance from the starts to the first trees, and from the goal line to the goals, m."""
MIN_TREE_GAP = 0.6
"""Smallest distance between trees, m; ``gap`` of ``crazysim.plugins.scenery.Forest``."""
START_JITTER = np.array([0.3, 1.0, 0.3])
"""Largest components of the offset of starts and goals from their mean positions, m; with several drones 0.2 m along
y."""
SPACING = 1.5
"""Distance between the mean positions of neighbouring starts, and of neighbouring goals, m. With the offsets, drones at
the start do not touch each other."""
CHECK_FREQ = 100
"""Rate at which drones are checked for contact, Hz. At 8 m/s a drone flies 8 cm between two checks. A contact of the
drone's collision sphere, 7 cm in radius, with a tree of 10 cm radius can be missed if they overlap by less than
0.08^2 / (8 * 0.17) = 5 mm."""
VIEW_RANGE = 8.0
"""Largest distance of an observed tree, m; farther trees are observed at this distance."""
N_PRIVILEGED_TREES = 4
"""Number of nearest trees in privileged observations."""


class Forest(OutcomeTask):
    """Fly through a forest to a goal line at a set speed; every episode has a new random forest.

    A drone is disabled when it touches a tree, the ground or another drone, or leaves the corridor. The ceiling of the
    corridor is below the tops of the trees. Contacts with trees are checked at 100 Hz. An episode ends when every drone
    is disabled or has crossed the goal line. ``make`` adds a camera, and policies observe its depth image.
    """

    name = "forest"
    outcomes = ("reached", "disabled")
    film_view = {"follow": 0, "distance": 8.0, "azimuth": 0.0, "elevation": -35.0}

    speed: float = setting(default=5.0, positive=True, high=20.0)
    """Speed above which flying faster costs reward, m/s."""
    length: float = setting(default=30.0, low=5.0, high=200.0)
    """Distance from the starts to the goal line, m."""
    density: float = setting(default=1 / 16, positive=True)
    """Trees per square metre, 1/m^2."""
    radii: ArrayLike = setting(default=(0.1, 0.3), positive=True, shapes=((2,),))
    """Smallest and largest radius of the trees, m. (2,)"""
    difficulty: ArrayLike = setting(default=1.0, low=0.0, high=1.0, shapes=((), (2,)))
    """Fraction of the trees that stand, or the lowest and highest fraction, between which each episode draws. () or
    (2,)"""
    trees_seen: int = setting(default=0, low=0, high=12)
    """Number of nearest trees among the observations; zero for policies that use the depth image."""
    seconds: float = 12.0
    """Length of an episode, s."""
    goal: Array = state((3,))
    """Goal of the drone, behind the goal line, m."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.trees(1)  # raises an error if the trees do not fit

    def half_width(self, n_drones: int) -> float:
        """Return half the width of the corridor, m."""
        return HALF_WIDTH + SPACING * (n_drones - 1) / 2

    def trees(self, n_drones: int) -> Trees:
        """Return the plugin of the trees, which cover the corridor."""
        cell = 1 / np.sqrt(self.density)
        size = np.array([self.length, 2 * self.half_width(n_drones)])
        size = cell * np.ceil(size / cell - 1e-6)
        return Trees(
            density=self.density,
            radii=self.radii,
            size=size + [0.0, cell],  # columns are shifted by up to half a cell
            center=(EDGE_DISTANCE + size[0] / 2, 0.0),
            height=TREE_HEIGHT,
            gap=MIN_TREE_GAP,
            difficulty=self.difficulty,
            name="trees",
        )

    def install(self, sim: Sim) -> None:
        trees, half_width = self.trees(sim.n_drones), self.half_width(sim.n_drones)
        sim.add(trees)
        radius = max(float(body_shape(airframe)["collision_sphere"][3]) for airframe in sim.airframes)
        period = max(sim.freq // CHECK_FREQ, 1)

        @stage("drone", when=lambda data: (data.core.steps + 1) % period == 0)
        def judge(data: SimData) -> SimData:
            pos = data.states.pos
            has_left = (jnp.abs(pos[1]) > half_width) | (pos[2] > CEILING) | (pos[0] < -EDGE_DISTANCE) | on_floor(data)
            touches_tree = trees.clearance(data, pos) < radius
            return self.judge(data, pos[0] >= self.length, has_left | touches_tree)

        self.add_states(sim, [*collision_placements(sim), StagePlacement(judge, before="increment_steps")])

    def spawn(self, data: SimData, key: Array) -> SimData:
        n_drones, dtype = data.core.n_drones, data.states.pos.dtype
        x = draw(key, n_drones, start=3, goal=3, rpy=3, vel=3)
        start_shift, goal_shift, rpy, vel = (2 * x[name] - 1 for name in ("start", "goal", "rpy", "vel"))
        mean_pos = np.zeros((n_drones, 3))
        mean_pos[:, 1], mean_pos[:, 2] = SPACING * (np.arange(n_drones) - (n_drones - 1) / 2), HEIGHT
        jitter = np.array([START_JITTER[0], START_JITTER[1] if n_drones == 1 else 0.2, START_JITTER[2]])
        data = self.trees(n_drones).sample_layout(data, jax.random.fold_in(key, 1))
        start_pos = (mean_pos + jitter * start_shift).astype(dtype)
        data = flying(data, start_pos, rotation.from_rpy(0.1 * rpy), 0.3 * vel)
        goal = (mean_pos + jitter * goal_shift + np.array([self.length + EDGE_DISTANCE, 0.0, 0.0])).astype(dtype)
        return self.write(data, goal=goal)

    def nearest_trees(self, data: SimData, n: int) -> Array:
        """Return the nearest trees of each drone, the nearest first. (n_drones, n, 3)

        An entry has the horizontal vector from the drone to the trunk's surface, as components ahead and to the left,
        m, and the radius of the trunk, m. The trees of twelve cells around and in front of the drone are searched.
        Trees that are farther away than ``VIEW_RANGE``, and trees that do not stand, are returned at this distance.
        """
        forest, pos = self.trees(data.core.n_drones), data.states.pos
        n_cells, cell = forest.n_cells, forest.cell
        corner = np.asarray(forest.center) - cell * np.asarray(n_cells) / 2
        column, row = [
            jnp.floor(rotation.clip((pos[:, k] - corner[k]) / cell, -4.0, n_cells[k] + 4.0)).astype(jnp.int32)
            for k in range(2)
        ]
        column_offsets = np.repeat(np.arange(-1, 3), 3).astype(np.int32)
        row_offsets = np.tile(np.arange(-1, 2), 4).astype(np.int32)
        trees = forest.obstacles_in_cells(data, column[:, None] + column_offsets, row[:, None] + row_offsets)
        offset = jnp.stack([trees.x - pos[:, :1], trees.y - pos[:, 1:2]], axis=-1)
        distance = rotation.safe_norm(offset)[..., 0]
        gap = jnp.where(trees.is_standing, jnp.minimum(distance - trees.size, VIEW_RANGE), VIEW_RANGE)
        to_trunk = offset * (gap / jnp.maximum(distance, 1e-3))[..., None]
        ahead, left = rotation.heading(data.states.quat)
        components = [jnp.sum(to_trunk * axis[:, None, :2], axis=-1) for axis in (ahead, left)]
        entries = jnp.stack([*components, trees.size], axis=-1)
        return nearest_entries(gap, entries, n)

    def observe(self, data: SimData) -> dict[str, Array]:
        """Return attitude, velocities, height, direction and distance of the goal, and the nearest trees.

        Velocity and direction of the goal are in the frame of the heading: ahead, left, up. ``offset`` is the
        drone's distance to the left of the middle of the corridor, m. ``trees_near`` has the nearest ``trees_seen``
        trees.
        """
        to_goal = self.read(data).goal - data.states.pos
        distance = rotation.safe_norm(to_goal)
        obs = motion_of(data) | {
            "goal_direction": to_heading(data, to_goal / jnp.maximum(distance, 1e-3)),
            "goal_distance": distance,
            "offset": data.states.pos[..., 1:2],
        }
        if self.trees_seen:
            obs["trees_near"] = self.nearest_trees(data, self.trees_seen).reshape(data.core.n_drones, -1)
        return obs

    def privileged(self, data: SimData) -> dict[str, Array]:
        return {"trees_near": self.nearest_trees(data, N_PRIVILEGED_TREES).reshape(data.core.n_drones, -1)}

    def rewards(self, data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
        record, s = self.read(data), data.states
        to_goal, (_, left) = record.goal - s.pos, rotation.heading(s.quat)
        approach = jnp.sum(s.vel * to_goal, axis=-1) / jnp.maximum(rotation.safe_norm(to_goal)[..., 0], 1e-3)
        speed = rotation.safe_norm(s.vel)[..., 0]
        gap = self.trees(data.core.n_drones).clearance(data, s.pos)
        reward_terms = {
            "progress": 0.13 * jnp.minimum(approach / self.speed, 1.0) - 0.03,
            "haste": -0.1 * jnp.maximum(speed - self.speed, 0),
            "closeness": -0.3 * jnp.exp(-5 * gap),
            "sideways": -0.02 * jnp.abs(jnp.sum(s.vel * left, axis=-1)),
            "height": -0.05 * jnp.abs(s.pos[..., 2] - HEIGHT),
            "spin": -0.002 * terms.spin(data),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "reached": 10.0 * record.success,
            "disabled": -10.0 * record.failure,
        }
        return terms.only_where(~record.flight_over_before, reward_terms)

    def error(self, data: SimData) -> Array:
        return jnp.maximum(self.length - data.states.pos[..., 0], 0.0)

    def policy_camera(self) -> Camera:
        return Camera(16, 12)
