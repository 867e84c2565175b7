"""Gaussian splats, under Crazyflow's import path."""

from crazysim.sim.crazyflow_splats import attach_splats

__all__ = ["attach_splats"]
