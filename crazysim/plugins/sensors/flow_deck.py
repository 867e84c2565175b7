"""Flow deck: optical flow of the ground, and the distance to it by time of flight."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import parameter
from crazysim.core.random import normal
from crazysim.plugins.effects.ground import ground_below
from crazysim.plugins.sensors.sensor import Samples, Sensor, quantise
from crazysim.pytree import PyTree, leaf

PIXELS_PER_RADIAN = 35.0 / 0.71674
"""Pixels by which the image moves per radian (mm_flow.c of crazyflie-firmware: 35 pixels, aperture 0.71674)."""
MIN_TILT_COSINE = 0.1
"""Smallest cosine of the tilt at which the ground is in view: a tilt of 84 degrees. An assumption."""
MIN_FLOW_DISTANCE = 0.02
"""Smallest distance to the ground, m, by which the flow is divided. An assumption."""
FAR_NOISE = math.log(0.2 / 0.0025) / (4.0 - 2.5), 2.5, 0.0025
"""Growth b, 1/m, distance c, m, and scale a, m, of the standard deviation of a distance d by time of flight,
``a (1 + exp(b (d - c)))``, as the filter of the Crazyflie assumes it (zranger2.c of crazyflie-firmware)."""


class OpticalFlowData(PyTree):
    """Measurements and parameters of the optical flow."""

    samples: Samples
    """Measurements."""
    noise: Array = leaf("parameter", 1, (2,), sparse=True)
    """Standard deviation of a measurement, pixels. (2,)"""
    scale: Array = leaf("parameter", 1, (1,))
    """Pixels by which the image moves per radian. (1,)"""
    pos: Array = leaf("parameter", 1, (3,), sparse=True)
    """Position of the camera relative to the centre of mass, body frame, m. (3,)"""
    resolution: Array | None = leaf("parameter", 1, (1,))
    """Step to which measurements are rounded, pixels; None for no rounding. (1,)"""


class OpticalFlow(Sensor):
    """Motion of the image of a camera that looks down, pixels per measurement, along x and y of the body.

    With the distance d to the ground along the optical axis, and the velocity v of the camera in its own frame, the
    image of the ground moves by ``v_x / d - w_y`` and ``v_y / d + w_x`` radians per second (mm_flow.c of
    crazyflie-firmware). The ground is assumed to be level; a drone on its side or upside down measures no motion.
    """

    kind: ClassVar[type[PyTree]] = OpticalFlowData
    noise: ArrayLike = parameter(default=0.0, low=0.0)
    """Standard deviation of a measurement, pixels. (), (2,) or (n_worlds, n_drones, 2)"""
    scale: ArrayLike = parameter(default=PIXELS_PER_RADIAN, positive=True)
    """Pixels by which the image moves per radian. () or (n_worlds, n_drones)"""
    pos: ArrayLike = parameter(default=(0.0, 0.0, 0.0))
    """Position of the camera relative to the centre of mass, body frame, m. (3,) or (n_worlds, n_drones, 3)"""
    resolution: ArrayLike | None = parameter(default=None, positive=True)
    """Step to which measurements are rounded, pixels; None for no rounding. () or (n_worlds, n_drones)"""
    _: dataclasses.KW_ONLY
    freq: int | None = 100
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    name: str = "optical_flow"

    @property
    def channels(self) -> Mapping[str, int]:
        return {"flow": 2}

    def ideal(self, data: SimData) -> Array:
        """Return the motion of the image, pixels per interval. (2,)"""
        record, s = self.read(data), data.states
        distance, is_in_view = ground_distance(data, record.pos)
        vel = rotation.rotate_inverse(s.quat, s.vel, rotation.cross(s.ang_vel, record.pos))
        turn_rate = jnp.stack([-s.ang_vel[1], s.ang_vel[0]])
        angular_rate = vel[:2] / jnp.where(distance > MIN_FLOW_DISTANCE, distance, MIN_FLOW_DISTANCE) + turn_rate
        return jnp.where(is_in_view, record.scale * self.interval(data) * angular_rate, 0.0)

    def measure(self, data: SimData, record: OpticalFlowData, key: Array) -> tuple[Array, OpticalFlowData]:
        truth = self.ideal(data)
        value = truth + record.noise * normal(key, (2,), truth.dtype)
        return quantise(value, record.resolution), record


class TimeOfFlightData(PyTree):
    """Measurements and parameters of the time of flight."""

    samples: Samples
    """Measurements."""
    noise: Array = leaf("parameter", 1, (1,), sparse=True)
    """Standard deviation at any distance, m. (1,)"""
    far_noise: Array = leaf("parameter", 1, (1,), sparse=True)
    """Scale of the standard deviation that grows with the distance, m. (1,)"""
    max_range: Array = leaf("parameter", 1, (1,))
    """Largest distance measured, m. (1,)"""
    pos: Array = leaf("parameter", 1, (3,), sparse=True)
    """Position of the sensor relative to the centre of mass, body frame, m. (3,)"""
    resolution: Array | None = leaf("parameter", 1, (1,))
    """Step to which measurements are rounded, m; None for no rounding. (1,)"""


class TimeOfFlight(Sensor):
    """Distance to the ground along the negative z axis of the body, m; ``max_range`` where nothing is nearer.

    The ground is the floor or terrain below the drone, assumed to be level: the distance is the height divided by the
    cosine of the tilt. Use ``RangeFinder`` for obstacles. At distance d the standard deviation is
    ``noise + far_noise (1 + exp(2.92 (d - 2.5)))``, by default as the filter of the Crazyflie assumes.
    """

    kind: ClassVar[type[PyTree]] = TimeOfFlightData
    noise: ArrayLike = parameter(default=0.0, low=0.0)
    """Standard deviation at any distance, m. () or (n_worlds, n_drones)"""
    far_noise: ArrayLike = parameter(default=FAR_NOISE[2], low=0.0)
    """Scale of the standard deviation that grows with the distance, m. () or (n_worlds, n_drones)"""
    max_range: ArrayLike = parameter(default=4.0, positive=True)
    """Largest distance measured, m. () or (n_worlds, n_drones)"""
    pos: ArrayLike = parameter(default=(0.0, 0.0, 0.0))
    """Position of the sensor relative to the centre of mass, body frame, m. (3,) or (n_worlds, n_drones, 3)"""
    resolution: ArrayLike | None = parameter(default=0.001, positive=True)
    """Step to which measurements are rounded, m; None for no rounding. () or (n_worlds, n_drones)"""
    _: dataclasses.KW_ONLY
    freq: int | None = 25
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step. The firmware measures at most once
    in 25 ms (zranger2.c), which is 40 Hz. The default is the largest divisor of 500 below that; 40 Hz is possible with
    1000 steps per second."""
    name: str = "time_of_flight"

    @property
    def channels(self) -> Mapping[str, int]:
        return {"distance": 1}

    def ideal(self, data: SimData) -> Array:
        """Return the distance to the ground, m. (1,)"""
        record = self.read(data)
        distance, is_in_view = ground_distance(data, record.pos)
        distance = jnp.where(distance > 0, distance, 0.0)
        return jnp.where(is_in_view & (distance < record.max_range), distance, record.max_range)

    def measure(self, data: SimData, record: TimeOfFlightData, key: Array) -> tuple[Array, TimeOfFlightData]:
        truth = self.ideal(data)
        deviation = record.noise + range_deviation(truth, record.far_noise)
        is_in_range = truth < record.max_range
        value = truth + deviation * normal(key, (1,), truth.dtype)
        value = jnp.where(is_in_range, rotation.clip(value, 0.0, record.max_range), record.max_range)
        return quantise(value, record.resolution), record


def range_deviation(distance: Array, scale: Array) -> Array:
    """Return the part of a distance's standard deviation that grows with the distance as in ``FAR_NOISE``, m. (...)"""
    growth, reference, _ = FAR_NOISE
    return scale * (1 + jnp.exp(growth * (distance - reference)))


def ground_distance(data: SimData, pos: Array) -> tuple[Array, Array]:
    """Return the distance to level ground along the body's negative z axis, m, and True if the ground is in view.

    Args:
        data: The data of one drone.
        pos: Position of the sensor relative to the centre of mass, body frame, m. (3,)

    Returns:
        Distance and flag. (1,) each
    """
    s = data.states
    cosine = rotation.z_axis(s.quat)[2:]
    is_in_view = cosine > MIN_TILT_COSINE
    height = s.pos[2:] + rotation.rotate(s.quat, pos)[2:] - ground_below(data)
    return height / jnp.where(is_in_view, cosine, 1.0), is_in_view
