"""Pure physics for one drone, with any leading axes."""

from crazysim.dynamics import first_principles, fitted
from crazysim.dynamics.core import Dynamics, supported_drones, supported_dynamics
from crazysim.dynamics.first_principles import hover_rotor_vel

__all__ = ["Dynamics", "first_principles", "fitted", "hover_rotor_vel", "supported_drones", "supported_dynamics"]
