"""Several trajectories on a common clock, in float64 on the host, to evaluate many drones at many times."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.errors import ConfigError, require
from crazysim.tables import read_floats
from crazysim.trajectories.bezier import restrict_interval
from crazysim.trajectories.trajectory import N_DERIVATIVES, Trajectory

MAX_DURATION = 86_400.0
"""Longest duration, and largest time before it at which a trajectory may start, s: a day."""
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class PieceTable:
    """Pieces of several trajectories on a common clock, sorted by drone and time."""

    duration: float
    """Duration of all trajectories together, from time zero, s."""
    drone: Ints
    """Index of the drone of each piece. (n_pieces,)"""
    start: Floats
    """Start of each piece, s. (n_pieces,)"""
    length: Floats
    """Duration of each piece, s. (n_pieces,)"""
    coefficients: Floats
    """Coefficients of x, y, z, m, and yaw, rad, in a piece's time divided by its length. (n_pieces, 4, degree + 1)"""

    @staticmethod
    def create(
        trajectories: Sequence[Trajectory], starts: ArrayLike = 0.0, duration: float | None = None
    ) -> PieceTable:
        """Return the pieces of trajectories, with pieces at rest before the start and after the end of each trajectory.

        Args:
            trajectories: Trajectories, one for each drone.
            starts: Start of each trajectory, s; negative if it began before time zero. () or (n_drones,)
            duration: Duration, s; None to end with the last trajectory. A repeating trajectory then ends after one
                round.
        """
        require(trajectories, "expected at least one trajectory, got none. Pass a list with one per drone.")
        start_times = read_floats("starts", starts)
        n_drones = len(trajectories)
        if start_times.shape not in ((), (n_drones,)) or not np.all(np.isfinite(start_times)):
            raise ConfigError(f"expected one finite start, s, or one for each of {n_drones} drones, got {starts!r}")
        starts = np.broadcast_to(start_times, (n_drones,))
        host_trajectories = [jax.tree.map(np.asarray, trajectory) for trajectory in trajectories]
        ends = [start + float(t.ends[-1]) for start, t in zip(starts, host_trajectories, strict=True)]
        end = max(ends) if duration is None else float(duration)
        if not 0 < end < MAX_DURATION or np.min(starts) < -MAX_DURATION:
            actual_text = f"{duration!r}" if duration is not None else f"trajectories that end at {end:g} s"
            raise ConfigError(
                f"expected a positive, finite duration of up to a day, s, and starts within a day, got "
                f"{actual_text} and starts from {np.min(starts):g} s. Use for example duration=10.0."
            )
        n_coefficients = max(t.coefficients.shape[-1] for t in host_trajectories)
        parts = [
            _collect_pieces(t, start, end, n_coefficients) for t, start in zip(host_trajectories, starts, strict=True)
        ]
        drone = np.repeat(np.arange(n_drones), [len(part[0]) for part in parts])
        return PieceTable(end, drone, *(np.concatenate(x) for x in zip(*parts, strict=True)))

    @property
    def n_drones(self) -> int:
        return int(self.drone[-1]) + 1

    @functools.cached_property
    def first_pieces(self) -> Ints:
        """Index of the first piece of each drone. (n_drones,)"""
        return np.searchsorted(self.drone, np.arange(self.n_drones))

    @functools.cached_property
    def _keys(self) -> Floats:
        return self.drone * (self.duration + 1) + self.start

    @functools.cached_property
    def _derivatives(self) -> list[Floats]:
        derivatives, c = [self.coefficients], self.coefficients
        for _ in range(N_DERIVATIVES):
            c = c[..., 1:] * np.arange(1, c.shape[-1]) if c.shape[-1] > 1 else np.zeros_like(c)
            c = c / self.length[:, None, None]
            derivatives.append(c)
        return derivatives

    def derivative_coefficients(self, order: int) -> Floats:
        """Return the coefficients of a derivative, up to snap. (n_pieces, 4, degree + 1 - order)"""
        return self._derivatives[order]

    def find_pieces(self, drone: Ints, t: NDArray) -> Ints:
        """Return the index of the piece that contains each drone's time; where two pieces meet, the later one. (...)"""
        t = np.clip(t, 0.0, self.duration)
        index = np.searchsorted(self._keys, np.asarray(drone) * (self.duration + 1) + t, side="right") - 1
        return np.maximum(index, self.first_pieces[drone])

    def evaluate_pieces(self, piece: Ints, u: Floats, order: int = 0) -> Floats:
        """Return a derivative of x, y, z and yaw at times within pieces. (..., 4)

        Args:
            piece: Indices of pieces. (...)
            u: Time since the start of the piece divided by its duration. (...)
            order: Order of the derivative.
        """
        c = self._derivatives[order][piece]
        value = c[..., -1]
        for k in reversed(range(c.shape[-1] - 1)):
            value = value * u[..., None] + c[..., k]
        return value

    def evaluate(self, drone: Ints, t: NDArray, order: int = 0) -> Floats:
        """Return a derivative of x, y, z and yaw of drones at times. (...) -> (..., 4)"""
        piece = self.find_pieces(drone, t)
        return self.evaluate_pieces(piece, (t - self.start[piece]) / self.length[piece], order)


def _collect_pieces(
    trajectory: Trajectory, start: float, duration: float, n_coefficients: int
) -> tuple[Floats, Floats, Floats]:
    ends = np.asarray(trajectory.ends, float)
    starts = np.concatenate([[0.0], ends[:-1]])
    has_length = ends > starts  # the others are padding
    starts, lengths = starts[has_length], (ends - starts)[has_length]
    c = np.zeros((len(starts), 4, n_coefficients))
    c[..., : trajectory.coefficients.shape[-1]] = trajectory.coefficients[has_length]
    period = ends[-1]
    if trajectory.repeats:
        start -= period * max(0.0, np.floor(-start / period))  # omits rounds that end before time zero
    n_rounds = max(1, int(np.ceil((duration - start) / period - 1e-9))) if trajectory.repeats else 1
    starts = (start + period * np.arange(n_rounds)[:, None] + starts).ravel()
    after_zero = _cut_at_zero(starts, np.tile(lengths, n_rounds), np.tile(c, (n_rounds, 1, 1)))
    parts = [after_zero]
    first_pose, last_pose = c[0, :, :1], c[-1].sum(axis=-1, keepdims=True)
    end = max(start + period * n_rounds, 0.0)
    if start > 0:
        parts.insert(0, _resting_piece(0.0, start, first_pose, n_coefficients))
    if end < duration:
        parts.append(_resting_piece(end, duration - end, last_pose, n_coefficients))
    starts, lengths, c = (np.concatenate(x) for x in zip(*parts, strict=True))
    is_before_end = starts < duration
    return starts[is_before_end], lengths[is_before_end], c[is_before_end]


def _cut_at_zero(starts: Floats, lengths: Floats, coefficients: Floats) -> tuple[Floats, Floats, Floats]:
    ends_after_zero = starts + lengths > 0
    starts, lengths, coefficients = starts[ends_after_zero], lengths[ends_after_zero], coefficients[ends_after_zero]
    if len(starts) and starts[0] < 0:
        coefficients[0] = restrict_interval(coefficients[0], -starts[0] / lengths[0], 1.0)
        lengths[0], starts[0] = lengths[0] + starts[0], 0.0
    return starts, lengths, coefficients


def _resting_piece(start: float, length: float, pose: Floats, n_coefficients: int) -> tuple[Floats, Floats, Floats]:
    return np.array([start]), np.array([length]), np.pad(pose, ((0, 0), (0, n_coefficients - 1)))[None]
