"""Initial poses of cars: in a row, at given positions, or along their paths."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.lab.vehicles.path import Path

START_SPACING = 1.0
"""Distance between neighbours of the default row of cars, m."""


def row_positions(n: int) -> NDArray:
    """Return positions in a row along y around the origin, m. (n, 2)"""
    return np.stack([np.zeros(n), START_SPACING * (np.arange(n) - (n - 1) / 2)], axis=1)


def path_poses(
    paths: Path, index: NDArray, start: NDArray, counts: tuple[int, int]
) -> tuple[NDArray, NDArray, NDArray]:
    """Return positions, m, headings, rad, and arc lengths, m, of cars on their paths at time zero.

    Args:
        index: Index of each car's path. (n_worlds, n_members, 1)
        start: Time at which each car is at the start of its path, s. (n_worlds, n_members, 1)
        counts: Numbers of worlds and of cars.

    Returns:
        Arrays (n_worlds, n_members, 2), (n_worlds, n_members, 1) and (n_worlds, n_members, 1).
    """
    pos, yaw, arc = np.zeros((*counts, 2)), np.zeros((*counts, 1)), np.zeros((*counts, 1))
    poses: dict[tuple[int, float], tuple[ArrayLike, float, float]] = {}
    for member in np.ndindex(counts):
        key = int(index[member][0]), float(start[member][0])
        if key not in poses:
            poses[key] = paths.initial_pose(*key)
        pos[member], yaw[member], arc[member] = poses[key]
    return pos, yaw, arc


def project_arcs(paths: Any, index: Any, pos: NDArray, arc: NDArray) -> NDArray:
    """Return the arc lengths of the points of paths that are nearest to cars, m. (n_worlds, n_members, 1)

    Args:
        index: Index of each car's path. (n_worlds, n_members, 1)
        pos: Positions of the cars, m. (n_worlds, n_members, 2)
        arc: Reference arc lengths, m; on closed paths the result is in the lap nearest to them.
            (n_worlds, n_members, 1)
    """
    projections = np.empty_like(arc)
    for member in np.ndindex(arc.shape[:2]):
        k = int(index[member][0])
        nearest_arc, length = paths.nearest_arc(k, pos[member]), float(paths.length[k])
        laps = round((float(arc[member][0]) - nearest_arc) / length) if paths.closed[k] else 0
        projections[member] = nearest_arc + laps * length
    return projections


def spread_start_times(paths: Path, index: NDArray, n: int) -> NDArray:
    """Return start times of n cars, s: equally spaced over the duration of a closed path, zero on open paths. (n,)"""
    indices, times = index.reshape(-1)[:n], np.zeros(n)
    for path in np.unique(indices):
        cars = np.flatnonzero(indices == path)
        if np.asarray(paths.closed)[path]:
            times[cars] = -np.arange(len(cars)) / len(cars) * float(paths.duration[path])
    return times
