"""Trajectories: a record of piecewise polynomials, its constructors, and the plugin that follows them in the step."""

from crazysim.trajectories.files import Lights, Show, load_csv, load_show, save_csv, save_show
from crazysim.trajectories.follow import Follow, FollowData
from crazysim.trajectories.shapes import circle, figure_eight, helix, hover, line, lissajous
from crazysim.trajectories.trajectory import Trajectory

__all__ = [
    "Follow",
    "FollowData",
    "Lights",
    "Show",
    "Trajectory",
    "circle",
    "figure_eight",
    "helix",
    "hover",
    "line",
    "lissajous",
    "load_csv",
    "load_show",
    "save_csv",
    "save_show",
]
