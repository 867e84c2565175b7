"""Derivatives of all drones by model, under Crazyflow's import path."""

from crazysim.core.stages import first_principles_derivative as first_principles_dynamics
from crazysim.core.stages import fitted_derivative as so_rpy_dynamics
from crazysim.core.stages import fitted_derivative as so_rpy_rotor_drag_dynamics
from crazysim.core.stages import fitted_derivative as so_rpy_rotor_dynamics

__all__ = ["first_principles_dynamics", "so_rpy_dynamics", "so_rpy_rotor_drag_dynamics", "so_rpy_rotor_dynamics"]
