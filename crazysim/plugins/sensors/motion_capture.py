"""Motion capture: position, attitude and velocity from cameras, optionally delayed and with lost measurements."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Simulation, parameter
from crazysim.core.random import normal
from crazysim.plugins.sensors.sensor import Samples, Sensor, mounting_quat
from crazysim.pytree import PyTree, leaf


class MotionCaptureData(PyTree):
    """Measurements and parameters of motion capture."""

    samples: Samples
    """Measurements."""
    last_pos: Array = leaf("drone", 1, (3,))
    """Last measured position, world frame, m. (n_worlds, n_drones, 3)"""
    vel: Array = leaf("drone", 1, (3,))
    """Low-pass filtered difference quotient of the positions, world frame, m/s. (n_worlds, n_drones, 3)"""
    noise: Array = leaf("parameter", 1, (3,), sparse=True)
    """Standard deviation of a position, m. (3,)"""
    angle_noise: Array = leaf("parameter", 1, (3,), sparse=True)
    """Standard deviation of the attitude about each axis of the body, rad. (3,)"""
    bandwidth: Array = leaf("parameter", 1, (1,))
    """Corner frequency of the low-pass filter of the velocity, Hz. (1,)"""
    pos: Array = leaf("parameter", 1, (3,), sparse=True)
    """Origin of the tracked body relative to the centre of mass, body frame, m. (3,)"""
    quat: Array = leaf("parameter", 1, (4,), sparse=True)
    """Attitude of the tracked body, tracked body to drone, unit, xyzw. (4,)"""


class MotionCapture(Sensor):
    """Position, m, attitude, xyzw, and velocity, m/s, of a tracked body on every drone, world frame.

    The velocity is the low-pass filtered difference quotient of successive positions, as laboratories usually estimate
    it, and so it contains the noise of the positions.
    """

    noise: ArrayLike = parameter(default=0.0, low=0.0, per_axis=True)
    """Standard deviation of a position, m. (), (3,) or (n_worlds, n_drones, 3)"""
    angle_noise: ArrayLike = parameter(default=0.0, low=0.0, per_axis=True)
    """Standard deviation of the attitude about each axis, rad. (), (3,) or (n_worlds, n_drones, 3)"""
    bandwidth: ArrayLike = parameter(default=20.0, positive=True)
    """Corner frequency of the low-pass filter of the velocity, Hz. () or (n_worlds, n_drones)"""
    pos: ArrayLike = parameter(default=(0.0, 0.0, 0.0))
    """Origin of the tracked body relative to the centre of mass, body frame, m. (3,) or (n_worlds, n_drones, 3)"""
    rpy: ArrayLike = parameter(default=(0.0, 0.0, 0.0))
    """Roll, pitch and yaw of the tracked body in the frame of the drone, rad. (3,) or (n_worlds, n_drones, 3)"""
    _: dataclasses.KW_ONLY
    freq: int | None = 100
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    name: str = "motion_capture"

    @property
    def channels(self) -> Mapping[str, int]:
        return {"pos": 3, "quat": 4, "vel": 3}

    def record(self, sim: Simulation) -> MotionCaptureData:
        return self.fill_record(sim, MotionCaptureData, quat=mounting_quat(sim, self.rpy))

    def ideal(self, data: SimData) -> Array:
        """Return the pose and the velocity of the tracked body. (10,)"""
        record, s = self.read(data), data.states
        pos = rotation.rotate(s.quat, record.pos, s.pos)
        vel = rotation.rotate(s.quat, rotation.cross(s.ang_vel, record.pos), s.vel)
        return jnp.concatenate([pos, rotation.multiply(s.quat, record.quat), vel])

    def reset_episode(self, data: SimData) -> SimData:
        pos, vel = jnp.split(self.ideal(data), (7,))
        return self.write(data, self.read(data).replace(last_pos=pos[:3] - self.interval(data) * vel, vel=vel))

    def measure(self, data: SimData, record: MotionCaptureData, key: Array) -> tuple[Array, MotionCaptureData]:
        truth, dt = self.ideal(data), self.interval(data)
        noise = normal(key, (6,), truth.dtype)
        pos = truth[:3] + record.noise * noise[:3]
        half_rotvec = 0.5 * record.angle_noise * noise[3:]
        quat = rotation.multiply(truth[3:7], jnp.concatenate([half_rotvec, jnp.ones_like(half_rotvec[:1])]))
        quat = quat / jnp.sqrt(rotation.dot(quat, quat))
        vel = (pos - record.last_pos) / dt
        vel = record.vel + (1 - jnp.exp(-2 * math.pi * dt * record.bandwidth)) * (vel - record.vel)
        return jnp.concatenate([pos, quat, vel]), record.replace(last_pos=pos, vel=vel)

    def measured_states(self, data: SimData) -> dict[str, Array]:
        """Return position, attitude and velocity, as if the tracked body were the drone's frame."""
        return self.split(self.latest(data))
