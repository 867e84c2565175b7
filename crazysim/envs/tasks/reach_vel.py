"""Fly with a target velocity."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import state
from crazysim.core.settings import setting
from crazysim.envs import terms
from crazysim.envs.random import draw, scale_symmetric
from crazysim.envs.spawn import flying
from crazysim.envs.task import Task
from crazysim.envs.tasks.goals import on_floor, state_of

HEIGHT = 5.0
"""Height of the start, m; with the default settings it is enough to descend for a whole episode."""


class ReachVel(Task):
    """Reach a random velocity and keep it. The task error is a difference of velocities, m/s.

    A drone starts in flight, 5 m high, slightly tilted and moving. An episode ends when a drone touches the
    floor.
    """

    name = "reach_vel"
    unit = "m/s"

    speed: float = setting(default=1.0, low=0.0)
    """Largest x and y component of the target velocity, m/s; z is at most a quarter of that."""
    seconds: float = 4.0
    """Length of an episode, s."""
    tolerance: float = 0.1
    """Difference below which the drone has the target velocity, m/s."""
    target_vel: Array = state((3,))
    """Target velocity, world frame, m/s."""

    def spawn(self, data: SimData, key: Array) -> SimData:
        x = draw(key, data.core.n_drones, start=3, rpy=3, vel=3, ang_vel=3, goal=3)
        start = scale_symmetric(x["start"], np.array([1.0, 1.0, 0.0])) + np.array([0.0, 0.0, HEIGHT])
        quat = rotation.from_rpy(scale_symmetric(x["rpy"], 0.2))
        data = flying(data, start, quat, scale_symmetric(x["vel"], 0.5), scale_symmetric(x["ang_vel"], 0.5))
        return self.write(data, target_vel=scale_symmetric(x["goal"], self.speed * np.array([1.0, 1.0, 0.25])))

    def observe(self, data: SimData) -> dict[str, Array]:
        return state_of(data) | {"difference_to_target_vel": self.read(data).target_vel - data.states.vel}

    def rewards(self, data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
        return {
            "proximity": terms.proximity(self.error(data), coarse=1.0, fine=10.0),
            "spin": -0.002 * terms.spin(data),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "crash": -10.0 * on_floor(data),
        }

    def terminated(self, data: SimData) -> Array:
        return jnp.any(on_floor(data))

    def error(self, data: SimData) -> Array:
        return rotation.safe_norm(self.read(data).target_vel - data.states.vel)[..., 0]
