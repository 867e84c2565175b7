"""Inspect four points in any order."""

import jax
import jax.numpy as jnp
from hands import fly_to

from crazysim import rotation, state
from crazysim.envs import Task, draw, flying, state_of, terms


class Visit(Task):
    """Come within 15 cm of four points, in any order, within eight seconds."""

    name = "visit"

    tolerance: float = 0.15
    seconds: float = 8.0
    points: jax.Array = state((4, 3))
    seen: jax.Array = state((4,), dtype=bool)
    n_before: jax.Array = state((), dtype=int)

    def spawn(self, data, key):
        n = data.core.n_drones
        x = draw(key, n, start=3, points=12)
        box, middle = jnp.array([1.0, 1.0, 0.5]), jnp.array([0.0, 0.0, 1.2])
        points = (2 * x["points"].reshape(n, 4, 3) - 1) * box + middle
        return self.write(flying(data, (2 * x["start"] - 1) * box + middle), points=points)

    def after_substep(self, data):
        task = self.read(data)
        near = jnp.sum((task.points - data.states.pos) ** 2, axis=-1) < self.tolerance**2
        return self.write(data, seen=task.seen | near)

    def ways(self, data):
        """Return the vectors to the points that are left, zero for others. (n_drones, 4, 3)"""
        task = self.read(data)
        return jnp.where(task.seen[..., None], 0.0, task.points - data.states.pos[:, None])

    def nearest(self, data):
        """Return the distance to the nearest point that is left, m; zero if all are seen. (n_drones,)"""
        far = jnp.where(self.read(data).seen, jnp.inf, rotation.safe_norm(self.ways(data))[..., 0])
        return jnp.where(self.succeeded(data), 0.0, jnp.min(far, axis=-1))

    def error(self, data):
        return self.nearest(data) + 4.0 - jnp.sum(self.read(data).seen, axis=-1)

    def before_step(self, data):
        return self.write(data, n_before=jnp.sum(self.read(data).seen, axis=-1))

    def observe(self, data):
        seen = self.read(data).seen
        return state_of(data) | {"ways": self.ways(data).reshape(-1, 12), "seen": 1.0 * seen}

    def failed(self, data):
        pos = data.states.pos
        return (pos[:, 2] < 0.1) | (pos[:, 2] > 3.0) | jnp.any(jnp.abs(pos[:, :2]) > 2.5, axis=-1)

    def rewards(self, data, action, last_action):
        task = self.read(data)
        return {
            "seen": 5.0 * (jnp.sum(task.seen, axis=-1) - task.n_before),
            "near": 0.1 * terms.proximity(self.nearest(data)),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "failed": -10.0 * self.failed(data),
        }

    def terminated(self, data):
        return jnp.any(self.failed(data)) | jnp.all(self.succeeded(data))

    def succeeded(self, data):
        return jnp.all(self.read(data).seen, axis=-1)

    @staticmethod
    def demonstrate(obs):
        """Lean towards the nearest point that is left."""
        ways = obs["ways"].reshape(*obs["ways"].shape[:-1], 4, 3)
        far = jnp.where(obs["seen"] > 0.5, jnp.inf, jnp.linalg.norm(ways, axis=-1))
        way = jnp.take_along_axis(ways, jnp.argmin(far, axis=-1)[..., None, None], axis=-2)[..., 0, :]
        return fly_to(way, obs["vel"], lean=0.7, gain=1.2, damping=0.55)
