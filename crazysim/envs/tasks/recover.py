"""Catch a drone that was thrown into the air."""

from __future__ import annotations

import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.settings import setting
from crazysim.envs import terms
from crazysim.envs.random import draw
from crazysim.envs.spawn import flying, random_attitude
from crazysim.envs.tasks.goals import GoalTask

GOAL = np.array([0.0, 0.0, 3.0])
"""Goal of every drone, m."""


class Recover(GoalTask):
    """Catch a thrown drone, and hover at (0, 0, 3). It starts with random attitude, velocity and angular velocity.

    An episode ends when a drone touches the floor, rises above 8 m, or is more than 8 m from the z axis along x or y.
    """

    name = "recover"
    film_view = {"lookat": (0, 0, 2.5), "distance": 9.0, "elevation": -15}
    half_width, height = 8.0, 8.0

    speed: float = setting(default=2.0, low=0.0)
    """Largest component of the velocity at the start, m/s."""
    spin: float = setting(default=6.0, low=0.0)
    """Largest component of the angular velocity at the start, body frame, rad/s."""
    seconds: float = 5.0
    """Length of an episode, s."""
    tolerance: float = 0.1
    """Distance below which the drone is at its goal, m."""

    def spawn(self, data: SimData, key: Array) -> SimData:
        x = draw(key, data.core.n_drones, start=3, vel=3, ang_vel=3, attitude=3)
        goal = GOAL.astype(data.states.pos.dtype)
        pos = goal + 2 * x["start"] - 1
        vel, ang_vel = self.speed * (2 * x["vel"] - 1), self.spin * (2 * x["ang_vel"] - 1)
        data = flying(data, pos, random_attitude(x["attitude"]), vel, ang_vel)
        return self.write(data, goal=goal)

    def rewards(self, data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
        return {
            "proximity": terms.proximity(self.error(data), coarse=1.0, fine=10.0),
            "upright": 0.5 * rotation.z_axis(data.states.quat)[..., 2],
            "spin": -0.002 * terms.spin(data),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "crash": -20.0 * self.crashed(data),
        }
