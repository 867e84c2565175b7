"""Depth images of one camera, under Crazyflow's import path."""

from crazysim.sim.crazyflow import render_depth

__all__ = ["render_depth"]
