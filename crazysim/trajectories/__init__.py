"""Trajectories: records of piecewise polynomials, and their constructors."""

from crazysim.trajectories.splines import of_bezier, spline
from crazysim.trajectories.trajectory import Trajectory

__all__ = ["Trajectory", "of_bezier", "spline"]
