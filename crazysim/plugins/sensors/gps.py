"""Satellite navigation: position with drifting errors, and velocity."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Param, param, state
from crazysim.plugins.sensors.errors import GaussMarkov, White
from crazysim.plugins.sensors.sensor import Sensor


class GPS(Sensor):
    """Position, m, and velocity, m/s, of the antenna, world frame."""

    noise: Param = param(default=0.0, core=(3,), low=0.0, per_axis=True, sparse=True)
    """Standard deviation of a position, world frame, m. (3,)"""
    drift: Param = param(default=0.0, core=(3,), low=0.0, per_axis=True, sparse=True)
    """Standard deviation of the drift error of the position, world frame, m. (3,)"""
    drift_time: Param = param(default=60.0, positive=True)
    """Correlation time of the drift error, s. (1,)"""
    vel_noise: Param = param(default=0.0, core=(3,), low=0.0, per_axis=True, sparse=True)
    """Standard deviation of a velocity, world frame, m/s. (3,)"""
    pos: Param = param(default=(0.0, 0.0, 0.0), core=(3,), sparse=True)
    """Position of the antenna relative to the centre of mass, body frame, m. (3,)"""
    _: dataclasses.KW_ONLY
    drift_error: Array = state((3,))
    """Drift error of the position, world frame, m. (n_worlds, n_drones, 3)"""
    freq: int | None = 10
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    name: str = "gps"

    channels: ClassVar = {"pos": 3, "vel": 3}
    chains: ClassVar = {
        "pos": [GaussMarkov("drift", "drift_error", "drift_time"), White("noise")],
        "vel": [White("vel_noise")],
    }

    def ideal(self, data: SimData) -> Array:
        s = data.states
        vel = rotation.rotate(s.quat, rotation.cross(s.ang_vel, self.pos), s.vel)
        return jnp.concatenate([rotation.rotate(s.quat, self.pos, s.pos), vel])

    def measured_states(self, data: SimData) -> dict[str, Array]:
        return self.split(self.latest(data))
