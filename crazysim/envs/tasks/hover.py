"""Fly to a point and stay there."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Simulation
from crazysim.envs.env import Task
from crazysim.envs.random import uniform
from crazysim.envs.spawn import flying
from crazysim.envs.tasks.core import away, goal_of, install_goal, out_of_bounds, state_of, with_goal

HALF_WIDTH, HEIGHT = 3.0, 3.0
"""Edge of the arena, m."""


def hover(sim: Simulation, reach: float = 1.0, seconds: float = 5.0, tolerance: float = 0.05) -> Task:
    """Return the task of reaching a random point and hovering there.

    A drone begins in flight, slightly tilted and moving, in a box around (0, 0, 1.2); so does its goal. An episode
    ends on the floor, and 3 m from the axis or above it.

    Args:
        sim: The simulation, which is given goals.
        reach: Half the width of the box that starts and goals are drawn from, m; its half height is 0.7 of that.
        seconds: Length of an episode, s.
        tolerance: Distance below which the goal counts as reached, m.
    """
    install_goal(sim)
    box = np.array([reach, reach, 0.7 * reach])
    middle = np.array([0.0, 0.0, 1.2])
    spread = np.concatenate([box, box, [0.2, 0.2, 0.2], [0.5, 0.5, 0.5], [0.5, 0.5, 0.5]])

    def spawn(data: SimData, keys: Array) -> SimData:
        x = uniform(keys, data.core.n_drones, len(spread), low=-spread, high=spread)
        start, goal, rpy, vel, ang_vel = jnp.split(x, 5, axis=-1)
        return with_goal(flying(data, middle + start, rotation.from_rpy(rpy), vel, ang_vel), middle + goal)

    def observe(data: SimData) -> dict[str, Array]:
        return state_of(data) | {"difference_to_goal": goal_of(data).pos - data.states.pos}

    def terminated(data: SimData) -> Array:
        return jnp.any(out_of_bounds(data, HALF_WIDTH, HEIGHT), axis=-1)

    def reward(data: SimData, action: Array, last_action: Array) -> Array:
        """Up to 1.5 near the goal, less what is spent on turning and on jerky actions; -10 for a crash."""
        d = away(data)
        spin = jnp.sum(jnp.square(data.states.ang_vel), axis=-1)
        jerk = jnp.sum(jnp.square(action - last_action), axis=-1)
        near = jnp.exp(-2 * d) + 0.5 * jnp.exp(-20 * d)
        return near - 0.002 * spin - 0.02 * jerk - 10.0 * out_of_bounds(data, HALF_WIDTH, HEIGHT)

    settings = {"reach": reach, "seconds": seconds, "tolerance": tolerance}
    return Task("hover", spawn, observe, reward, terminated, away, seconds=seconds, tolerance=tolerance,
                settings=settings, target=lambda data: goal_of(data).pos,
                camera={"lookat": (0, 0, 1.2), "distance": 4.5, "elevation": -20})  # fmt: skip
