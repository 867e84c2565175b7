"""Touch a spot on a wall slowly, with the nose up."""

import jax
import jax.numpy as jnp
from hands import fly_to

from crazysim import rotation, state
from crazysim.envs import ProgressTask, draw, flying, state_of, terms

WALL = 1.45
"""x of the centre of mass at which a drone touches the wall, m."""


class Perch(ProgressTask):
    """Touch the wall within 15 cm of the spot, slower than 1 m/s, and with the nose at least 12 degrees up."""

    name = "perch"

    tolerance: float = 0.15
    seconds: float = 5.0
    spot: jax.Array = state((3,))
    perched: jax.Array = state((), dtype=bool)
    crashed: jax.Array = state((), dtype=bool)

    def spawn(self, data, key):
        x = draw(key, data.core.n_drones, start=3, spot=2)
        data = flying(data, (2 * x["start"] - 1) * jnp.array([0.5, 0.6, 0.4]) + jnp.array([-0.5, 0.0, 1.2]))
        y, z = 1.2 * x["spot"][:, :1] - 0.6, 0.8 + 0.8 * x["spot"][:, 1:]
        return self.write(data, spot=jnp.concatenate([jnp.full_like(y, WALL), y, z], axis=-1))

    def after_substep(self, data):
        s, task = data.states, self.read(data)
        touches = (s.pos[0] > WALL) & ~task.perched & ~task.crashed
        near = jnp.sum((s.pos - task.spot)[1:] ** 2) < self.tolerance**2
        slow = jnp.sum(s.vel**2) < 1.0
        nose_up = rotation.matrix(s.quat)[2, 0] > 0.2
        good = touches & near & slow & nose_up
        return self.write(data, perched=task.perched | good, crashed=task.crashed | (touches & ~good))

    def error(self, data):
        return rotation.safe_norm(self.read(data).spot - data.states.pos)[..., 0]

    def observe(self, data):
        return state_of(data) | {"spot": self.read(data).spot - data.states.pos}

    def failed(self, data):
        height = data.states.pos[:, 2]
        return self.read(data).crashed | (height < 0.1) | (height > 3.0)

    def rewards(self, data, action, last_action):
        return {
            "progress": 2.0 * self.progress(data),
            "perched": 10.0 * self.read(data).perched,
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "failed": -10.0 * self.failed(data),
        }

    def terminated(self, data):
        return jnp.any(self.failed(data) | self.read(data).perched)

    def succeeded(self, data):
        return self.read(data).perched

    @staticmethod
    def demonstrate(obs):
        """Come to a point before the wall, then drift towards it, and raise the nose at the end."""
        gap, aside = obs["spot"][..., :1], obs["spot"][..., 1:]
        aligned = jnp.sum(aside**2, axis=-1, keepdims=True) < 0.08**2
        ahead = jnp.where(aligned | (gap < 0.25), jnp.minimum(gap + 0.3, 0.9), gap - 0.4)
        action = fly_to(jnp.concatenate([ahead, aside], axis=-1), obs["vel"])
        return action.at[..., 1].set(jnp.where(gap[..., 0] < 0.13, -0.36, action[..., 1]))
