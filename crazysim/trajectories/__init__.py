"""Trajectories: a record of piecewise polynomials, its constructors, checks and files."""

from typing import TYPE_CHECKING

from crazysim.names import lazy_getattr
from crazysim.trajectories import formation
from crazysim.trajectories.curves import circle, figure_eight, helix, hover, line, lissajous
from crazysim.trajectories.splines import of_bezier, spline
from crazysim.trajectories.trajectory import Trajectory

if TYPE_CHECKING:
    from crazysim.lab.planning.approaches import Approach
    from crazysim.lab.planning.limits import Limits, Report, Violation, check
    from crazysim.lab.planning.waypoints import minimum_jerk, minimum_snap, smoothest
    from crazysim.lab.racing.time_optimal import Plan, fly_open_loop, plan_race
    from crazysim.lab.trajectory_files.csv import load_csv, save_csv, save_samples
    from crazysim.lab.trajectory_files.polynomials import pack_compressed

__all__ = [
    "Approach",
    "Limits",
    "Plan",
    "Report",
    "Trajectory",
    "Violation",
    "check",
    "circle",
    "figure_eight",
    "fly_open_loop",
    "formation",
    "helix",
    "hover",
    "line",
    "lissajous",
    "load_csv",
    "minimum_jerk",
    "minimum_snap",
    "of_bezier",
    "pack_compressed",
    "plan_race",
    "save_csv",
    "save_samples",
    "smoothest",
    "spline",
]

__getattr__ = lazy_getattr(__name__)
