"""Measurements of one drone for a firmware, in the axes of crazysim and of aviation."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from crazysim.core.settings import check_settings, setting
from crazysim.errors import ConfigError, short_repr
from crazysim.plugins.sensors.barometer import LAPSE_RATE, PRESSURE_EXPONENT, SEA_LEVEL_PRESSURE, SEA_LEVEL_TEMPERATURE
from crazysim.plugins.sensors.sensor import Sensor

METRES_PER_DEGREE = 6371000.0 * np.pi / 180
"""Length of a degree of latitude on a sphere with the mean radius of the earth (IUGG), m."""
MAX_LATITUDE = 89.0
"""Largest latitude, degrees; longitude is undefined on the tangent plane at a pole."""
MIN_ALTITUDE, MAX_ALTITUDE = -1000.0, 11000.0
"""Limits of the origin's altitude, m: the lowest layer of the standard atmosphere, up to the tropopause."""
COS_45_DEGREES = np.sqrt(0.5)
"""Cosine and sine of 45 degrees, which is half of a quarter turn."""


class Measurements(NamedTuple):
    """Measurements of one drone, and its true state.

    World axes are x east, y north and z up (ENU), body axes x forward, y left and z up (FLU).
    """

    time: float
    """Time since the start, s."""
    gyro: NDArray
    """Angular velocity, body frame, rad/s. (3,)"""
    accel: NDArray
    """Specific force, body frame, m/s^2: (0, 0, 9.81) at rest. (3,)"""
    pos: NDArray
    """True position, world frame, m. (3,)"""
    quat: NDArray
    """True attitude, body to world, unit, xyzw. (4,)"""
    vel: NDArray
    """True velocity, world frame, m/s. (3,)"""
    ang_vel: NDArray
    """True angular velocity, body frame, rad/s. (3,)"""
    gps_pos: NDArray
    """Position by satellite navigation, world frame, m. (3,)"""
    gps_vel: NDArray
    """Velocity by satellite navigation, world frame, m/s. (3,)"""
    height: float
    """Height by barometer, m."""
    field: NDArray
    """Magnetic field, body frame, T. (3,)"""
    new: frozenset[type[Sensor]]
    """Sensors with a new measurement: ``IMU``, ``Barometer``, ``Magnetometer`` and ``GPS``; at first all of them."""


@dataclasses.dataclass(frozen=True)
class Origin:
    """Position of the world's origin on the earth."""

    latitude: float = setting(low=-MAX_LATITUDE, high=MAX_LATITUDE)
    """Latitude, degrees."""
    longitude: float = setting(low=-180.0, high=180.0)
    """Longitude, degrees."""
    altitude: float = setting(low=MIN_ALTITUDE, high=MAX_ALTITUDE)
    """Altitude above sea level, m."""

    def __post_init__(self) -> None:
        check_settings(self)

    def geodetic_position(self, pos: NDArray) -> tuple[float, float, float]:
        """Return latitude and longitude, degrees, and altitude, m, on the plane tangent to the earth at the origin.

        Args:
            pos: Position, world frame, m. (3,)
        """
        east, north, up = map(float, pos)
        return (
            self.latitude + north / METRES_PER_DEGREE,
            self.longitude + east / (METRES_PER_DEGREE * math.cos(math.radians(self.latitude))),
            self.altitude + up,
        )

    def pressure(self, height: float) -> float:
        """Return the pressure of the standard atmosphere at a height above the origin, m, in Pa."""
        base = 1 - LAPSE_RATE / SEA_LEVEL_TEMPERATURE * (self.altitude + height)
        return SEA_LEVEL_PRESSURE * base**PRESSURE_EXPONENT


def check_origin(origin: object) -> Origin:
    if not isinstance(origin, Origin):
        raise ConfigError(f"expected an Origin, got {short_repr(origin)}. Use Origin(latitude, longitude, altitude).")
    return origin


ZURICH = Origin(47.397742, 8.545594, 488.0)
"""Default origin, at which simulations of PX4 start."""


def to_frd(vector: NDArray) -> NDArray:
    """Convert a vector from the body axes forward, left, up to forward, right, down. (3,)"""
    return vector * np.array([1.0, -1.0, -1.0])


def to_ned(vector: NDArray) -> NDArray:
    """Convert a vector from the world axes east, north, up to north, east, down. (3,)"""
    return np.array([vector[1], vector[0], -vector[2]])


def to_ned_quat(quat: NDArray) -> NDArray:
    """Return the attitude of the body (forward, right, down) in the world (north, east, down), wxyz. (4,)

    The quaternion of ENU to NED, ``(x + y) / sqrt(2)``, times the attitude, times the quaternion of FRD to FLU, ``x``.

    Args:
        quat: Attitude of the body (forward, left, up) in the world (east, north, up), xyzw. (4,)
    """
    x, y, z, w = quat
    return COS_45_DEGREES * np.array([w + z, x + y, x - y, w - z])
