"""The simulation: its data, its pipeline of stages, and the shell that holds them."""

from crazysim.control import Control
from crazysim.core.integration import Integrator
from crazysim.drones import Drone
from crazysim.dynamics import Dynamics
from crazysim.sim.sim import Sim

__all__ = ["Control", "Drone", "Dynamics", "Integrator", "Sim"]
