"""Fly through three hoops, and hover behind the last."""

import jax.numpy as jnp
from hands import fly_to

from crazysim.envs import HoopTask, draw, flying, state_of, terms


class ThreeHoops(HoopTask):
    """Fly through three hoops, and hover behind the last."""

    name = "three_hoops"
    n_waypoints = 3

    radius: float = 0.35
    tolerance: float = 0.15
    seconds: float = 6.0

    def spawn(self, data, key):
        n = data.core.n_drones
        x = draw(key, n, start=3, hoops=6)
        middle = jnp.array([[-1.2, 0.0, 1.3], [0.0, 0.0, 1.3], [1.2, 0.0, 1.3]])
        shift = (2 * x["hoops"].reshape(n, 3, 2) - 1) * jnp.array([0.6, 0.4])
        hoops = middle + jnp.concatenate([jnp.zeros((n, 3, 1)), shift], axis=-1)
        data = flying(data, 0.6 * x["start"] + jnp.array([-2.6, -0.3, 1.0]))
        return self.set_course(data, hoops, goal=hoops[:, 2] + jnp.array([0.8, 0.0, 0.0]))

    def observe(self, data):
        return state_of(data) | {"ways": self.ways(data).reshape(-1, 12)}

    def failed(self, data):
        height = data.states.pos[:, 2]
        return self.read(data).missed | (height < 0.1) | (height > 3.0)

    def rewards(self, data, action, last_action):
        return {
            "progress": 5.0 * self.progress(data),
            "near": terms.proximity(self.error(data)),
            "spin": -0.002 * terms.spin(data),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "failed": -10.0 * self.failed(data),
        }

    def terminated(self, data):
        return jnp.any(self.failed(data))

    @staticmethod
    def demonstrate(obs):
        """Lean towards a point 0.3 m behind the next hoop, and at last towards the goal."""
        ways = obs["ways"].reshape(*obs["ways"].shape[:-1], 4, 3)
        is_left = jnp.any(ways != 0.0, axis=-1)
        first = jnp.argmax(is_left, axis=-1)[..., None, None]
        way = jnp.take_along_axis(ways, first, axis=-2)[..., 0, :]
        return fly_to(way + (first[..., 0] < 3) * jnp.array([0.3, 0.0, 0.0]), obs["vel"])
