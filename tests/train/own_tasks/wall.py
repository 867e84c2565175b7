"""Follow a wall by range finders."""

import jax
import jax.numpy as jnp
import numpy as np
from hands import fly_to

from crazysim import RangeFinder, state
from crazysim.envs import Task, draw, flying, state_of, terms

CORNERS = np.array([[-3.0, 0.9], [-1.2, 1.2], [0.0, 0.8], [1.2, 1.2], [3.5, 0.9]])
"""Corners of the wall, x and y, m."""


class FollowWall(Task):
    """Fly 2.5 m along a wall with corners, half a metre from it, and know only its distance in three directions."""

    name = "follow_wall"

    tolerance: float = 0.15
    seconds: float = 8.0
    worst: jax.Array = state(())
    arrived: jax.Array = state((), dtype=bool)

    def install(self, sim):
        middles, sides = (CORNERS[1:] + CORNERS[:-1]) / 2, np.diff(CORNERS, axis=0)
        for k, (middle, (x, y)) in enumerate(zip(middles, sides, strict=True)):
            yaw, length = np.arctan2(-x, y), np.hypot(x, y) + 0.05
            quat = [0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)]
            sim.scene.add(
                "wall", name=f"wall_{k}", pos=[*middle, 0.0], quat=quat, length=length, height=3.0, thickness=0.02
            )
        sim.add(RangeFinder([(0, 1, 0), (1, 1, 0), (-1, 1, 0)], max_range=3.0))
        self.add_states(sim)

    def spawn(self, data, key):
        x = draw(key, data.core.n_drones, start=3)
        return flying(data, (2 * x["start"] - 1) * jnp.array([0.3, 0.25, 0.2]) + jnp.array([-1.8, 0.5, 1.2]))

    def ranges(self, data):
        """Return the distances to the wall: left, ahead and behind, m. (n_drones, 3)"""
        return data.plugins["range_finder"].distance

    def after_substep(self, data):
        task, x = self.read(data), data.states.pos[0]
        deviation = jnp.abs(self.ranges(data)[0] - 0.5)
        worst = jnp.where((x > -1.0) & ~task.arrived, jnp.maximum(task.worst, deviation), task.worst)
        return self.write(data, worst=worst, arrived=task.arrived | (x > 1.5))

    def error(self, data):
        return jnp.abs(self.ranges(data)[..., 0] - 0.5)

    def observe(self, data):
        s = state_of(data)
        return {name: s[name] for name in ("rot", "vel", "ang_vel")} | {
            "height": s["pos"][:, 2:],
            "ranges": self.ranges(data),
        }

    def failed(self, data):
        task, pos = self.read(data), data.states.pos
        lost = (task.worst > self.tolerance) | (self.ranges(data)[..., 0] < 0.1)
        return lost | (pos[:, 2] < 0.1) | (pos[:, 2] > 2.5) | (pos[:, 0] < -3.0)

    def rewards(self, data, action, last_action):
        return {
            "ahead": 0.5 * jnp.clip(data.states.vel[:, 0], -1.0, 1.0),
            "beside": jnp.exp(-5.0 * self.error(data)),
            "arrived": 5.0 * self.read(data).arrived,
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "failed": -10.0 * self.failed(data),
        }

    def terminated(self, data):
        return jnp.any(self.failed(data) | self.read(data).arrived)

    def succeeded(self, data):
        task = self.read(data)
        return task.arrived & (task.worst < self.tolerance)

    @staticmethod
    def demonstrate(obs):
        """Fly at half a metre a second, half a metre beside the wall as it is to the left and ahead."""
        left, ahead, _ = jnp.moveaxis(obs["ranges"], -1, 0)
        aside = (left - 0.5) + 0.5 * jnp.clip(ahead / jnp.sqrt(2.0) - 0.5, -0.2, 0.2)
        way = jnp.stack([0.3 + 0 * left, aside, 1.2 - obs["height"][..., 0]], axis=-1)
        return fly_to(way, obs["vel"], gain=1.2, damping=0.65)
