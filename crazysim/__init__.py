"""A drone simulator in which thousands of worlds advance in one call."""

from crazysim.control import Control
from crazysim.core.integration import Integrator
from crazysim.drones import Airframe, Drone, load_airframe
from crazysim.dynamics import Dynamics
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree, leaf, static
from crazysim.sim.sim import Sim
from crazysim.version import __version__

__all__ = [
    "Airframe",
    "ConfigError",
    "Control",
    "Drone",
    "Dynamics",
    "Integrator",
    "PyTree",
    "Sim",
    "__version__",
    "leaf",
    "load_airframe",
    "static",
]
