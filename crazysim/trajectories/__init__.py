"""Trajectories: records of piecewise polynomials, and their constructors."""

from crazysim.trajectories.approaches import Approach
from crazysim.trajectories.limits import Limits, Report, Violation, check
from crazysim.trajectories.splines import of_bezier, spline
from crazysim.trajectories.trajectory import Trajectory
from crazysim.trajectories.waypoints import minimum_jerk, minimum_snap

__all__ = [
    "Approach",
    "Limits",
    "Report",
    "Trajectory",
    "Violation",
    "check",
    "minimum_jerk",
    "minimum_snap",
    "of_bezier",
    "spline",
]
