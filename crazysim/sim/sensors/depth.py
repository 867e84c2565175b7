"""Depth images of one camera, where Crazyflow has them."""

from crazysim.sim.crazyflow import render_depth

__all__ = ["render_depth"]
