"""Two drones fly side by side along a moving line."""

import jax
import jax.numpy as jnp
from hands import fly_to

from crazysim import rotation, state
from crazysim.envs import Task, draw, flying, state_of, terms


class Formation(Task):
    """Each drone keeps its slot beside a point that moves at up to 0.5 m/s."""

    name = "formation"
    n_drones = 2

    tolerance: float = 0.1
    seconds: float = 5.0
    slot: jax.Array = state((3,))
    slot_vel: jax.Array = state((3,))

    def spawn(self, data, key):
        x = draw(key, data.core.n_drones, start=3, middle=3, yaw=1, vel=2)
        side = jnp.array([[-1.0], [1.0]])
        start = (2 * x["start"] - 1) * jnp.array([0.3, 0.8, 0.3]) + jnp.concatenate(
            [0.8 * side, 0 * side, 0 * side + 1.2], axis=-1
        )
        middle, yaw, vel = x["middle"][:1], jnp.pi * (x["yaw"][:1] - 0.5), x["vel"][:1] - 0.5
        slot = (2 * middle - 1) * jnp.array([0.5, 0.5, 0.3]) + jnp.array([0.0, 0.0, 1.2])
        across = 0.4 * side * jnp.concatenate([jnp.cos(yaw), jnp.sin(yaw), 0 * yaw], axis=-1)
        slot_vel = jnp.broadcast_to(0.7 * jnp.concatenate([vel, 0 * yaw], axis=-1), (2, 3))
        return self.write(flying(data, start), slot=slot + across, slot_vel=slot_vel)

    def after_substep(self, data):
        task = self.read(data)
        return self.write(data, slot=task.slot + task.slot_vel / data.core.freq)

    def error(self, data):
        return rotation.safe_norm(self.read(data).slot - data.states.pos)[..., 0]

    def other(self, data):
        """Return the vector to the other drone, m. (2, 3)"""
        return data.states.pos[::-1] - data.states.pos

    def observe(self, data):
        task = self.read(data)
        return state_of(data) | {
            "slot": task.slot - data.states.pos,
            "slot_vel": task.slot_vel - data.states.vel,
            "other": self.other(data),
        }

    def failed(self, data):
        height, apart = data.states.pos[:, 2], rotation.safe_norm(self.other(data))[..., 0]
        return (apart < 0.2) | (height < 0.1) | (height > 3.0)

    def rewards(self, data, action, last_action):
        return {
            "near": terms.proximity(self.error(data)),
            "spin": -0.002 * terms.spin(data),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "failed": -10.0 * self.failed(data),
        }

    def terminated(self, data):
        return jnp.any(self.failed(data))

    @staticmethod
    def demonstrate(obs):
        """Lean towards the slot, and away from the other drone where it is near."""
        apart = jnp.linalg.norm(obs["other"], axis=-1, keepdims=True)
        away = -obs["other"] / apart * jnp.maximum(0.6 - apart, 0.0)
        swerve = 1.5 * away + jnp.stack(
            [0 * away[..., 0], 0 * away[..., 0], jnp.sign(away[..., 0]) * 0.5 * jnp.abs(away[..., 0])], -1
        )
        return fly_to(obs["slot"] + swerve, -obs["slot_vel"])
