"""Dynamics models: pure functions for one drone, with any leading axes."""

from crazysim.dynamics import first_principles, fitted
from crazysim.dynamics.core import Dynamics, supported_drones, supported_dynamics

__all__ = ["Dynamics", "first_principles", "fitted", "supported_drones", "supported_dynamics"]
