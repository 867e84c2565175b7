"""Fly around four poles, on alternate sides, and hover behind the last."""

import jax.numpy as jnp
from hands import fly_to

from crazysim.envs import HoopTask, draw, flying, state_of, terms

POLES = jnp.array([-1.2, -0.4, 0.4, 1.2])
"""x of the poles, m."""


class Slalom(HoopTask):
    """Pass each pole at a distance of 0.1 to 0.5 m, on alternate sides."""

    name = "slalom"
    n_waypoints = 4

    radius: float = 0.2
    tolerance: float = 0.15
    seconds: float = 7.0

    def spawn(self, data, key):
        n = data.core.n_drones
        x = draw(key, n, start=3, poles=4, side=1)
        side = jnp.where(x["side"] < 0.5, -1.0, 1.0) * jnp.array([1.0, -1.0, 1.0, -1.0])
        y = 0.5 * x["poles"] - 0.25 + 0.3 * side
        gates = jnp.stack([jnp.broadcast_to(POLES, (n, 4)), y, jnp.full((n, 4), 1.2)], axis=-1)
        data = flying(data, 0.6 * x["start"] + jnp.array([-2.4, -0.3, 0.9]))
        return self.set_course(data, gates, goal=jnp.array([2.0, 0.0, 1.2]))

    def is_inside(self, offset):
        return jnp.abs(offset[..., 1]) < self.radius

    def observe(self, data):
        return state_of(data) | {"ways": self.ways(data).reshape(-1, 15)}

    def failed(self, data):
        height = data.states.pos[:, 2]
        return self.read(data).missed | (height < 0.1) | (height > 3.0)

    def rewards(self, data, action, last_action):
        return {
            "progress": 5.0 * self.progress(data),
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
