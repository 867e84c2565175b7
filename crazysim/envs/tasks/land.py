"""Land on a pad that stands still or moves."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData, grid_2d
from crazysim.core.plugin import StagePlacement, state
from crazysim.core.settings import setting
from crazysim.engine.pytree import static
from crazysim.engine.stage import stage
from crazysim.envs.random import draw
from crazysim.envs.spawn import flying
from crazysim.envs.task import TASK_RECORD_NAME
from crazysim.envs.tasks.goals import pick_entry
from crazysim.envs.tasks.touch_down import TouchDown
from crazysim.scene.objects import Handle
from crazysim.sim.sim import Sim

PAD = "pad"
"""Name of the pads in the scene, without their numbers."""
RADIUS, HEIGHT = 0.25, 0.2
"""Default radius of a pad, and height of its upper side above the floor, m."""
SPACING = 3.0
"""Distance between the pads of several drones, m; a drone observes its own pad only."""
HALF_WIDTH, CEILING = 1.4, 2.5
"""Largest distance of a drone from the middle of its pad's path along x and y, and largest height of a drone, m."""
CIRCLE_RADII = (0.3, 0.7)
"""Smallest and largest radius of a moving pad's circle, m."""


class Land(TouchDown):
    """Land on a pad, 0.2 m above the floor.

    A drone has landed when it touches its pad from above, within the pad's radius, at a relative speed of at most
    0.5 m/s and a tilt of at most 20 degrees. Contacts are checked at every physics step. Any other contact is a crash.
    Being more than 1.4 m along x or y from the middle of the pad's path, or higher than 2.5 m, is also a crash. An
    episode ends when every drone has landed or crashed.
    """

    name = "land"
    target_name = "pad"
    film_view = {"elevation": -20}
    # If a crash cost 10, as much as a landing earns, policies would hover next to the pad: few of their first contacts
    # are soft.
    crash_cost = 2.0
    height: ClassVar[float] = HEIGHT
    """Height of the upper side of a pad, m."""

    speed: float = setting(default=0.0, low=0.0, high=10.0)
    """Speed of a pad on a circle of 0.3 to 0.7 m radius, in either direction, m/s; zero for pads that stand still."""
    radius: float = setting(default=RADIUS, low=0.05, high=0.5)
    """Radius of a pad, m."""
    circle: Array = state()
    """Radius of the circle on which the pad moves, m; zero for a pad that stands still."""
    ang_vel: Array = state()
    """Angular velocity of the pad on the circle, rad/s."""
    phase: Array = state()
    """Angle of the pad on the circle at the start of the episode, rad."""
    pads: Handle = static()
    """Handle of the pads, one per drone."""

    def install(self, sim: Sim) -> None:
        pads = sim.scene.add(
            "landing_pad", PAD, count=sim.n_drones, pos=self.path_centres(sim.n_drones), radius=self.radius
        )
        contacts = sim.scene.contact_fn([pads], drones=False)

        @stage("world")
        def move_pads(data: SimData) -> SimData:
            pos, vel = self.pad_motion(data, data.core.steps + 1)
            return pads.set_pose(data, pos, vel=vel)

        placements = [StagePlacement(self.touch_down_stage(contacts, self.radius), before="increment_steps")]
        if self.speed > 0:
            placements.insert(0, StagePlacement(move_pads, before="measurements", name=f"{TASK_RECORD_NAME}_pads"))
        self.add_states(sim, placements, pads=pads)

    def spawn(self, data: SimData, key: Array) -> SimData:
        n_drones = data.core.n_drones
        x = draw(key, n_drones, start=3, rpy=3, vel=3, circle=1, direction=1, phase=1)
        dtype = data.states.pos.dtype
        start_shift, rpy, vel = (2 * x[name] - 1 for name in ("start", "rpy", "vel"))
        start_pos = (
            self.path_centres(n_drones).astype(dtype)
            + start_shift * np.array([1.0, 1.0, 0.4], dtype)
            + np.array([0, 0, 1.0], dtype)
        )
        data = flying(data, start_pos, rotation.from_rpy(0.2 * rpy), 0.3 * vel)
        circle = CIRCLE_RADII[0] + (CIRCLE_RADII[1] - CIRCLE_RADII[0]) * x["circle"]
        ang_vel = jnp.where(x["direction"] < 0.5, -self.speed, self.speed) / circle
        is_moving = float(self.speed > 0)
        data = self.write(data, circle=is_moving * circle, ang_vel=is_moving * ang_vel, phase=2 * jnp.pi * x["phase"])
        pos, pad_vel = self.pad_motion(data, data.core.steps)
        return self.read(data).pads.set_pose(data, pos, vel=pad_vel) if self.speed > 0 else data

    def target_motion(self, data: SimData, steps_ahead: int = 0) -> tuple[Array, Array]:
        return self.pad_motion(data, data.core.steps + steps_ahead if steps_ahead else data.core.steps)

    def has_left_arena(self, data: SimData) -> Array:
        pos = data.states.pos
        return jnp.any(jnp.abs(pos - self.path_centre(data))[..., :2] > HALF_WIDTH, axis=-1) | (pos[..., 2] > CEILING)

    def path_centres(self, n_drones: int) -> np.ndarray:
        """Return the middle of each pad's path, m. (n_drones, 3)"""
        return np.concatenate([SPACING * grid_2d(n_drones), np.full((n_drones, 1), self.height)], axis=-1)

    def path_centre(self, data: SimData) -> Array:
        """Return the middle of the path of each drone's pad, for the data of one drone or one world, m. (..., 3)"""
        centres = jnp.asarray(self.path_centres(data.core.n_drones), data.states.pos.dtype)
        return pick_entry(centres, data.core.drone_id)

    def pad_motion(self, data: SimData, steps: Array) -> tuple[Array, Array]:
        """Return position, m, and velocity, m/s, of each drone's pad. (..., 3) each

        Args:
            data: Data of one drone or one world.
            steps: Physics steps since the start of the episode.
        """
        record = self.read(data)
        angle = record.phase + record.ang_vel * (steps / data.core.freq)
        radial = jnp.concatenate([jnp.cos(angle), jnp.sin(angle), 0 * angle], axis=-1)
        tangential = jnp.concatenate([-jnp.sin(angle), jnp.cos(angle), 0 * angle], axis=-1)
        return self.path_centre(data) + record.circle * radial, record.circle * record.ang_vel * tangential

    def subjects(self, data: SimData) -> Array:
        rim = self.radius * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], data.states.pos.dtype)
        return (self.target(data)[:, None] + rim).reshape(-1, 3)
