"""Inspect four points in any order."""

import jax.numpy as jnp
from hands import fly_to

from crazysim.envs import VisitTask, draw, flying, state_of, terms


class Visit(VisitTask):
    """Come within 15 cm of four points, in any order, within eight seconds."""

    name = "visit"
    n_waypoints = 4

    tolerance: float = 0.15
    seconds: float = 8.0

    def spawn(self, data, key):
        n = data.core.n_drones
        x = draw(key, n, start=3, points=12)
        box, middle = jnp.array([1.0, 1.0, 0.5]), jnp.array([0.0, 0.0, 1.2])
        points = (2 * x["points"].reshape(n, 4, 3) - 1) * box + middle
        return self.write(flying(data, (2 * x["start"] - 1) * box + middle), waypoints=points)

    def observe(self, data):
        return state_of(data) | {"ways": self.ways(data).reshape(-1, 12), "seen": 1.0 * self.read(data).passed}

    def failed(self, data):
        pos = data.states.pos
        return (pos[:, 2] < 0.1) | (pos[:, 2] > 3.0) | jnp.any(jnp.abs(pos[:, :2]) > 2.5, axis=-1)

    def rewards(self, data, action, last_action):
        return {
            "seen": 5.0 * self.progress(data),
            "near": 0.1 * terms.proximity(self.nearest(data)),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "failed": -10.0 * self.failed(data),
        }

    def terminated(self, data):
        return jnp.any(self.failed(data)) | jnp.all(self.succeeded(data))

    @staticmethod
    def demonstrate(obs):
        """Lean towards the nearest point that is left."""
        ways = obs["ways"].reshape(*obs["ways"].shape[:-1], 4, 3)
        far = jnp.where(obs["seen"] > 0.5, jnp.inf, jnp.linalg.norm(ways, axis=-1))
        way = jnp.take_along_axis(ways, jnp.argmin(far, axis=-1)[..., None, None], axis=-2)[..., 0, :]
        return fly_to(way, obs["vel"], lean=0.7, gain=1.2, damping=0.55)
