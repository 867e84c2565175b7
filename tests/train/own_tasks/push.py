"""Push a ball over the floor to a goal."""

import jax
import jax.numpy as jnp
from hands import fly_to

from crazysim import rotation, state
from crazysim.envs import ProgressTask, draw, flying, state_of, terms

RADIUS, DECELERATION = 0.2, 0.6
"""Radius of the ball and the drone together, m, and deceleration of a rolling ball, m/s^2."""
CENTRE = 0.15
"""Height of the ball's centre, m."""


class Push(ProgressTask):
    """Push a ball that lies on the floor to within 15 cm of a goal."""

    name = "push"

    tolerance: float = 0.15
    seconds: float = 8.0
    ball: jax.Array = state((2,))
    ball_vel: jax.Array = state((2,))
    goal: jax.Array = state((2,))

    def spawn(self, data, key):
        x = draw(key, data.core.n_drones, start=3, ball=2, yaw=1, far=1)
        ball, yaw = 0.6 * x["ball"] - 0.3, 2 * jnp.pi * x["yaw"]
        goal = ball + (0.6 + 0.4 * x["far"]) * jnp.concatenate([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
        start = (2 * x["start"] - 1) * jnp.array([1.0, 1.0, 0.3]) + jnp.array([0.0, 0.0, 1.0])
        return self.write(flying(data, start), ball=ball, ball_vel=jnp.zeros_like(ball), goal=goal)

    def after_substep(self, data):
        task, s, dt = self.read(data), data.states, 1 / data.core.freq
        way = task.ball - s.pos[:2]
        flat = rotation.safe_norm(way)[0]
        depth = jnp.sqrt(jnp.maximum(RADIUS**2 - (s.pos[2] - CENTRE) ** 2, 0.0)) - flat
        normal = way / jnp.maximum(flat, 1e-3)
        slower = jnp.maximum(normal @ (s.vel[:2] - task.ball_vel), 0.0)
        vel = task.ball_vel + jnp.where(depth > 0, slower, 0.0) * normal
        speed = rotation.safe_norm(vel)[0]
        vel = vel * jnp.maximum(1 - DECELERATION * dt / jnp.maximum(speed, 1e-6), 0.0)
        ball = task.ball + vel * dt + jnp.clip(depth, 0.0, 0.01) * normal
        return self.write(data, ball=ball, ball_vel=vel)

    def error(self, data):
        return rotation.safe_norm(self.read(data).goal - self.read(data).ball)[..., 0]

    def to_ball(self, data):
        """Return the vector from the drone to the ball, m. (n_drones, 3)"""
        ball = self.read(data).ball
        return jnp.concatenate([ball, jnp.full_like(ball[:, :1], CENTRE)], axis=-1) - data.states.pos

    def observe(self, data):
        task = self.read(data)
        return state_of(data) | {
            "to_ball": self.to_ball(data),
            "ball_vel": task.ball_vel,
            "ball_to_goal": task.goal - task.ball,
        }

    def failed(self, data):
        pos = data.states.pos
        return (pos[:, 2] < 0.03) | (pos[:, 2] > 2.5) | jnp.any(jnp.abs(pos[:, :2]) > 3.0, axis=-1)

    def rewards(self, data, action, last_action):
        return {
            "progress": 5.0 * self.progress(data),
            "near": terms.proximity(self.error(data)),
            "touch": 0.2 * terms.proximity(rotation.safe_norm(self.to_ball(data))[..., 0]),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "failed": -10.0 * self.failed(data),
        }

    def terminated(self, data):
        return jnp.any(self.failed(data))

    @staticmethod
    def demonstrate(obs):
        """Fly behind the ball, above it on the way there, come down, and push slowly until it is at the goal."""
        to_goal, to_ball = obs["ball_to_goal"], obs["to_ball"][..., :2]
        far = jnp.linalg.norm(to_goal, axis=-1, keepdims=True)
        along = to_goal / jnp.maximum(far, 1e-3)
        behind = to_ball - 0.33 * along
        ahead = jnp.sum(to_ball * along, axis=-1, keepdims=True)
        aside = jnp.linalg.norm(to_ball - ahead * along, axis=-1, keepdims=True)
        ready = (ahead > 0.12) & (aside < 0.06)
        low = obs["to_ball"][..., 2:] > -0.1
        rolls_on = jnp.sum(obs["ball_vel"] ** 2, axis=-1, keepdims=True) / (2 * DECELERATION)
        done = far - rolls_on < 0.04
        push = to_ball + 0.05 * along
        target = jnp.where(ready & low & ~done, push, behind)
        height = obs["to_ball"][..., 2:] + jnp.where(ready & ~done, 0.02, 0.5)
        speed = jnp.clip(target, -0.35, 0.35)
        return fly_to(jnp.concatenate([speed, height], axis=-1), obs["vel"], gain=1.0, damping=0.6)
