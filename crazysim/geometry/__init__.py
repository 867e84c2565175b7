"""Signed distances and rays of simple shapes, as differentiable functions of their poses."""

from crazysim.geometry.distance import distance, point_distance
from crazysim.geometry.rays import ray_distance
from crazysim.geometry.shapes import Shape, hfield, hull

__all__ = ["Shape", "distance", "hfield", "hull", "point_distance", "ray_distance"]
