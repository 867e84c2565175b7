"""Piecewise polynomial trajectories of Crazyswarm2 scripts, and their CSV files."""

from __future__ import annotations

from pathlib import Path as FilePath
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import ArrayLike, NDArray

from crazysim.errors import require
from crazysim.lab.live.host_trajectory import HostTrajectory
from crazysim.lab.trajectory_files.csv import parse_table
from crazysim.lab.trajectory_files.polynomials import check_rows
from crazysim.storage import MAX_TEXT_BYTES, read_text


class Polynomial:
    """Polynomial of time."""

    def __init__(self, p: ArrayLike):
        self.p = np.asarray(p, float)

    def eval(self, t: float) -> float:
        """Return the value at a time, s."""
        return float(polyval(float(t), self.p))

    def derivative(self) -> Polynomial:
        return Polynomial(self.p[1:] * np.arange(1, len(self.p)) if len(self.p) > 1 else [0.0])


class Polynomial4D(NamedTuple):
    """Polynomials of position and yaw on one piece."""

    duration: float
    """Duration, s."""
    px: Polynomial
    """x, m."""
    py: Polynomial
    """y, m."""
    pz: Polynomial
    """z, m."""
    pyaw: Polynomial
    """Yaw, rad."""


class TrajectoryOutput(NamedTuple):
    """Point of a trajectory."""

    pos: NDArray
    """Position, m. (3,)"""
    vel: NDArray
    """Velocity, m/s. (3,)"""
    acc: NDArray
    """Acceleration, m/s^2. (3,)"""
    omega: NDArray
    """Body rates of a level drone: (0, 0, yaw rate), rad/s. (3,)"""
    yaw: float
    """Yaw, rad."""


class Trajectory:
    """Trajectory of several pieces."""

    def __init__(self) -> None:
        self.polynomials: list[Polynomial4D] = []
        self.duration = 0.0

    def loadcsv(self, filename: str | FilePath, skip_first_row: bool = True) -> None:
        """Read pieces from a CSV file; each row has the duration, and eight coefficients each of x, y, z and yaw.

        Raises:
            ConfigError: If the file has another format.
        """
        rows = parse_table(read_text(filename, MAX_TEXT_BYTES).splitlines()[int(skip_first_row) :], str(filename))
        require(rows.shape[1] == 33, f"expected rows of 33 numbers in {str(filename)!r}, got {rows.shape[1]}")
        durations, coefficients = check_rows(rows, str(filename))
        self.polynomials = [
            Polynomial4D(float(duration), *map(Polynomial, piece))
            for duration, piece in zip(durations, coefficients, strict=True)
        ]
        self.duration = float(durations.sum())

    def n_pieces(self) -> int:
        """Return the number of pieces."""
        return len(self.polynomials)

    def eval(self, t: float) -> TrajectoryOutput:
        """Return the point at a time, s; before the start and after the end, the nearest end point."""
        derivatives = self.host_trajectory().derivatives(t, 2)
        return TrajectoryOutput(
            derivatives[0, :3],
            derivatives[1, :3],
            derivatives[2, :3],
            np.array([0, 0, derivatives[1, 3]]),
            derivatives[0, 3],
        )

    def host_trajectory(self) -> HostTrajectory:
        """Return the trajectory for ``Commander.upload``."""
        pieces = [[p.px.p, p.py.p, p.pz.p, p.pyaw.p] for p in self.polynomials]
        durations = np.array([p.duration for p in self.polynomials], float)
        n = max((len(c) for piece in pieces for c in piece), default=0)
        coefficients = np.array([[np.pad(c, (0, n - len(c))) for c in piece] for piece in pieces], float)
        require(
            n and np.isfinite(coefficients).all() and (durations > 0).all() and np.isfinite(durations).all(),
            f"expected pieces of finite coefficients and positive durations, got {len(pieces)} pieces",
        )
        return HostTrajectory.of_pieces(durations, coefficients)
