"""Fly to a point and stay there."""

from __future__ import annotations

import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.settings import setting
from crazysim.envs import terms
from crazysim.envs.random import draw, scale_symmetric
from crazysim.envs.spawn import flying
from crazysim.envs.tasks.goals import GoalTask

MIDDLE = np.array([0.0, 0.0, 1.2])
"""Middle of the box of starts and goals, m."""


class Hover(GoalTask):
    """Reach a random point and hover there.

    A drone starts in flight, slightly tilted and moving. Its start and its goal are in a box around (0, 0, 1.2). An
    episode ends when a drone touches the floor, rises above 3 m, or is more than 3 m from the z axis along x or y.
    """

    name = "hover"
    film_view = {"elevation": -20}
    half_width, height = 3.0, 3.0

    reach: float = setting(default=1.0, low=0.0)
    """Half the width of the box of starts and goals, m; half its height is 0.7 times that."""
    seconds: float = 5.0
    """Length of an episode, s."""
    tolerance: float = 0.05
    """Distance below which the drone is at its goal, m."""

    def spawn(self, data: SimData, key: Array) -> SimData:
        x = draw(key, data.core.n_drones, start=3, goal=3, rpy=3, vel=3, ang_vel=3)
        box = np.array([self.reach, self.reach, 0.7 * self.reach])
        quat = rotation.from_rpy(scale_symmetric(x["rpy"], 0.2))
        vel, ang_vel = scale_symmetric(x["vel"], 0.5), scale_symmetric(x["ang_vel"], 0.5)
        data = flying(data, MIDDLE + scale_symmetric(x["start"], box), quat, vel, ang_vel)
        return self.write(data, goal=MIDDLE + scale_symmetric(x["goal"], box))

    def rewards(self, data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
        return {
            "proximity": terms.proximity(self.error(data)),
            "spin": -0.002 * terms.spin(data),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "crash": -10.0 * self.crashed(data),
        }
