"""Trajectories: a record of piecewise polynomials, its constructors, checks and files."""

from crazysim.trajectories import formation
from crazysim.trajectories.approaches import Approach
from crazysim.trajectories.files import (
    Cue,
    Lights,
    Show,
    load_csv,
    load_show,
    pack_compressed,
    save_csv,
    save_samples,
    save_show,
)
from crazysim.trajectories.limits import Limits, Report, Violation, check
from crazysim.trajectories.shapes import circle, figure_eight, helix, hover, line, lissajous
from crazysim.trajectories.smoothest import smoothest
from crazysim.trajectories.splines import of_bezier, spline
from crazysim.trajectories.trajectory import Trajectory
from crazysim.trajectories.waypoints import minimum_jerk, minimum_snap

__all__ = [
    "Approach",
    "Cue",
    "Lights",
    "Limits",
    "Report",
    "Show",
    "Trajectory",
    "Violation",
    "check",
    "circle",
    "figure_eight",
    "formation",
    "helix",
    "hover",
    "line",
    "lissajous",
    "load_csv",
    "load_show",
    "minimum_jerk",
    "minimum_snap",
    "of_bezier",
    "pack_compressed",
    "save_csv",
    "save_samples",
    "save_show",
    "smoothest",
    "spline",
]
