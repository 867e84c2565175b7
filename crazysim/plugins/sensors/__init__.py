"""Sensors: measurements with rate, delay, noise and mounting, each a plugin that ``sim.add`` adds."""

from typing import TYPE_CHECKING

from crazysim.lazy import lazy

if TYPE_CHECKING:
    from crazysim.plugins.sensors.imu import IMU
    from crazysim.plugins.sensors.radar import Radar
    from crazysim.plugins.sensors.range_finder import RangeFinder
    from crazysim.plugins.sensors.sensor import Samples, Sensor
    from crazysim.plugins.sensors.triad import Triad

__all__ = ["IMU", "Radar", "RangeFinder", "Samples", "Sensor", "Triad"]

__getattr__ = lazy(
    __name__,
    {
        "IMU": f"{__name__}.imu",
        "Radar": f"{__name__}.radar",
        "RangeFinder": f"{__name__}.range_finder",
        "Samples": f"{__name__}.sensor",
        "Sensor": f"{__name__}.sensor",
        "Triad": f"{__name__}.triad",
    },
)
