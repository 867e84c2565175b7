"""Effects: optional physics, each a plugin that ``sim.add`` adds."""

from crazysim.effects.battery import Battery
from crazysim.effects.downwash import Downwash
from crazysim.effects.grid import Grid, load_wind_grid
from crazysim.effects.ground import ground_at, ground_height
from crazysim.effects.ground_effect import GroundEffect
from crazysim.effects.latency import Latency
from crazysim.effects.motors import MotorFailure
from crazysim.effects.wind import Wind
from crazysim.effects.wind_field import WindField

__all__ = [
    "Battery",
    "Downwash",
    "Grid",
    "GroundEffect",
    "Latency",
    "MotorFailure",
    "Wind",
    "WindField",
    "ground_at",
    "ground_height",
    "load_wind_grid",
]
