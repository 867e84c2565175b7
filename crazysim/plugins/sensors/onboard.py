"""Onboard measurements of quantities that are simulated elsewhere: rotor speeds, battery voltage, ranges."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Simulation, param
from crazysim.core.settings import setting
from crazysim.errors import ConfigError, require
from crazysim.plugins.effects.battery import Battery
from crazysim.plugins.effects.moving_air import require_rotors
from crazysim.plugins.sensors.errors import Link, Rounded, White
from crazysim.plugins.sensors.range_finder import RangeFinder
from crazysim.plugins.sensors.sensor import Sensor

ELECTRICAL_SPEED_STEP = 100.0
"""Step of the electrical speed in telemetry, rpm, as in flight logs of IDSIA's Crazyflies (2025)."""


class NoisySensor(Sensor):
    """Base class of sensors that measure the true value plus white noise, rounded."""

    noise: Param = param(default=0.0, low=0.0, sparse=True)
    """Standard deviation of a measurement, in its unit. (1,)"""
    resolution: Param = param(default=None, positive=True)
    """Step to which measurements are rounded, in their unit; None for no rounding. (1,)"""
    _: dataclasses.KW_ONLY
    name: str = "noisy"

    @property
    def chains(self) -> Mapping[str, Sequence[Link]]:
        """White noise and rounding of every channel."""
        return {name: [White("noise"), Rounded("resolution")] for name in self.channels}


class RotorSpeeds(NoisySensor):
    """Rotor speeds as reported by the motors' telemetry, rpm; needs rotors.

    Telemetry counts electrical revolutions in steps of 100 rpm: with six pole pairs, ``resolution=100 / 6``.
    """

    n_rotors: int = setting(default=4, low=1)
    """Number of rotors."""
    _: dataclasses.KW_ONLY
    name: str = "rotor_speeds"
    measures_motion: ClassVar[bool] = False

    @classmethod
    def telemetry(cls, pole_pairs: int, **settings: Any) -> RotorSpeeds:
        """Return a sensor with the resolution of telemetry for motors with a number of pole pairs."""
        if not pole_pairs > 0:
            raise ConfigError(f"expected pole_pairs to be positive, got {pole_pairs}")
        return cls(resolution=ELECTRICAL_SPEED_STEP / pole_pairs, **settings)

    @property
    def channels(self) -> Mapping[str, int]:
        """Names and lengths of the parts of a measurement."""
        return {"speed": self.n_rotors}

    def bind(self, sim: Simulation) -> RotorSpeeds:
        require_rotors(sim, "measuring rotor speeds")
        n_rotors = sim.data.states.rotor_vel.shape[-1]
        if self.n_rotors != n_rotors:
            raise ConfigError(f"expected n_rotors = {n_rotors} as the drones have, got {self.n_rotors}")
        return self.with_arrays(sim)

    def ideal(self, data: SimData) -> Array:
        return data.states.rotor_vel

    def measured_states(self, data: SimData) -> dict[str, Array]:
        return {"rotor_vel": self.latest(data)}


class BatteryVoltage(NoisySensor):
    """Voltage of the battery, V; needs the plugin ``Battery``, added before."""

    battery: str = "battery"
    """Name of the plugin of the battery."""
    _: dataclasses.KW_ONLY
    freq: int | None = 100
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    name: str = "battery_voltage"
    measures_motion: ClassVar[bool] = False

    channels: ClassVar = {"voltage": 1}

    @property
    def companions(self) -> Mapping[str, type]:
        return {self.battery: Battery}

    def ideal(self, data: SimData) -> Array:
        return data.plugins[self.battery].voltage


class MultiRanger(NoisySensor):
    """Distances of a ``RangeFinder`` with a rate, a delay and noise, m. The range finder must be added before.

    A distance beyond the range is the range finder's ``max_range``, without noise.
    """

    n_rays: int = setting(default=6, low=1)
    """Number of rays of the range finder."""
    range_finder: str = "range_finder"
    """Name of the plugin of the range finder."""
    _: dataclasses.KW_ONLY
    freq: int | None = 10
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    name: str = "multi_ranger"
    measures_motion: ClassVar[bool] = False

    @property
    def channels(self) -> Mapping[str, int]:
        """Names and lengths of the parts of a measurement."""
        return {"distance": self.n_rays}

    @property
    def companions(self) -> Mapping[str, type]:
        return {self.range_finder: RangeFinder}

    def bind(self, sim: Simulation) -> MultiRanger:
        n_rays = sim.data.plugins[self.range_finder].direction.shape[0]  # type: ignore[attr-defined]
        require(n_rays == self.n_rays, f"expected n_rays = {n_rays} as the range finder has, got {self.n_rays}")
        return self.with_arrays(sim)

    def ideal(self, data: SimData) -> Array:
        return data.plugins[self.range_finder].distance

    def measure(self, data: SimData, key: Array) -> tuple[Array, MultiRanger]:
        value, sensor = super().measure(data, key)
        max_range = data.plugins[self.range_finder].max_range
        return jnp.where(self.ideal(data) < max_range, rotation.clip(value, 0.0, max_range), max_range), sensor
