"""Follow a trajectory."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import FunctionPlugin, Simulation
from crazysim.envs.env import Task
from crazysim.envs.random import uniform
from crazysim.envs.spawn import flying
from crazysim.envs.tasks.core import NAME, on_floor, state_of
from crazysim.envs.trajectories import Trajectory, figure_eight
from crazysim.pytree import PyTree, leaf

TOO_FAR = 1.5
"""Distance from the trajectory at which an episode ends, m."""
LATEST = 20.0
"""Latest time of the trajectory at which an episode begins, s."""


class Phase(PyTree):
    """Where on the trajectory an episode begins."""

    since: Array = leaf("drone", 1)
    """Time of the trajectory at the episode's beginning, s. (n_worlds, n_drones, 1)"""


def track(
    sim: Simulation,
    trajectory: Trajectory | None = None,
    n_samples: int = 5,
    spacing: float = 0.1,
    seconds: float = 10.0,
    tolerance: float = 0.05,
    spread: float = 0.2,
) -> Task:
    """Return the task of following a trajectory, a figure eight of 2 m by 1 m in 5 s if nothing else is asked for.

    A drone begins near a random point of the trajectory, and sees where the next samples of it are. An episode ends on
    the floor, and 1.5 m away from where the drone should be.

    Args:
        sim: The simulation, which is given the time at which each drone begins.
        trajectory: Time to position and velocity; ``crazysim.envs.trajectories`` has some.
        n_samples: How many points of the time to come a policy sees.
        spacing: Time from one to the next, s.
        seconds: Length of an episode, s.
        tolerance: Distance below which the drone counts as on the trajectory, m.
        spread: Most of each component of the distance at the beginning, m.
    """
    sim.add(FunctionPlugin(NAME, Phase(jnp.zeros_like(sim.data.states.pos[..., :1]))))
    where = figure_eight() if trajectory is None else trajectory
    ahead = spacing * (1 + np.arange(n_samples))
    jitter = np.array([spread] * 3 + [0.2] * 3 + [0.2] * 3)

    def spawn(data: SimData, keys: Array) -> SimData:
        x = uniform(keys, data.core.n_drones, 10)
        offset, rpy, vel = jnp.split((2 * x[..., :9] - 1) * jitter.astype(x.dtype), 3, axis=-1)
        begin = LATEST * x[..., 9:]
        pos, along = where(begin[..., 0])
        data = flying(data, pos + offset, rotation.from_rpy(rpy), along + vel)
        return data.replace(plugins=data.plugins | {NAME: Phase(begin)})

    def time(data: SimData) -> Array:
        return data.plugins[NAME].since[..., 0] + data.core.steps / data.core.freq

    def to_go(data: SimData) -> Array:
        return where(time(data))[0] - data.states.pos

    def observe(data: SimData) -> dict[str, Array]:
        t = time(data)
        points = where(t[..., None] + ahead.astype(t.dtype))[0] - data.states.pos[..., None, :]
        pos, vel = where(t)
        return state_of(data) | {
            "difference_to_goal": pos - data.states.pos,
            "difference_to_target_vel": vel - data.states.vel,
            "local_samples": points.reshape(*points.shape[:-2], -1),
        }

    def error(data: SimData) -> Array:
        return rotation.safe_norm(to_go(data))[..., 0]

    def lost(data: SimData) -> Array:
        return on_floor(data) | (error(data) > TOO_FAR)

    def terminated(data: SimData) -> Array:
        return jnp.any(lost(data), axis=-1)

    def reward(data: SimData, action: Array, last_action: Array) -> Array:
        """Up to 1.5 on the trajectory, less what is spent on jerky actions; -10 where it is lost."""
        d = error(data)
        jerk = jnp.sum(jnp.square(action - last_action), axis=-1)
        return jnp.exp(-3 * d) + 0.5 * jnp.exp(-20 * d) - 0.02 * jerk - 10.0 * lost(data)

    settings = {"n_samples": n_samples, "spacing": spacing, "seconds": seconds, "tolerance": tolerance}
    return Task("track", spawn, observe, reward, terminated, error, seconds=seconds, tolerance=tolerance, hold=5.0,
                settings=settings, target=lambda data: where(time(data))[0],
                camera={"lookat": (0, 0, 0.9), "distance": 3.5, "elevation": -30})  # fmt: skip
