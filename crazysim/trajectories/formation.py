"""Formations: places of several drones, for starts, targets and offsets of trajectories. (n, 3) each"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from crazysim.core.data import grid_2d
from crazysim.errors import ConfigError

CENTER = (0.0, 0.0, 1.0)
"""Default centre of a formation, m."""


def line(n: int, spacing: float = 1.0, center: ArrayLike = CENTER, yaw: float = 0.0) -> np.ndarray:
    """Return places on a level line, along x at a yaw of zero, m. (n, 3)

    Args:
        n: Number of places.
        spacing: Distance between neighbours, m.
        center: Centre, world frame, m. (3,)
        yaw: Angle by which the line is turned around its centre, rad.

    Raises:
        ConfigError: If a setting is invalid.
    """
    x = _size("spacing", spacing) * (np.arange(_count(n)) - (n - 1) / 2)
    return _placed(np.stack([x, np.zeros(n)], axis=-1), center, yaw)


def grid(n: int, spacing: float = 1.0, center: ArrayLike = CENTER, yaw: float = 0.0) -> np.ndarray:
    """Return the places of a level square grid nearest to its centre, nearest first, m. (n, 3)

    Args:
        n: Number of places.
        spacing: Distance between neighbours, m.
        center: Centre, world frame, m. (3,)
        yaw: Angle by which the grid is turned around its centre, rad.

    Raises:
        ConfigError: If a setting is invalid.
    """
    return _placed(grid_2d(_count(n), _size("spacing", spacing)), center, yaw)


def circle(
    n: int,
    spacing: float | None = None,
    radius: float | None = None,
    center: ArrayLike = CENTER,
    yaw: float = 0.0,
) -> np.ndarray:
    """Return places on a level circle, counterclockwise, the first along x at a yaw of zero, m. (n, 3)

    Args:
        n: Number of places.
        spacing: Distance between neighbours, m; None for 1 m, or for what the radius gives.
        radius: Radius instead, m.
        center: Centre, world frame, m. (3,)
        yaw: Angle by which the circle is turned, rad.

    Raises:
        ConfigError: If a setting is invalid, or both spacing and radius are given.
    """
    if spacing is not None and radius is not None:
        raise ConfigError(f"expected spacing or radius, got both: {spacing!r} and {radius!r} m. Leave one out.")
    angle = 2 * math.pi * np.arange(_count(n)) / n
    if radius is None:
        side = _size("spacing", 1.0 if spacing is None else spacing)
        radius = side / (2 * math.sin(math.pi / n)) if n > 1 else 0.0
    else:
        radius = _size("radius", radius)
    return _placed(radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1), center, yaw)


def matched(starts: ArrayLike, targets: ArrayLike) -> np.ndarray:
    """Return the targets in an order in which straight flights of equal duration keep clear of each other, m. (n, 3)

    The order minimises the sum of the squared distances. Drones that start and end together then never come closer than
    the smallest distance within either formation divided by the square root of two (Turpin, Michael and Kumar, "CAPT:
    concurrent assignment and planning of trajectories for multiple robots", IJRR 2014).

    Args:
        starts: Places that the drones start from, m. (n, 3)
        targets: Places to fly to, in any order, m. (n, 3)

    Raises:
        ConfigError: If they are not as many finite places.
    """
    a, b = np.asarray(starts, float), np.asarray(targets, float)
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] != 3 or not np.all(np.isfinite(a) & np.isfinite(b)):
        raise ConfigError(f"expected as many finite starts as targets, (n, 3) each, got shapes {a.shape} and {b.shape}")
    from scipy.optimize import linear_sum_assignment  # a fifth of a second to import

    squares = np.sum(np.square(a[:, None] - b), axis=-1)
    return b[linear_sum_assignment(squares)[1]]


def _placed(level: np.ndarray, center: Any, yaw: Any) -> np.ndarray:
    """Return level places, (n, 2), turned around the origin and moved to a centre. (n, 3)"""
    for name, value, shape in (("center", center, (3,)), ("yaw", yaw, ())):
        array = np.asarray(value)
        if array.shape != shape or array.dtype.kind not in "iuf" or not np.all(np.isfinite(array)):
            raise ConfigError(f"expected {name} as finite numbers of shape {shape}, got {value!r}")
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.pad(level @ np.array([[cos, sin], [-sin, cos]]), ((0, 0), (0, 1))) + np.asarray(center, float)


def _count(n: Any) -> int:
    if isinstance(n, bool) or not isinstance(n, (int, np.integer)) or n < 1:
        raise ConfigError(f"expected a number of places of at least 1, got {n!r}")
    return int(n)


def _size(name: str, value: Any) -> float:
    is_number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    if not is_number or not 0 < value < np.inf:
        raise ConfigError(f"expected {name} as a positive, finite number of metres, got {value!r}")
    return float(value)
