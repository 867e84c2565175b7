"""Fly with a given velocity."""

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
from crazysim.envs.tasks.core import goal_of, install_goal, on_floor, state_of, with_goal

HEIGHT = 5.0
"""Where episodes begin, m; high enough to sink for as long as they last at most speeds."""


def reach_vel(sim: Simulation, speed: float = 1.0, seconds: float = 4.0, tolerance: float = 0.1) -> Task:
    """Return the task of reaching a random velocity and keeping it. Its error is a difference of velocities, m/s.

    A drone begins in flight, 5 m high, slightly tilted and moving. An episode ends on the floor.

    Args:
        sim: The simulation, which is given goals.
        speed: Most of each component of the velocity, m/s; the vertical one is a quarter of it at most.
        seconds: Length of an episode, s.
        tolerance: Difference below which the velocity counts as reached, m/s.
    """
    install_goal(sim)
    spread = np.array([1.0, 1.0, 0.0, 0.2, 0.2, 0.2, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, speed, speed, speed / 4])

    def spawn(data: SimData, keys: Array) -> SimData:
        x = uniform(keys, data.core.n_drones, len(spread), low=-spread, high=spread)
        offset, rpy, vel, ang_vel, goal = jnp.split(x, 5, axis=-1)
        start = offset + np.array([0.0, 0.0, HEIGHT])
        return with_goal(flying(data, start, rotation.from_rpy(rpy), vel, ang_vel), start, goal)

    def missing(data: SimData) -> Array:
        return goal_of(data).vel - data.states.vel

    def observe(data: SimData) -> dict[str, Array]:
        return state_of(data) | {"difference_to_target_vel": missing(data)}

    def error(data: SimData) -> Array:
        return rotation.safe_norm(missing(data))[..., 0]

    def terminated(data: SimData) -> Array:
        return jnp.any(on_floor(data), axis=-1)

    def reward(data: SimData, action: Array, last_action: Array) -> Array:
        """Up to 1.5 near the velocity, less what is spent on turning and on jerky actions; -10 for a crash."""
        d = error(data)
        spin = jnp.sum(jnp.square(data.states.ang_vel), axis=-1)
        jerk = jnp.sum(jnp.square(action - last_action), axis=-1)
        return jnp.exp(-d) + 0.5 * jnp.exp(-10 * d) - 0.002 * spin - 0.02 * jerk - 10.0 * on_floor(data)

    settings = {"speed": speed, "seconds": seconds, "tolerance": tolerance}
    return Task("reach_vel", spawn, observe, reward, terminated, error, seconds=seconds, tolerance=tolerance,
                settings=settings)  # fmt: skip
