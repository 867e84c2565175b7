"""Catch a drone that was thrown into the air."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Simulation
from crazysim.envs.env import Task
from crazysim.envs.random import uniform
from crazysim.envs.spawn import any_attitude, flying
from crazysim.envs.tasks.core import away, goal_of, install_goal, out_of_bounds, state_of, with_goal

HALF_WIDTH, HEIGHT = 8.0, 8.0
"""Edge of the arena, m."""


def recover(
    sim: Simulation, speed: float = 2.0, spin: float = 6.0, seconds: float = 5.0, tolerance: float = 0.1
) -> Task:
    """Return the task of catching a thrown drone: any attitude, speed and spin, to hover at (0, 0, 3).

    Args:
        sim: The simulation, which is given goals.
        speed: Most of each component of the velocity it is thrown with, m/s.
        spin: Most of each body rate, rad/s.
        seconds: Length of an episode, s.
        tolerance: Distance below which the goal counts as reached, m.
    """
    install_goal(sim)
    goal = jnp.array([0.0, 0.0, 3.0])

    def spawn(data: SimData, keys: Array) -> SimData:
        x = uniform(keys, data.core.n_drones, 12)
        pos = goal + 2 * x[..., :3] - 1
        vel, ang_vel = speed * (2 * x[..., 3:6] - 1), spin * (2 * x[..., 6:9] - 1)
        return with_goal(flying(data, pos, any_attitude(x[..., 9:]), vel, ang_vel), goal)

    def observe(data: SimData) -> dict[str, Array]:
        return state_of(data) | {"difference_to_goal": goal_of(data).pos - data.states.pos}

    def terminated(data: SimData) -> Array:
        return jnp.any(out_of_bounds(data, HALF_WIDTH, HEIGHT), axis=-1)

    def reward(data: SimData, action: Array, last_action: Array) -> Array:
        """Up to 2 near the goal and upright, less what is spent on turning and jerky actions; -20 for a crash."""
        d = away(data)
        spins = jnp.sum(jnp.square(data.states.ang_vel), axis=-1)
        jerk = jnp.sum(jnp.square(action - last_action), axis=-1)
        upright = rotation.z_axis(data.states.quat)[..., 2]
        near = jnp.exp(-d) + 0.5 * jnp.exp(-10 * d) + 0.5 * upright
        return near - 0.002 * spins - 0.02 * jerk - 20.0 * out_of_bounds(data, HALF_WIDTH, HEIGHT)

    settings = {"speed": speed, "spin": spin, "seconds": seconds, "tolerance": tolerance}
    return Task("recover", spawn, observe, reward, terminated, away, seconds=seconds, tolerance=tolerance,
                settings=settings, target=lambda data: goal_of(data).pos,
                camera={"lookat": (0, 0, 2.5), "distance": 9.0, "elevation": -15})  # fmt: skip
