"""Dock with a moving drone."""

import jax
import jax.numpy as jnp
from hands import fly_to

from crazysim import rotation, state
from crazysim.envs import ProgressTask, draw, flying, state_of, terms


class Dock(ProgressTask):
    """Meet a point on a carrier that flies a circle, from above, within 10 cm and slower than 0.3 m/s."""

    name = "dock"

    tolerance: float = 0.1
    seconds: float = 6.0
    radius: float = 0.6
    phase: jax.Array = state(())
    rate: jax.Array = state(())
    docked: jax.Array = state((), dtype=bool)
    crashed: jax.Array = state((), dtype=bool)

    def spawn(self, data, key):
        x = draw(key, data.core.n_drones, start=3, phase=1, turn=1)
        start = (2 * x["start"] - 1) * jnp.array([1.0, 1.0, 0.2]) + jnp.array([0.0, 0.0, 1.7])
        rate = jnp.where(x["turn"][:, 0] < 0.5, -1.0, 1.0)
        return self.write(flying(data, start), phase=2 * jnp.pi * x["phase"][:, 0], rate=rate)

    def carrier(self, task):
        """Return position, m, and velocity, m/s, of the point on the carrier. (..., 3) each"""
        sin, cos, zero = jnp.sin(task.phase), jnp.cos(task.phase), 0 * task.phase
        pos = self.radius * jnp.stack([cos, sin, zero], axis=-1) + jnp.array([0.0, 0.0, 1.0])
        return pos, self.radius * jnp.stack([-task.rate * sin, task.rate * cos, zero], axis=-1)

    def after_substep(self, data):
        task, s = self.read(data), data.states
        task = task.replace(phase=task.phase + task.rate / data.core.freq)
        pos, vel = self.carrier(task)
        meets = (jnp.sum((s.pos - pos) ** 2) < self.tolerance**2) & ~task.docked & ~task.crashed
        speed, above = jnp.sum((s.vel - vel) ** 2), s.pos[2] > pos[2]
        docked = task.docked | (meets & above & (speed < 0.3**2))
        below = (jnp.sum((s.pos - pos)[:2] ** 2) < 0.1**2) & (jnp.abs(s.pos[2] - pos[2] + 0.15) < 0.1)
        crashed = task.crashed | (~docked & ((meets & (speed > 0.8**2)) | below))
        return self.write(data, phase=task.phase, docked=docked, crashed=crashed)

    def error(self, data):
        return rotation.safe_norm(self.carrier(self.read(data))[0] - data.states.pos)[..., 0]

    def observe(self, data):
        pos, vel = self.carrier(self.read(data))
        return state_of(data) | {"carrier": pos - data.states.pos, "carrier_vel": vel - data.states.vel}

    def failed(self, data):
        height = data.states.pos[:, 2]
        return self.read(data).crashed | (height < 0.1) | (height > 3.0)

    def rewards(self, data, action, last_action):
        return {
            "progress": 2.0 * self.progress(data),
            "docked": 10.0 * self.read(data).docked,
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "failed": -10.0 * self.failed(data),
        }

    def terminated(self, data):
        return jnp.any(self.failed(data) | self.read(data).docked)

    def succeeded(self, data):
        return self.read(data).docked

    @staticmethod
    def demonstrate(obs):
        """Follow a point above the carrier, and come down once it is below."""
        way = obs["carrier"]
        aside = jnp.linalg.norm(way[..., :2], axis=-1, keepdims=True)
        down = jnp.where(aside < 0.08, jnp.clip(way[..., 2:] + 0.05, -0.3, 0.3), way[..., 2:] + 0.35)
        way = jnp.concatenate([way[..., :2] - 0.08 * obs["carrier_vel"][..., :2] * 0, down], axis=-1)
        return fly_to(way, -obs["carrier_vel"], gain=1.2, damping=0.6)
