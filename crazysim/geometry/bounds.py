"""Boxes and balls around shapes, in NumPy, for what is built once."""

from __future__ import annotations

import math

import numpy as np

from crazysim.geometry.shapes import Shape

UNBOUNDED_LENGTH = 1e18
"""Half length that stands for an unbounded one, m; its square fits into float32."""


def bounding_box(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Return centre and half lengths of the box around a shape, along the axes of its frame, m. (3,) each"""
    size = shape.size
    match shape.kind:
        case "mesh" | "hfield":
            if shape.kind == "mesh":
                low, high = shape.array("vertices").min(axis=0), shape.array("vertices").max(axis=0)
            else:
                x, y, _, base = size
                low, high = np.array([-x, -y, -base]), np.array([x, y, max(0.0, float(shape.array("heights").max()))])
            return (low + high) / 2, (high - low) / 2
        case "plane":
            half = [UNBOUNDED_LENGTH] * 3
        case "sphere":
            half = [size[0]] * 3
        case "capsule":
            half = [size[0], size[0], size[0] + size[1]]
        case "cylinder":
            half = [size[0], size[0], size[1]]
        case _:
            half = list(size)
    return np.zeros(3), np.array(half)


def bounding_radius(shape: Shape) -> float:
    """Return the radius of a ball around a shape, centred at its bounding box, m."""
    match shape.kind:
        case "plane":
            return UNBOUNDED_LENGTH
        case "sphere" | "ellipsoid":
            return max(shape.size)
        case "capsule":
            return sum(shape.size)
        case "cylinder":
            return math.hypot(*shape.size)
    return float(np.linalg.norm(bounding_box(shape)[1]))
