"""A drone simulator in which millions of worlds advance in one call."""

from typing import TYPE_CHECKING

import crazysim.startup  # noqa: F401 - before JAX and MuJoCo

# isort: split
from crazysim.control import Control, Controller
from crazysim.core.data import SimData
from crazysim.core.integration import Integrator
from crazysim.core.plugin import Param, Plugin, StagePlacement, param, state
from crazysim.core.population import Population
from crazysim.drones import Airframe, Drone, load_airframe
from crazysim.dynamics import Dynamics
from crazysim.engine.cache import enable_cache
from crazysim.engine.jaxcompat import set_xla_log_level
from crazysim.engine.pair_reductions import reduce_over_others
from crazysim.engine.pytree import Members, PyTree, leaf, static
from crazysim.engine.stage import stage
from crazysim.errors import ConfigError
from crazysim.names import lazy_getattr
from crazysim.sim.sim import Sim
from crazysim.startup import __version__

if TYPE_CHECKING:
    from crazysim.core import functional as functional
    from crazysim.envs import make
    from crazysim.lab.bodies.drone_collisions import DroneCollisions
    from crazysim.lab.bodies.free_bodies import FreeBodies
    from crazysim.lab.control.mppi import MPPI
    from crazysim.lab.estimators.eskf import ESKF
    from crazysim.lab.plugins.radar import Radar
    from crazysim.lab.plugins.random_airframe import RandomAirframe
    from crazysim.lab.plugins.residual import Residual
    from crazysim.lab.plugins.rotor_jet import RotorJet
    from crazysim.lab.plugins.shared_load import SharedLoad
    from crazysim.lab.scene.splats import SplatScene
    from crazysim.lab.vehicles.cars import Bicycles, Cars
    from crazysim.plugins.contacts.contact_log import ContactLog
    from crazysim.plugins.contacts.response import ContactResponse
    from crazysim.plugins.contacts.terrain import Terrain
    from crazysim.plugins.effects import (
        Battery,
        Downwash,
        GroundEffect,
        Latency,
        MotorFailure,
        Randomize,
        RotorAerodynamics,
        Wind,
        WindField,
    )
    from crazysim.plugins.estimators.kalman import Kalman
    from crazysim.plugins.follow import Follow
    from crazysim.plugins.payloads import Hook, SlungLoad
    from crazysim.plugins.scenery import Clutter, Forest, Gates, Maps, Pillars, Rooms
    from crazysim.plugins.sensors import IMU, Camera, Lidar, MotionCapture, RangeFinder, Sensor

__all__ = [
    "ESKF",
    "IMU",
    "MPPI",
    "Airframe",
    "Battery",
    "Bicycles",
    "Camera",
    "Cars",
    "Clutter",
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
    "Forest",
    "FreeBodies",
    "Gates",
    "GroundEffect",
    "Hook",
    "Integrator",
    "Kalman",
    "Latency",
    "Lidar",
    "Maps",
    "Members",
    "MotionCapture",
    "MotorFailure",
    "Param",
    "Pillars",
    "Plugin",
    "Population",
    "PyTree",
    "Radar",
    "RandomAirframe",
    "Randomize",
    "RangeFinder",
    "Residual",
    "Rooms",
    "RotorAerodynamics",
    "RotorJet",
    "Sensor",
    "SharedLoad",
    "Sim",
    "SimData",
    "SlungLoad",
    "SplatScene",
    "StagePlacement",
    "Terrain",
    "Wind",
    "WindField",
    "__version__",
    "enable_cache",
    "leaf",
    "load_airframe",
    "make",
    "param",
    "reduce_over_others",
    "stage",
    "state",
    "static",
]

set_xla_log_level()

__getattr__ = lazy_getattr(__name__)
