"""Motions of the high-level commander: smooth moves and uploaded trajectories, as in the firmware of the Crazyflie."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.lab.live.host_trajectory import HostTrajectory

NO_JERK_INVERSE = np.linalg.inv(
    [[k * (k - 1) * (k - 2) if d == 3 else [1, k, k * (k - 1)][d] for k in range(4, 8)] for d in range(4)]
)
"""Inverse of the matrix of the powers 4 to 7 and their derivatives 1, 2, 3 at the end of the unit interval. (4, 4)"""


class PlannedMotion(NamedTuple):
    """A trajectory with the time, speed, direction and offset of its flight."""

    trajectory: HostTrajectory
    """Trajectory."""
    start_time: float
    """Time at which it starts, s."""
    timescale: float = 1.0
    """Factor of its duration."""
    reversed: bool = False
    """Whether it is followed from its end to its start."""
    offset: NDArray = np.zeros(4)
    """Offset of position, m, and yaw, rad. (4,)"""
    is_landing: bool = False
    """Whether the motors stop at its end."""

    @property
    def end_time(self) -> float:
        """Time at which it ends, s."""
        return self.start_time + self.trajectory.duration * self.timescale

    def has_ended(self, t: float) -> bool:
        """Whether the motion has ended at a time, s."""
        return not self.trajectory.repeats and t >= self.end_time

    def evaluate(self, t: float) -> NDArray:
        """Return position and yaw, their rates and second derivatives at a time, s. (3, 4)"""
        elapsed = (t - self.start_time) / self.timescale
        rate = (-1.0 if self.reversed else 1.0) / self.timescale
        derivatives = self.trajectory.derivatives(self.trajectory.duration - elapsed if self.reversed else elapsed, 2)
        derivatives = derivatives * np.array([1.0, rate, rate * rate])[:, None]
        derivatives[0] += self.offset
        return derivatives


def plan_move(start: ArrayLike, goal: ArrayLike, duration: float, linear: bool = False) -> HostTrajectory:
    """Return the trajectory of a move that ends at rest at a goal.

    It is the polynomial of degree 7 with the given position, velocity and acceleration at its start, at rest at its
    end, and without jerk at both ends (crazyflie-firmware, ``piecewise_plan_7th_order_no_jerk``). If ``linear``, it is
    the straight line at constant speed.

    Args:
        start: Position, m, and yaw, rad, their rates and second derivatives at the start. (3, 4)
        goal: Position, m, and yaw, rad, at the end. (4,)
        duration: Duration, s.
        linear: Whether to move along the straight line.
    """
    p, v, a = np.asarray(start, float) * np.array([1.0, duration, duration**2 / 2])[:, None]
    goal = np.asarray(goal, float)
    if linear:
        coefficients = np.stack([p, goal - p], axis=-1)
    else:
        low_coefficients = np.stack([p, v, a, np.zeros(4)])
        end_conditions = np.stack([goal - p - v - a, -v - 2 * a, -2 * a, np.zeros(4)])
        coefficients = np.concatenate([low_coefficients, NO_JERK_INVERSE @ end_conditions]).T
    return HostTrajectory(np.array([duration]), coefficients[None], False)


def nearest_yaw(yaw: float, goal: float) -> float:
    """Return the angle nearest to a yaw, rad, that differs from a goal by whole turns."""
    return yaw + (goal - yaw + np.pi) % (2 * np.pi) - np.pi
