"""Effects: optional physics, each a plugin that ``sim.add`` adds."""

from typing import TYPE_CHECKING

from crazysim.names import lazy_getattr
from crazysim.plugins.effects.battery import Battery
from crazysim.plugins.effects.downwash import Downwash
from crazysim.plugins.effects.grid import Grid, load_wind_grid
from crazysim.plugins.effects.ground import ground_at, ground_height
from crazysim.plugins.effects.ground_effect import GroundEffect
from crazysim.plugins.effects.latency import Latency
from crazysim.plugins.effects.motor_failure import MotorFailure
from crazysim.plugins.effects.randomize import Randomize
from crazysim.plugins.effects.rotor_aerodynamics import RotorAerodynamics
from crazysim.plugins.effects.wind import Wind
from crazysim.plugins.effects.wind_field import WindField

if TYPE_CHECKING:
    from crazysim.lab.plugins.random_airframe import RandomAirframe
    from crazysim.lab.plugins.residual import Residual

__all__ = [
    "Battery",
    "Downwash",
    "Grid",
    "GroundEffect",
    "Latency",
    "MotorFailure",
    "RandomAirframe",
    "Randomize",
    "Residual",
    "RotorAerodynamics",
    "Wind",
    "WindField",
    "ground_at",
    "ground_height",
    "load_wind_grid",
]

__getattr__ = lazy_getattr(__name__)
