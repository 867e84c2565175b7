"""Trajectories: a record of piecewise polynomials, its constructors, and the plugin that follows them in the step."""

from crazysim.trajectories.follow import Follow, FollowData
from crazysim.trajectories.shapes import circle, figure_eight, helix, hover, line, lissajous
from crazysim.trajectories.trajectory import Trajectory

__all__ = [
    "Follow",
    "FollowData",
    "Trajectory",
    "circle",
    "figure_eight",
    "helix",
    "hover",
    "line",
    "lissajous",
]
