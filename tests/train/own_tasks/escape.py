"""Escape a moving wall through its hole."""

import jax
import jax.numpy as jnp
from hands import fly_to

from crazysim import state
from crazysim.envs import Task, draw, flying, state_of, terms

SPEED, RADIUS = 1.2, 0.15
"""Speed of the wall, m/s, and radius of its hole, m."""


class Escape(Task):
    """A wall comes along -x; its hole, of 15 cm radius, must be where the drone is when the wall passes."""

    name = "escape"

    seconds: float = 4.0
    wall: jax.Array = state((3,))
    passed: jax.Array = state((), dtype=bool)
    hit: jax.Array = state((), dtype=bool)

    def spawn(self, data, key):
        x = draw(key, data.core.n_drones, start=3, yaw=1, far=1)
        start = (2 * x["start"] - 1) * jnp.array([0.3, 0.4, 0.2]) + jnp.array([-0.5, 0.0, 1.5])
        yaw, far = 2 * jnp.pi * x["yaw"], 0.4 + 0.5 * x["far"]
        hole = start[:, 1:] + far * jnp.concatenate([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
        return self.write(flying(data, start), wall=jnp.concatenate([jnp.full_like(yaw, 2.0), hole], axis=-1))

    def after_substep(self, data):
        task, pos = self.read(data), data.states.pos
        wall = task.wall.at[0].add(-SPEED / data.core.freq)
        passes = (wall[0] < pos[0]) & ~task.passed & ~task.hit
        inside = jnp.sum((pos - wall)[1:] ** 2) < RADIUS**2
        return self.write(data, wall=wall, passed=task.passed | (passes & inside), hit=task.hit | (passes & ~inside))

    def error(self, data):
        way = self.read(data).wall - data.states.pos
        return jnp.where(self.read(data).passed, 0.0, jnp.sqrt(jnp.sum(way[:, 1:] ** 2, axis=-1) + 1e-9))

    def observe(self, data):
        return state_of(data) | {"wall": self.read(data).wall - data.states.pos}

    def failed(self, data):
        pos = data.states.pos
        return self.read(data).hit | (pos[:, 2] < 0.1) | (pos[:, 2] > 3.0) | (jnp.abs(pos[:, 0]) > 1.5)

    def rewards(self, data, action, last_action):
        return {
            "near": terms.proximity(self.error(data)),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "failed": -10.0 * self.failed(data),
        }

    def terminated(self, data):
        return jnp.any(self.failed(data))

    def succeeded(self, data):
        return self.read(data).passed & ~self.failed(data)

    @staticmethod
    def demonstrate(obs):
        """Move to the hole's y and z, and hold x until the wall has passed; then stop."""
        way = obs["wall"] * jnp.array([0.0, 1.0, 1.0])
        return fly_to(way, obs["vel"], gain=1.0, damping=0.55)
