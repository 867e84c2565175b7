"""Barometer: pressure of the standard atmosphere with noise and drift, and the height that follows from it."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.plugin import Param, param, state
from crazysim.plugins.sensors.errors import Constant, GaussMarkov, Rounded, White
from crazysim.plugins.sensors.sensor import Sensor

SEA_LEVEL_PRESSURE, SEA_LEVEL_TEMPERATURE, LAPSE_RATE = 101325.0, 288.15, 0.0065
"""Pressure at sea level, Pa; temperature at sea level, K; decrease of temperature with height, K/m (ISO 2533:1975)."""
PRESSURE_EXPONENT = 9.80665 * 0.0289644 / (8.31432 * LAPSE_RATE)
"""Exponent of the pressure, 5.256: g M / (R L) with the constants of the US Standard Atmosphere 1976."""


class Barometer(Sensor):
    """Pressure, Pa, and the height above the world's origin, m, that follows from it in the standard atmosphere."""

    noise: Param = param(default=0.0, low=0.0, sparse=True)
    """Standard deviation of a measurement, Pa; 12 Pa correspond to one metre. (1,)"""
    drift: Param = param(default=0.0, low=0.0, sparse=True)
    """Standard deviation of the drift error, as from weather and temperature, Pa. (1,)"""
    drift_time: Param = param(default=60.0, positive=True)
    """Correlation time of the drift error, s. (1,)"""
    offset_spread: Param = param(default=0.0, low=0.0, sparse=True)
    """Standard deviation of an error that is constant in an episode, Pa. (1,)"""
    altitude: Param = param(default=0.0, low=-500.0, high=9000.0, sparse=True)
    """Altitude of the origin above sea level, m. (1,)"""
    resolution: Param = param(default=None, positive=True)
    """Step to which measurements are rounded, Pa; None for no rounding. (1,)"""
    _: dataclasses.KW_ONLY
    drift_error: Array = state()
    """Drift error, Pa. (n_worlds, n_drones, 1)"""
    offset: Array = state()
    """Constant error in this episode, Pa. (n_worlds, n_drones, 1)"""
    freq: int | None = 50
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    name: str = "barometer"

    channels: ClassVar = {"pressure": 1, "height": 1}
    chains: ClassVar = {
        "pressure": [
            Constant("offset_spread", "offset"),
            GaussMarkov("drift", "drift_error", "drift_time"),
            White("noise"),
            Rounded("resolution"),
        ]
    }

    def ideal(self, data: SimData) -> Array:
        height = data.states.pos[2:]
        return jnp.concatenate([pressure_at(height + self.altitude), height])

    def measure(self, data: SimData, key: Array) -> tuple[Array, Barometer]:
        value, sensor = super().measure(data, key)
        return jnp.concatenate([value[:1], pressure_altitude(value[:1]) - self.altitude]), sensor


def pressure_at(altitude: Array) -> Array:
    """Return the pressure of the standard atmosphere below 11 km, ``p_0 (1 - L h / T_0)^(g M / (R L))``, Pa. (...)

    Args:
        altitude: Geopotential altitude above sea level, m. (...)
    """
    return SEA_LEVEL_PRESSURE * jnp.exp(PRESSURE_EXPONENT * jnp.log1p(-LAPSE_RATE / SEA_LEVEL_TEMPERATURE * altitude))


def pressure_altitude(pressure: Array) -> Array:
    """Return the altitude at which the standard atmosphere has a pressure, m; the inverse of ``pressure_at``. (...)"""
    log_ratio = jnp.log1p((pressure - SEA_LEVEL_PRESSURE) / SEA_LEVEL_PRESSURE)
    return -SEA_LEVEL_TEMPERATURE / LAPSE_RATE * jnp.expm1(log_ratio / PRESSURE_EXPONENT)
