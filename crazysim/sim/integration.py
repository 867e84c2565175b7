"""Integrators, under Crazyflow's import path."""

from crazysim.core.integration import Integrator, euler, rk4, symplectic_euler

__all__ = ["Integrator", "euler", "rk4", "symplectic_euler"]
