"""Motion capture: position, attitude and velocity from cameras, optionally delayed and with lost measurements."""

from __future__ import annotations

import dataclasses
import math
from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Simulation, derived, param, state
from crazysim.plugins.sensors.errors import Turned, White
from crazysim.plugins.sensors.sensor import Sensor, mounting_quat


class MotionCapture(Sensor):
    """Position, m, attitude, xyzw, and velocity, m/s, of a tracked body on every drone, world frame.

    The velocity is the low-pass filtered difference quotient of successive positions, as laboratories usually estimate
    it, and so it contains the noise of the positions.
    """

    noise: Param = param(default=0.0, core=(3,), low=0.0, per_axis=True, sparse=True)
    """Standard deviation of a position, m. (3,)"""
    angle_noise: Param = param(default=0.0, core=(3,), low=0.0, per_axis=True, sparse=True)
    """Standard deviation of the attitude about each axis of the body, rad. (3,)"""
    bandwidth: Param = param(default=20.0, positive=True)
    """Corner frequency of the low-pass filter of the velocity, Hz. (1,)"""
    pos: Param = param(default=(0.0, 0.0, 0.0), core=(3,), sparse=True)
    """Origin of the tracked body relative to the centre of mass, body frame, m. (3,)"""
    rpy: Param = param(default=(0.0, 0.0, 0.0), core=(3,), keep=False)
    """Roll, pitch and yaw of the tracked body in the frame of the drone, rad. (3,) or (n_worlds, n_drones, 3)"""
    _: dataclasses.KW_ONLY
    quat: Array = derived((4,), sparse=True)
    """Attitude of the tracked body, tracked body to drone, unit, xyzw. (4,)"""
    last_pos: Array = state((3,))
    """Last measured position, world frame, m. (n_worlds, n_drones, 3)"""
    vel: Array = state((3,))
    """Low-pass filtered difference quotient of the positions, world frame, m/s. (n_worlds, n_drones, 3)"""
    freq: int | None = 100
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    name: str = "motion_capture"

    channels: ClassVar = {"pos": 3, "quat": 4, "vel": 3}
    chains: ClassVar = {"pos": [White("noise")], "quat": [Turned("angle_noise")]}

    def bind(self, sim: Simulation) -> MotionCapture:
        return self.with_arrays(sim, quat=mounting_quat(sim, self.rpy))

    def ideal(self, data: SimData) -> Array:
        s = data.states
        vel = rotation.rotate(s.quat, rotation.cross(s.ang_vel, self.pos), s.vel)
        return jnp.concatenate([rotation.rotate(s.quat, self.pos, s.pos), rotation.multiply(s.quat, self.quat), vel])

    def reset_episode(self, data: SimData) -> SimData:
        pos, vel = jnp.split(self.ideal(data), (7,))
        data = super().reset_episode(data)
        return self.write(data, self.read(data).replace(last_pos=pos[:3] - self.interval(data) * vel, vel=vel))

    def measure(self, data: SimData, key: Array) -> tuple[Array, MotionCapture]:
        (value, sensor), dt = super().measure(data, key), self.interval(data)
        pose = value[:7]
        vel = (pose[:3] - self.last_pos) / dt
        vel = self.vel + (1 - jnp.exp(-2 * math.pi * dt * self.bandwidth)) * (vel - self.vel)
        return jnp.concatenate([pose, vel]), sensor.replace(last_pos=pose[:3], vel=vel)

    def measured_states(self, data: SimData) -> dict[str, Array]:
        return self.split(self.latest(data))
