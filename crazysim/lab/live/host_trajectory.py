"""Trajectories on the host: setpoints of one vehicle at one time, without a compiled call."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from crazysim.trajectories import Trajectory


class HostTrajectory(NamedTuple):
    """One trajectory in float64."""

    ends: NDArray
    """End of each piece, s since the start. (n_pieces,)"""
    coefficients: NDArray
    """Coefficients of the polynomials of x, y, z, m, and yaw, rad, constant term first. Their variable is the time
    since the start of the piece divided by its duration. (n_pieces, 4, degree + 1)"""
    repeats: bool
    """Whether the trajectory starts again after its end."""

    @staticmethod
    def from_trajectory(trajectory: Trajectory) -> HostTrajectory:
        """Return the trajectory in a record without leading axes."""
        ends, coefficients = (np.asarray(x, float) for x in (trajectory.ends, trajectory.coefficients))
        return HostTrajectory(ends, coefficients, bool(trajectory.repeats))

    @staticmethod
    def of_pieces(durations: NDArray, coefficients: NDArray) -> HostTrajectory:
        """Return the trajectory of pieces whose coefficients are for the time in seconds."""
        scaled_coefficients = coefficients * durations[:, None, None] ** np.arange(coefficients.shape[2])
        return HostTrajectory(np.cumsum(durations), scaled_coefficients, False)

    @property
    def duration(self) -> float:
        """Time from the start to the end, s."""
        return float(self.ends[-1])

    def setpoint(self, t: float) -> NDArray:
        """Return position, m, and yaw, rad, at a time since the start, s. (4,)"""
        return self.derivatives(t, 0)[0]

    def derivatives(self, t: float, n: int) -> NDArray:
        """Return position and yaw and their first n derivatives at a time since the start, s. (n + 1, 4)"""
        end = float(self.ends[-1])
        is_inside = t >= 0 and (self.repeats or t <= end)
        t = t % end if self.repeats and t > 0 else min(max(t, 0.0), end)
        piece = min(bisect_right(self.ends, t), len(self.ends) - 1)  # type: ignore[arg-type]
        start = float(self.ends[piece - 1]) if piece else 0.0
        length = float(self.ends[piece]) - start
        u, rate = ((t - start) / length, 1 / length) if length > 0 else (1.0, 0.0)
        factors, exponents, orders = _derivative_terms(n, self.coefficients.shape[2])
        scale = (rate if is_inside else 0.0) ** orders
        return (factors * u**exponents * scale[:, None]) @ self.coefficients[piece].T


@lru_cache
def _derivative_terms(n: int, size: int) -> tuple[NDArray, NDArray, NDArray]:
    # Factors and exponents have shape (n + 1, size), orders (n + 1,).
    orders, powers = np.arange(n + 1), np.arange(size)
    factors = np.array([[math.perm(k, j) for k in range(size)] for j in range(n + 1)], float)
    return factors, np.maximum(powers - orders[:, None], 0), orders


def to_host_trajectories(trajectories: Trajectory | Sequence[Trajectory]) -> list[HostTrajectory]:
    """Return the trajectories in a record, with or without a leading axis, or in a sequence of records, as a list."""
    if not isinstance(trajectories, Trajectory):
        return [HostTrajectory.from_trajectory(t) for t in trajectories]
    if np.ndim(trajectories.ends) == 1:
        return [HostTrajectory.from_trajectory(trajectories)]
    t = trajectories
    leaves = [np.asarray(x) for x in (t.ends, t.coefficients, t.repeats)]
    return [HostTrajectory(e.astype(float), c.astype(float), bool(r)) for e, c, r in zip(*leaves, strict=True)]
