"""Flow deck: optical flow of the ground, and the distance to it by time of flight."""

from __future__ import annotations

import dataclasses
import math
from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Param, param
from crazysim.core.random import normal
from crazysim.plugins.effects.ground import ground_below
from crazysim.plugins.sensors.errors import Rounded, White, quantise
from crazysim.plugins.sensors.sensor import Sensor

PIXELS_PER_RADIAN = 35.0 / 0.71674
"""Pixels by which the image moves per radian (mm_flow.c of crazyflie-firmware: 35 pixels, aperture 0.71674)."""
MIN_TILT_COSINE = 0.1
"""Smallest cosine of the tilt at which the ground is in view: a tilt of 84 degrees. An assumption."""
MIN_FLOW_DISTANCE = 0.02
"""Smallest distance to the ground, m, by which the flow is divided. An assumption."""
FAR_NOISE = math.log(0.2 / 0.0025) / (4.0 - 2.5), 2.5, 0.0025
"""Growth b, 1/m, distance c, m, and scale a, m, of the standard deviation of a distance d by time of flight,
``a (1 + exp(b (d - c)))``, as the filter of the Crazyflie assumes it (zranger2.c of crazyflie-firmware)."""


class OpticalFlow(Sensor):
    """Motion of the image of a camera that looks down, pixels per measurement, along x and y of the body.

    With the distance d to the ground along the optical axis, and the velocity v of the camera in its own frame, the
    image of the ground moves by ``v_x / d - w_y`` and ``v_y / d + w_x`` radians per second (mm_flow.c of
    crazyflie-firmware). The ground is assumed to be level; a drone on its side or upside down measures no motion.
    """

    noise: Param = param(default=0.0, core=(2,), low=0.0, sparse=True)
    """Standard deviation of a measurement, pixels. (2,)"""
    scale: Param = param(default=PIXELS_PER_RADIAN, positive=True)
    """Pixels by which the image moves per radian. (1,)"""
    pos: Param = param(default=(0.0, 0.0, 0.0), core=(3,), sparse=True)
    """Position of the camera relative to the centre of mass, body frame, m. (3,)"""
    resolution: Param = param(default=None, positive=True)
    """Step to which measurements are rounded, pixels; None for no rounding. (1,)"""
    _: dataclasses.KW_ONLY
    freq: int | None = 100
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    name: str = "optical_flow"

    channels: ClassVar = {"flow": 2}
    chains: ClassVar = {"flow": [White("noise"), Rounded("resolution")]}

    def ideal(self, data: SimData) -> Array:
        s = data.states
        distance, is_in_view = ground_distance(data, self.pos)
        vel = rotation.rotate_inverse(s.quat, s.vel, rotation.cross(s.ang_vel, self.pos))
        turn_rate = jnp.stack([-s.ang_vel[1], s.ang_vel[0]])
        angular_rate = vel[:2] / jnp.where(distance > MIN_FLOW_DISTANCE, distance, MIN_FLOW_DISTANCE) + turn_rate
        return jnp.where(is_in_view, self.scale * self.interval(data) * angular_rate, 0.0)


class TimeOfFlight(Sensor):
    """Distance to the ground along the negative z axis of the body, m; ``max_range`` where nothing is nearer.

    The ground is the floor or terrain below the drone, assumed to be level: the distance is the height divided by the
    cosine of the tilt. Use ``RangeFinder`` for obstacles. At distance d the standard deviation is
    ``noise + far_noise (1 + exp(2.92 (d - 2.5)))``, by default as the filter of the Crazyflie assumes.
    """

    noise: Param = param(default=0.0, low=0.0, sparse=True)
    """Standard deviation at any distance, m. (1,)"""
    far_noise: Param = param(default=FAR_NOISE[2], low=0.0, sparse=True)
    """Scale of the standard deviation that grows with the distance, m. (1,)"""
    max_range: Param = param(default=4.0, positive=True)
    """Largest distance measured, m. (1,)"""
    pos: Param = param(default=(0.0, 0.0, 0.0), core=(3,), sparse=True)
    """Position of the sensor relative to the centre of mass, body frame, m. (3,)"""
    resolution: Param | None = param(default=0.001, positive=True)
    """Step to which measurements are rounded, m; None for no rounding. (1,)"""
    _: dataclasses.KW_ONLY
    freq: int | None = 25
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step. The firmware measures at most once
    in 25 ms (zranger2.c), which is 40 Hz. The default is the largest divisor of 500 below that; 40 Hz is possible with
    1000 steps per second."""
    name: str = "time_of_flight"

    channels: ClassVar = {"distance": 1}

    def ideal(self, data: SimData) -> Array:
        distance, is_in_view = ground_distance(data, self.pos)
        distance = jnp.where(distance > 0, distance, 0.0)
        return jnp.where(is_in_view & (distance < self.max_range), distance, self.max_range)

    def measure(self, data: SimData, key: Array) -> tuple[Array, TimeOfFlight]:
        truth = self.ideal(data)
        value = truth + self.deviation(truth) * normal(key, (1,), truth.dtype)
        value = jnp.where(truth < self.max_range, rotation.clip(value, 0.0, self.max_range), self.max_range)
        return quantise(value, self.resolution), self

    def deviation(self, distance: Array) -> Array:
        """Return the standard deviation at a distance, m. (1,)"""
        return self.noise + range_deviation(distance, self.far_noise)


def range_deviation(distance: Array, scale: Array) -> Array:
    """Return the part of a distance's standard deviation that grows with the distance as in ``FAR_NOISE``, m. (...)"""
    growth, reference, _ = FAR_NOISE
    return scale * (1 + jnp.exp(growth * (distance - reference)))


def ground_distance(data: SimData, pos: Array) -> tuple[Array, Array]:
    """Return the distance to level ground along the body's -z axis, m, and True if the ground is in view. (1,) each

    Args:
        data: The data of one drone.
        pos: Position of the sensor relative to the centre of mass, body frame, m. (3,)
    """
    s = data.states
    cosine = rotation.z_axis(s.quat)[2:]
    is_in_view = cosine > MIN_TILT_COSINE
    height = s.pos[2:] + rotation.rotate(s.quat, pos)[2:] - ground_below(data)
    return height / jnp.where(is_in_view, cosine, 1.0), is_in_view
