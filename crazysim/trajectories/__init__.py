"""Trajectories: records of piecewise polynomials, and their constructors."""

from crazysim.trajectories.trajectory import Trajectory

__all__ = ["Trajectory"]
