"""Dynamics models: pure functions, written for one drone, which accept arrays with any leading axes."""

from crazysim.dynamics import first_principles, fitted
from crazysim.dynamics.first_principles import hover_rotor_vel
from crazysim.dynamics.models import Dynamics, supported_drones, supported_dynamics
from crazysim.dynamics.parameters import load_fn_params, load_params

__all__ = [
    "Dynamics",
    "first_principles",
    "fitted",
    "hover_rotor_vel",
    "load_fn_params",
    "load_params",
    "supported_drones",
    "supported_dynamics",
]
