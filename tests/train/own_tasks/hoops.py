"""Fly through three hoops, and hover behind the last."""

import jax
import jax.numpy as jnp
from hands import fly_to

from crazysim import rotation, state
from crazysim.envs import Task, draw, flying, state_of, terms


class ThreeHoops(Task):
    """Fly through three hoops, and hover behind the last."""

    name = "three_hoops"

    radius: float = 0.35
    tolerance: float = 0.15
    seconds: float = 6.0
    waypoints: jax.Array = state((4, 3))
    passed: jax.Array = state((), dtype=int)
    missed: jax.Array = state((), dtype=bool)
    way_before: jax.Array = state(())

    def spawn(self, data, key):
        n = data.core.n_drones
        x = draw(key, n, start=3, hoops=6)
        middle = jnp.array([[-1.2, 0.0, 1.3], [0.0, 0.0, 1.3], [1.2, 0.0, 1.3]])
        shift = (2 * x["hoops"].reshape(n, 3, 2) - 1) * jnp.array([0.6, 0.4])
        hoops = middle + jnp.concatenate([jnp.zeros((n, 3, 1)), shift], axis=-1)
        goal = hoops[:, 2:] + jnp.array([0.8, 0.0, 0.0])
        data = flying(data, 0.6 * x["start"] + jnp.array([-2.6, -0.3, 1.0]))
        return self.write(data, waypoints=jnp.concatenate([hoops, goal], axis=1))

    def after_substep(self, data):
        course, pos = self.read(data), data.states.pos
        hoop = course.waypoints[jnp.minimum(course.passed, 2)]
        crossed = (course.passed < 3) & (pos[0] > hoop[0])
        inside = jnp.sum((pos - hoop)[1:] ** 2) < self.radius**2
        return self.write(data, passed=course.passed + (crossed & inside), missed=course.missed | (crossed & ~inside))

    def ways(self, data):
        """Return the vectors from the drone to the waypoints that are left, zero for others. (n_drones, 4, 3)"""
        course = self.read(data)
        is_left = jnp.arange(4) >= course.passed[:, None]
        return jnp.where(is_left[..., None], course.waypoints - data.states.pos[:, None], 0.0)

    def error(self, data):
        ways, passed = self.ways(data), self.read(data).passed[:, None]
        legs = ways - jnp.where((jnp.arange(4) > passed)[..., None], jnp.roll(ways, 1, axis=1), 0.0)
        return jnp.sum(rotation.safe_norm(legs)[..., 0], axis=-1)

    def before_step(self, data):
        return self.write(data, way_before=self.error(data))

    def observe(self, data):
        return state_of(data) | {"ways": self.ways(data).reshape(-1, 12)}

    def failed(self, data):
        height = data.states.pos[:, 2]
        return self.read(data).missed | (height < 0.1) | (height > 3.0)

    def rewards(self, data, action, last_action):
        return {
            "progress": 5.0 * (self.read(data).way_before - self.error(data)),
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
