"""Fly a loop, and hover where it began."""

import jax
import jax.numpy as jnp

from crazysim import rotation, state
from crazysim.envs import Task, draw, flying, state_of, terms


class Loop(Task):
    """Turn over once by the pitch axis, and hover within 15 cm of the start."""

    name = "loop"
    control = "body_rate"

    tolerance: float = 0.15
    seconds: float = 5.0
    home: jax.Array = state((3,))
    turned: jax.Array = state(())
    turned_before: jax.Array = state(())

    def spawn(self, data, key):
        x = draw(key, data.core.n_drones, start=3, rpy=3)
        start = (2 * x["start"] - 1) * jnp.array([0.5, 0.5, 0.2]) + jnp.array([0.0, 0.0, 2.0])
        return self.write(flying(data, start, rotation.from_rpy(0.2 * x["rpy"] - 0.1)), home=start)

    def after_substep(self, data):
        return self.write(data, turned=self.read(data).turned + data.states.ang_vel[1] / data.core.freq)

    def left(self, data):
        """Return the part of the loop that is left, from 1 to 0. (n_drones,)"""
        return jnp.clip(1 - self.read(data).turned / (2 * jnp.pi), 0.0, 1.0)

    def error(self, data):
        return rotation.safe_norm(self.read(data).home - data.states.pos)[..., 0] + self.left(data)

    def before_step(self, data):
        return self.write(data, turned_before=self.read(data).turned)

    def observe(self, data):
        task = self.read(data)
        return state_of(data) | {"home": task.home - data.states.pos, "left": self.left(data)[:, None]}

    def failed(self, data):
        height = data.states.pos[:, 2]
        return (height < 0.1) | (height > 4.0)

    def rewards(self, data, action, last_action):
        task = self.read(data)
        return {
            "near": terms.proximity(self.error(data)),
            "turn": jnp.where(self.left(data) > 0, task.turned - task.turned_before, 0.0),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "failed": -10.0 * self.failed(data),
        }

    def terminated(self, data):
        return jnp.any(self.failed(data))

    @staticmethod
    def demonstrate(obs):
        """Climb, turn over at full rate, with thrust while upright, then hover by rates."""
        turn = obs["rot"].reshape(*obs["rot"].shape[:-1], 3, 3)
        up = turn[..., 2, 2]
        push = jnp.clip(1.2 * obs["home"] - 0.7 * obs["vel"], -0.6, 0.6) + jnp.array([0.0, 0.0, 1.0])
        wanted = jnp.einsum("...ij,...i->...j", turn, push / jnp.linalg.norm(push, axis=-1, keepdims=True))
        yaw = jnp.arctan2(turn[..., 1, 0], turn[..., 0, 0])
        thrust = jnp.clip(1.5 * obs["home"][..., 2] - 0.8 * obs["vel"][..., 2], -0.8, 1.0)
        hover = jnp.stack([-0.8 * wanted[..., 1], 0.8 * wanted[..., 0], -0.5 * yaw, thrust], axis=-1)
        climb = hover.at[..., 3].set(1.0)
        loop = jnp.stack([0 * up, 0 * up + 1.0, 0 * up, jnp.where(up > 0.3, 1.0, -1.0)], axis=-1)
        begins = (obs["left"] > 0.97) & (obs["vel"][..., 2:] < 1.5)
        return jnp.where(begins, climb, jnp.where(obs["left"] > 0.07, loop, hover))
