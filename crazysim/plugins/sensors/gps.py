"""Satellite navigation: position with drifting errors, and velocity."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import parameter
from crazysim.core.random import normal
from crazysim.plugins.sensors.sensor import Samples, Sensor, gauss_markov_step
from crazysim.pytree import PyTree, leaf


class GPSData(PyTree):
    """State and parameters of the receiver of every drone."""

    samples: Samples
    """Measurements."""
    drift_error: Array = leaf("drone", 1, (3,))
    """Drift error of the position, world frame, m. (n_worlds, n_drones, 3)"""
    noise: Array = leaf("parameter", 1, (3,), sparse=True)
    """Standard deviation of a position, m. (3,)"""
    drift: Array = leaf("parameter", 1, (3,), sparse=True)
    """Standard deviation of the drift error, m. (3,)"""
    drift_time: Array = leaf("parameter", 1, (1,))
    """Correlation time of the drift error, s. (1,)"""
    vel_noise: Array = leaf("parameter", 1, (3,), sparse=True)
    """Standard deviation of a velocity, m/s. (3,)"""
    pos: Array = leaf("parameter", 1, (3,), sparse=True)
    """Position of the antenna relative to the centre of mass, body frame, m. (3,)"""


class GPS(Sensor):
    """Position, m, and velocity, m/s, of the antenna, world frame."""

    kind: ClassVar[type[PyTree]] = GPSData
    noise: ArrayLike = parameter(default=0.0, low=0.0, per_axis=True)
    """Standard deviation of a position, world frame, m. (), (3,) or (n_worlds, n_drones, 3)"""
    drift: ArrayLike = parameter(default=0.0, low=0.0, per_axis=True)
    """Standard deviation of the drift error of the position, world frame, m. (), (3,) or (n_worlds, n_drones, 3)"""
    drift_time: ArrayLike = parameter(default=60.0, positive=True)
    """Correlation time of the drift error, s. () or (n_worlds, n_drones)"""
    vel_noise: ArrayLike = parameter(default=0.0, low=0.0, per_axis=True)
    """Standard deviation of a velocity, world frame, m/s. (), (3,) or (n_worlds, n_drones, 3)"""
    pos: ArrayLike = parameter(default=(0.0, 0.0, 0.0))
    """Position of the antenna relative to the centre of mass, body frame, m. (3,) or (n_worlds, n_drones, 3)"""
    _: dataclasses.KW_ONLY
    freq: int | None = 10
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    name: str = "gps"

    @property
    def channels(self) -> Mapping[str, int]:
        return {"pos": 3, "vel": 3}

    def ideal(self, data: SimData) -> Array:
        """Return position and velocity of the antenna. (6,)"""
        pos, s = self.read(data).pos, data.states
        vel = rotation.rotate(s.quat, rotation.cross(s.ang_vel, pos), s.vel)
        return jnp.concatenate([rotation.rotate(s.quat, pos, s.pos), vel])

    def reset_episode(self, data: SimData) -> SimData:
        record = self.read(data)
        drift_error = record.drift * normal(self.episode_key(data), (3,), record.drift_error.dtype)
        return self.write(data, record.replace(drift_error=drift_error))

    def measure(self, data: SimData, record: GPSData, key: Array) -> tuple[Array, GPSData]:
        noise = normal(key, (9,), record.drift_error.dtype)
        drift_error = gauss_markov_step(
            record.drift_error, record.drift, record.drift_time, self.interval(data), noise[:3]
        )
        error = jnp.concatenate([drift_error + record.noise * noise[3:6], record.vel_noise * noise[6:]])
        return self.ideal(data) + error, record.replace(drift_error=drift_error)

    def measured_states(self, data: SimData) -> dict[str, Array]:
        return self.split(self.latest(data))
