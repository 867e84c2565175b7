"""Gaussian splats, where Crazyflow has them."""

from crazysim.sim.crazyflow_splats import attach_splats

__all__ = ["attach_splats"]
