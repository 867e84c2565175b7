"""A drone simulator in which thousands of worlds advance in one call."""

from typing import TYPE_CHECKING

from crazysim.control import Control, Controller
from crazysim.core.data import SimData
from crazysim.core.integration import Integrator
from crazysim.core.others import reduce_over_others
from crazysim.core.plugin import Placement, Plugin, parameter
from crazysim.core.population import Population
from crazysim.core.stage import stage
from crazysim.drones import Airframe, Drone, load_airframe
from crazysim.dynamics import Dynamics
from crazysim.effects import Battery, Downwash, GroundEffect, Latency, MotorFailure, Wind, WindField
from crazysim.errors import ConfigError
from crazysim.lazy import lazy
from crazysim.pytree import Members, PyTree, leaf, static
from crazysim.sim.sim import Sim
from crazysim.version import __version__

if TYPE_CHECKING:
    from crazysim.bodies import DroneCollisions, FreeBodies
    from crazysim.core import functional as functional
    from crazysim.envs import make
    from crazysim.payloads import Hook, RotorJet, SharedLoad, SlungLoad
    from crazysim.scene.contact_log import ContactLog
    from crazysim.scene.radar import Radar
    from crazysim.scene.range_finder import RangeFinder
    from crazysim.scene.response import ContactResponse
    from crazysim.scene.terrain import Terrain
    from crazysim.sim.mppi import MPPI
    from crazysim.trajectories import Follow
    from crazysim.vehicles import Bicycles, Cars

__all__ = [
    "MPPI",
    "Airframe",
    "Battery",
    "Bicycles",
    "Cars",
    "ConfigError",
    "ContactLog",
    "ContactResponse",
    "Control",
    "Controller",
    "Downwash",
    "Drone",
    "DroneCollisions",
    "Dynamics",
    "Follow",
    "FreeBodies",
    "GroundEffect",
    "Hook",
    "Integrator",
    "Latency",
    "Members",
    "MotorFailure",
    "Placement",
    "Plugin",
    "Population",
    "PyTree",
    "Radar",
    "RangeFinder",
    "RotorJet",
    "SharedLoad",
    "Sim",
    "SimData",
    "SlungLoad",
    "Terrain",
    "Wind",
    "WindField",
    "__version__",
    "leaf",
    "load_airframe",
    "make",
    "parameter",
    "reduce_over_others",
    "stage",
    "static",
]

__getattr__ = lazy(
    __name__,
    {
        "Bicycles": "crazysim.vehicles",
        "Cars": "crazysim.vehicles",
        "ContactLog": "crazysim.scene.contact_log",
        "ContactResponse": "crazysim.scene.response",
        "DroneCollisions": "crazysim.bodies",
        "Follow": "crazysim.trajectories",
        "FreeBodies": "crazysim.bodies",
        "Hook": "crazysim.payloads",
        "MPPI": "crazysim.sim.mppi",
        "RotorJet": "crazysim.payloads",
        "SharedLoad": "crazysim.payloads",
        "SlungLoad": "crazysim.payloads",
        "Radar": "crazysim.scene.radar",
        "RangeFinder": "crazysim.scene.range_finder",
        "Terrain": "crazysim.scene.terrain",
        "functional": "crazysim.core",
        "make": "crazysim.envs",
    },
)


def __dir__() -> list[str]:
    """Return the public names, those not yet imported included."""
    return __all__
