"""Panels: flat pieces of a load's surface, on which air presses."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from crazysim.geometry import Shape

MIN_BALL_PANELS = 24
"""Least number of panels of a ball."""


class Panels(NamedTuple):
    """Flat pieces of a surface, in the frame of its shape."""

    pos: np.ndarray
    """Centres, m. (n, 3)"""
    normal: np.ndarray
    """Unit outward normals. (n, 3)"""
    area: np.ndarray
    """Areas, m^2. (n, 1)"""


def shape_panels(shape: Shape, max_edge: float) -> Panels:
    """Return the surface of a ball or a box as panels.

    The panels of a box are equal rectangles on each side. The panels of a ball have equal areas and lie on a Fibonacci
    spiral.

    Args:
        shape: Sphere or box.
        max_edge: Largest edge of a panel, m; on a ball, the square root of its largest area.
    """
    if shape.kind == "sphere":
        return _ball_panels(shape.size[0], max_edge)
    half_lengths = np.array(shape.size)
    pos, normal, area = [], [], []
    for axis in range(3):
        side_axes = [k for k in range(3) if k != axis]
        counts = [max(1, math.ceil(2 * half_lengths[k] / max_edge - 1e-9)) for k in side_axes]
        lines = [half_lengths[k] * (2 * (np.arange(n) + 0.5) / n - 1) for k, n in zip(side_axes, counts, strict=True)]
        grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 2)
        for side in (-1.0, 1.0):
            points = np.zeros((len(grid), 3))
            points[:, side_axes], points[:, axis] = grid, side * half_lengths[axis]
            pos.append(points)
            normal.append(np.tile(side * np.eye(3)[axis], (len(grid), 1)))
            area.append(
                np.full((len(grid), 1), 4 * half_lengths[side_axes[0]] * half_lengths[side_axes[1]] / len(grid))
            )
    return Panels(*(np.concatenate(x) for x in (pos, normal, area)))


def _ball_panels(radius: float, max_edge: float) -> Panels:
    surface = 4 * math.pi * radius**2
    n = max(MIN_BALL_PANELS, math.ceil(surface / max_edge**2))
    z = 1 - 2 * (np.arange(n) + 0.5) / n
    angle = np.arange(n) * math.pi * (3 - math.sqrt(5))
    horizontal_radius = np.sqrt(1 - z**2)
    normal = np.stack([horizontal_radius * np.cos(angle), horizontal_radius * np.sin(angle), z], axis=-1)
    return Panels(radius * normal, normal, np.full((n, 1), surface / n))
