"""Barometer: pressure of the standard atmosphere with noise and drift, and the height that follows from it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import SimData
from crazysim.core.plugin import parameter
from crazysim.core.random import normal
from crazysim.plugins.sensors.sensor import Samples, Sensor, gauss_markov_step, quantise
from crazysim.pytree import PyTree, leaf

SEA_LEVEL_PRESSURE, SEA_LEVEL_TEMPERATURE, LAPSE_RATE = 101325.0, 288.15, 0.0065
"""Pressure at sea level, Pa; temperature at sea level, K; decrease of temperature with height, K/m (ISO 2533:1975)."""
PRESSURE_EXPONENT = 9.80665 * 0.0289644 / (8.31432 * LAPSE_RATE)
"""Exponent of the pressure, 5.256: g M / (R L) with the constants of the US Standard Atmosphere 1976."""


class BarometerData(PyTree):
    """State and parameters of the barometer of every drone."""

    samples: Samples
    """Measurements."""
    drift_error: Array = leaf("drone", 1, (1,))
    """Drift error, Pa. (n_worlds, n_drones, 1)"""
    offset: Array = leaf("drone", 1, (1,))
    """Constant error in this episode, Pa. (n_worlds, n_drones, 1)"""
    noise: Array = leaf("parameter", 1, (1,), sparse=True)
    """Standard deviation of a measurement, Pa. (1,)"""
    drift: Array = leaf("parameter", 1, (1,), sparse=True)
    """Standard deviation of the drift error, Pa. (1,)"""
    drift_time: Array = leaf("parameter", 1, (1,))
    """Correlation time of the drift error, s. (1,)"""
    offset_spread: Array = leaf("parameter", 1, (1,), sparse=True)
    """Standard deviation of the offset between episodes, Pa. (1,)"""
    altitude: Array = leaf("parameter", 1, (1,), sparse=True)
    """Altitude of the origin above sea level, m. (1,)"""
    resolution: Array | None = leaf("parameter", 1, (1,))
    """Step to which measurements are rounded, Pa; None for no rounding. (1,)"""


class Barometer(Sensor):
    """Pressure, Pa, and the height above the world's origin, m, that follows from it in the standard atmosphere."""

    kind: ClassVar[type[PyTree]] = BarometerData
    noise: ArrayLike = parameter(default=0.0, low=0.0)
    """Standard deviation of a measurement, Pa; 12 Pa correspond to one metre. () or (n_worlds, n_drones)"""
    drift: ArrayLike = parameter(default=0.0, low=0.0)
    """Standard deviation of the drift error, as from weather and temperature, Pa. () or (n_worlds, n_drones)"""
    drift_time: ArrayLike = parameter(default=60.0, positive=True)
    """Correlation time of the drift error, s. () or (n_worlds, n_drones)"""
    offset_spread: ArrayLike = parameter(default=0.0, low=0.0)
    """Standard deviation of an error that is constant in an episode, Pa. () or (n_worlds, n_drones)"""
    altitude: ArrayLike = parameter(default=0.0, low=-500.0, high=9000.0)
    """Altitude of the origin above sea level, m. () or (n_worlds, n_drones)"""
    resolution: ArrayLike | None = parameter(default=None, positive=True)
    """Step to which measurements are rounded, Pa; None for no rounding. () or (n_worlds, n_drones)"""
    _: dataclasses.KW_ONLY
    freq: int | None = 50
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    name: str = "barometer"

    @property
    def channels(self) -> Mapping[str, int]:
        return {"pressure": 1, "height": 1}

    def ideal(self, data: SimData) -> Array:
        """Return the pressure, Pa, and the height, m. (2,)"""
        height = data.states.pos[2:]
        return jnp.concatenate([pressure_at(height + self.read(data).altitude), height])

    def reset_episode(self, data: SimData) -> SimData:
        record = self.read(data)
        noise = normal(self.episode_key(data), (2,), record.offset.dtype)
        new_record = record.replace(offset=record.offset_spread * noise[:1], drift_error=record.drift * noise[1:])
        return self.write(data, new_record)

    def measure(self, data: SimData, record: BarometerData, key: Array) -> tuple[Array, BarometerData]:
        noise = normal(key, (2,), record.offset.dtype)
        drift_error = gauss_markov_step(
            record.drift_error, record.drift, record.drift_time, self.interval(data), noise[:1]
        )
        pressure = self.ideal(data)[:1] + record.offset + drift_error + record.noise * noise[1:]
        pressure = quantise(pressure, record.resolution)
        height = pressure_altitude(pressure) - record.altitude
        return jnp.concatenate([pressure, height]), record.replace(drift_error=drift_error)


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
