"""Fly around four poles, on alternate sides, and hover behind the last."""

import jax
import jax.numpy as jnp
from hands import fly_to

from crazysim import rotation, state
from crazysim.envs import Task, draw, flying, state_of, terms

POLES = jnp.array([-1.2, -0.4, 0.4, 1.2])
"""x of the poles, m."""


class Slalom(Task):
    """Pass each pole at a distance of 0.1 to 0.5 m, on alternate sides."""

    name = "slalom"

    tolerance: float = 0.15
    seconds: float = 7.0
    gates: jax.Array = state((5, 3))
    passed: jax.Array = state((), dtype=int)
    missed: jax.Array = state((), dtype=bool)
    way_before: jax.Array = state(())

    def spawn(self, data, key):
        n = data.core.n_drones
        x = draw(key, n, start=3, poles=4, side=1)
        side = jnp.where(x["side"] < 0.5, -1.0, 1.0) * jnp.array([1.0, -1.0, 1.0, -1.0])
        y = 0.5 * x["poles"] - 0.25 + 0.3 * side
        gates = jnp.stack([jnp.broadcast_to(POLES, (n, 4)), y, jnp.full((n, 4), 1.2)], axis=-1)
        goal = jnp.broadcast_to(jnp.array([2.0, 0.0, 1.2]), (n, 1, 3))
        data = flying(data, 0.6 * x["start"] + jnp.array([-2.4, -0.3, 0.9]))
        return self.write(data, gates=jnp.concatenate([gates, goal], axis=1))

    def after_substep(self, data):
        course, pos = self.read(data), data.states.pos
        gate = course.gates[jnp.minimum(course.passed, 3)]
        crossed = (course.passed < 4) & (pos[0] > gate[0])
        inside = jnp.abs(pos[1] - gate[1]) < 0.2
        return self.write(data, passed=course.passed + (crossed & inside), missed=course.missed | (crossed & ~inside))

    def ways(self, data):
        """Return the vectors from the drone to the gates that are left, zero for others. (n_drones, 5, 3)"""
        course = self.read(data)
        is_left = jnp.arange(5) >= course.passed[:, None]
        return jnp.where(is_left[..., None], course.gates - data.states.pos[:, None], 0.0)

    def error(self, data):
        ways, passed = self.ways(data), self.read(data).passed[:, None]
        legs = ways - jnp.where((jnp.arange(5) > passed)[..., None], jnp.roll(ways, 1, axis=1), 0.0)
        return jnp.sum(rotation.safe_norm(legs)[..., 0], axis=-1)

    def before_step(self, data):
        return self.write(data, way_before=self.error(data))

    def observe(self, data):
        return state_of(data) | {"ways": self.ways(data).reshape(-1, 15)}

    def failed(self, data):
        height = data.states.pos[:, 2]
        return self.read(data).missed | (height < 0.1) | (height > 3.0)

    def rewards(self, data, action, last_action):
        return {
            "progress": 5.0 * (self.read(data).way_before - self.error(data)),
            "near": terms.proximity(self.error(data)),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "failed": -10.0 * self.failed(data),
        }

    def terminated(self, data):
        return jnp.any(self.failed(data))

    @staticmethod
    def demonstrate(obs):
        """Lean towards a point just behind the middle of the next gate, fast sideways and slowly ahead."""
        ways = obs["ways"].reshape(*obs["ways"].shape[:-1], 5, 3)
        first = jnp.argmax(jnp.any(ways != 0.0, axis=-1), axis=-1)[..., None, None]
        way = jnp.take_along_axis(ways, first, axis=-2)[..., 0, :]
        beside = jnp.abs(way[..., 1:2]) > 0.15  # waits in front of the gate
        ahead = jnp.where(beside, jnp.minimum(way[..., :1] - 0.15, 0.4), jnp.minimum(way[..., :1] + 0.2, 0.6))
        ahead = jnp.where(first[..., 0] < 4, ahead, way[..., :1])
        return fly_to(jnp.concatenate([ahead, way[..., 1:]], axis=-1), obs["vel"], lean=0.6, gain=1.6, damping=0.65)
