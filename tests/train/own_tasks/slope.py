"""Land on a slope, parallel to it."""

import jax
import jax.numpy as jnp
from hands import fly_to

from crazysim import rotation, state
from crazysim.envs import ProgressTask, draw, flying, state_of, terms


class Slope(ProgressTask):
    """Touch a slope of 10 degrees within 12 cm of its middle, slower than 0.7 m/s, and within 6 degrees of parallel."""

    name = "slope"

    tolerance: float = 0.12
    seconds: float = 5.0
    normal: jax.Array = state((3,))
    landed: jax.Array = state((), dtype=bool)
    crashed: jax.Array = state((), dtype=bool)

    def spawn(self, data, key):
        x = draw(key, data.core.n_drones, start=3, yaw=1)
        yaw, tilt = 2 * jnp.pi * x["yaw"], jnp.deg2rad(10.0)
        up = jnp.full_like(yaw, jnp.cos(tilt))
        normal = jnp.concatenate([jnp.cos(yaw) * jnp.sin(tilt), jnp.sin(yaw) * jnp.sin(tilt), up], axis=-1)
        start = (2 * x["start"] - 1) * jnp.array([0.8, 0.8, 0.3]) + jnp.array([0.0, 0.0, 1.5])
        return self.write(flying(data, start), normal=normal)

    def above(self, data, normal):
        """Return the vector from the drone to the middle of the slope, and the drone's height above the slope, m."""
        way = jnp.array([0.0, 0.0, 0.5]) - data.states.pos
        return way, -jnp.sum(way * normal, axis=-1)

    def after_substep(self, data):
        s, task = data.states, self.read(data)
        way, height = self.above(data, task.normal)
        touches = (height < 0.02) & ~task.landed & ~task.crashed
        near, slow = jnp.sum(way**2) < self.tolerance**2, jnp.sum(s.vel**2) < 0.7**2
        parallel = rotation.matrix(s.quat)[:, 2] @ task.normal > jnp.cos(jnp.deg2rad(6.0))
        good = touches & near & slow & parallel
        return self.write(data, landed=task.landed | good, crashed=task.crashed | (touches & ~good))

    def error(self, data):
        return rotation.safe_norm(self.above(data, self.read(data).normal)[0])[..., 0]

    def observe(self, data):
        normal = self.read(data).normal
        way, height = self.above(data, normal)
        return state_of(data) | {"way": way, "height": height[:, None], "normal": normal}

    def failed(self, data):
        return self.read(data).crashed | (data.states.pos[:, 2] > 3.0)

    def rewards(self, data, action, last_action):
        return {
            "progress": 2.0 * self.progress(data),
            "landed": 10.0 * self.read(data).landed,
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "failed": -10.0 * self.failed(data),
        }

    def terminated(self, data):
        return jnp.any(self.failed(data) | self.read(data).landed)

    def succeeded(self, data):
        return self.read(data).landed

    @staticmethod
    def demonstrate(obs):
        """Come to a point above the middle, descend, and lean like the slope at the end."""
        way, height = obs["way"], obs["height"]
        aside = way + height * obs["normal"]
        above = jnp.sum(aside**2, axis=-1, keepdims=True) < 0.05**2
        down = jnp.where(above | (height < 0.2), -0.25, 0.4 - height)
        action = fly_to(jnp.concatenate([aside[..., :2], down], axis=-1), obs["vel"], gain=1.0, damping=0.55)
        lean = obs["normal"][..., :2] / (jnp.pi / 4)
        tilt = jnp.where(height < 0.11, jnp.stack([-lean[..., 1], lean[..., 0]], axis=-1), action[..., :2])
        return action.at[..., :2].set(tilt)
