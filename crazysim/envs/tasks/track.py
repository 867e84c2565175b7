"""Follow a trajectory."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import field

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import state
from crazysim.core.settings import setting
from crazysim.envs import terms
from crazysim.envs.random import draw
from crazysim.envs.spawn import flying
from crazysim.envs.task import Task
from crazysim.envs.tasks.goals import on_floor, state_of
from crazysim.trajectories import Trajectory, figure_eight

MAX_ERROR = 1.5
"""Distance from the trajectory at which an episode ends, m."""
MAX_SAMPLES = 1000
"""Largest number of future samples; ``local_samples`` then has 3,000 numbers."""
MAX_START_TIME = 20.0
"""Latest time on the trajectory at which an episode starts, s."""


class TrackTrajectory(Task):
    """Follow a trajectory.

    A drone starts near a random point of the trajectory, and observes the next samples of the trajectory. An episode
    ends when a drone touches the floor, or is more than 1.5 m away from its position on the trajectory.
    """

    name = "track"
    film_view = {"lookat": (0, 0, 0.9), "distance": 3.5, "elevation": -30}

    trajectory: Trajectory = field(default_factory=figure_eight)
    """The trajectory; by default a figure eight of 2 m by 1 m in 5 s, which repeats."""
    n_samples: int = setting(default=5, low=1, high=MAX_SAMPLES)
    """Number of future samples of the trajectory that a policy observes."""
    spacing: float = setting(default=0.1, positive=True)
    """Time between samples, s."""
    spread: float = setting(default=0.2, low=0.0)
    """Largest component of the offset from the trajectory at the start, m."""
    seconds: float = 10.0
    """Length of an episode, s."""
    tolerance: float = 0.05
    """Distance below which the drone is on the trajectory, m."""
    hold: float = 5.0
    """Time at the end of an episode during which the drone must stay on the trajectory, s."""

    start_time: Array = state()
    """Time on the trajectory at the start of the episode, s."""

    def spawn(self, data: SimData, key: Array) -> SimData:
        x = draw(key, data.core.n_drones, offset=3, rpy=3, vel=3, start_time=1)
        dtype = data.states.pos.dtype
        offset = (2 * x["offset"] - 1) * np.asarray(self.spread, dtype)
        rpy, vel = ((2 * x[name] - 1) * np.asarray(0.2, dtype) for name in ("rpy", "vel"))
        start_time = MAX_START_TIME * x["start_time"]
        pos, path_vel = self.motion(start_time[..., 0])
        data = flying(data, pos + offset, rotation.from_rpy(rpy), path_vel + vel)
        return self.write(data, start_time=start_time)

    def time(self, data: SimData) -> Array:
        """Return the time on the trajectory, s. (n_drones,)"""
        return self.read(data).start_time[..., 0] + data.core.steps / data.core.freq

    def motion(self, t: Array) -> tuple[Array, Array]:
        """Return position, m, and velocity, m/s, at times on the trajectory, s. (...) to (..., 3) each"""
        pos, vel = self._derivatives(t, 1)
        return pos, vel

    def _derivatives(self, t: Array, order: int) -> list[Array]:
        evaluate: Callable[[Array], list[Array]] = functools.partial(self.trajectory.derivatives, order=order)
        for _ in range(t.ndim):
            evaluate = jax.vmap(evaluate)
        return [x[..., :3] for x in evaluate(t)]

    def observe(self, data: SimData) -> dict[str, Array]:
        t, s = self.time(data), data.states
        times = t[..., None] + (self.spacing * np.arange(1 + self.n_samples)).astype(t.dtype)
        pos, vel = self.motion(times)  # at the current time and at the samples
        points = pos[..., 1:, :] - s.pos[..., None, :]
        return state_of(data) | {
            "difference_to_goal": pos[..., 0, :] - s.pos,
            "difference_to_target_vel": vel[..., 0, :] - s.vel,
            "local_samples": points.reshape(*points.shape[:-2], -1),
        }

    def rewards(self, data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
        return {
            "proximity": terms.proximity(self.error(data), coarse=3.0),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "lost": -10.0 * self.is_lost(data),
        }

    def is_lost(self, data: SimData) -> Array:
        """Whether a drone is on the floor or too far from the trajectory. (n_drones,)"""
        return on_floor(data) | (self.error(data) > MAX_ERROR)

    def terminated(self, data: SimData) -> Array:
        return jnp.any(self.is_lost(data))

    def error(self, data: SimData) -> Array:
        return rotation.safe_norm(self.target(data) - data.states.pos)[..., 0]

    def target(self, data: SimData) -> Array:
        t = self.time(data)
        return self._derivatives(t, 0)[0] if isinstance(self.trajectory, Trajectory) else self.motion(t)[0]
