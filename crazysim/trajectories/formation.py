"""Formations: positions of n drones (n, 3), as starts, targets or offsets of trajectories."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from crazysim.core.data import grid_2d
from crazysim.core.settings import positive_integer
from crazysim.errors import require
from crazysim.tables import read_floats
from crazysim.trajectories.curves import require_positive, require_vector
from crazysim.trajectories.trajectory import MAX_SIZE

CENTER = (0.0, 0.0, 1.0)
"""Default centre of a formation, m."""


def line(n: int, spacing: float = 1.0, center: ArrayLike = CENTER, yaw: float = 0.0) -> np.ndarray:
    """Place drones on a level line, along x at a yaw of zero, m. (n, 3)

    Args:
        n: Number of drones.
        spacing: Distance between neighbours, m.
        center: Centre, world frame, m. (3,)
        yaw: Angle by which the line is rotated around its centre, rad.
    """
    x = require_positive("spacing", spacing) * (np.arange(positive_integer("n", n)) - (n - 1) / 2)
    return _rotate_and_translate(np.stack([x, np.zeros(n)], axis=-1), center, yaw)


def grid(n: int, spacing: float = 1.0, center: ArrayLike = CENTER, yaw: float = 0.0) -> np.ndarray:
    """Return the positions of a level square grid that are nearest to its centre, nearest first, m. (n, 3)

    Args:
        n: Number of drones.
        spacing: Distance between neighbours, m.
        center: Centre, world frame, m. (3,)
        yaw: Angle by which the grid is rotated around its centre, rad.
    """
    return _rotate_and_translate(grid_2d(positive_integer("n", n), require_positive("spacing", spacing)), center, yaw)


def circle(
    n: int,
    spacing: float | None = None,
    radius: float | None = None,
    center: ArrayLike = CENTER,
    yaw: float = 0.0,
) -> np.ndarray:
    """Place drones on a level circle, counterclockwise, the first along x at a yaw of zero, m. (n, 3)

    Args:
        n: Number of drones.
        spacing: Distance between neighbours, m; None for 1 m, or for the distance that ``radius`` gives.
        radius: Radius, m, instead of the spacing.
        center: Centre, world frame, m. (3,)
        yaw: Angle by which the circle is rotated around its centre, rad.
    """
    require(
        spacing is None or radius is None,
        f"expected spacing or radius, got both: {spacing!r} and {radius!r} m. Leave one out.",
    )
    angle = 2 * math.pi * np.arange(positive_integer("n", n)) / n
    if radius is None:
        side = require_positive("spacing", 1.0 if spacing is None else spacing)
        radius = side / (2 * math.sin(math.pi / n)) if n > 1 else 0.0
    else:
        radius = require_positive("radius", radius)
    return _rotate_and_translate(radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1), center, yaw)


def matched(starts: ArrayLike, targets: ArrayLike) -> np.ndarray:
    """Return the targets ordered so that straight flights of equal duration keep clear of each other, m. (n, 3)

    The order minimises the sum of the squared distances. Drones that start and end together then never come closer than
    the smallest distance within either formation divided by the square root of two (Turpin, Michael and Kumar, "CAPT:
    concurrent assignment and planning of trajectories for multiple robots", IJRR 2014).

    Args:
        starts: Positions from which the drones start, m. (n, 3)
        targets: Positions to fly to, in any order, m. (n, 3)
    """
    a, b = read_floats("starts", starts), read_floats("targets", targets)
    require(
        a.shape == b.shape
        and a.ndim == 2
        and a.shape[1] == 3
        and np.all((np.abs(a) <= MAX_SIZE) & (np.abs(b) <= MAX_SIZE)),
        f"expected as many finite starts as targets, (n, 3) each and of a size up to {MAX_SIZE:g}, got "
        f"shapes {a.shape} and {b.shape}. Pass positions in metres.",
    )
    from scipy.optimize import linear_sum_assignment  # a fifth of a second to import

    squares = np.sum(np.square(a[:, None] - b), axis=-1)
    return b[linear_sum_assignment(squares)[1]]


def _rotate_and_translate(level_pos: np.ndarray, center: ArrayLike, yaw: ArrayLike) -> np.ndarray:
    angle, middle = float(require_vector("yaw", yaw, ())), require_vector("center", center)
    cos, sin = math.cos(angle), math.sin(angle)
    return np.pad(level_pos @ np.array([[cos, sin], [-sin, cos]]), ((0, 0), (0, 1))) + middle
