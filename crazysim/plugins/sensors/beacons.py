"""Sensors that measure relative to known positions: distances to ultra-wideband anchors, lighthouse sweep angles."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Simulation, parameter
from crazysim.core.random import normal, uniform
from crazysim.errors import ConfigError
from crazysim.plugins.sensors.sensor import Samples, Sensor
from crazysim.pytree import PyTree, device_array, leaf

SWEEP_TILTS = -math.pi / 6, math.pi / 6
"""Tilts of the two light planes of a lighthouse of the second generation, rad: 30 degrees either way (Taffanel et al.
2021, arXiv:2104.11523)."""
MAX_SINE = 1 - 1e-4
"""Limit of the argument of the arcsine in a sweep angle, which keeps gradients finite."""


class UWBData(PyTree):
    """Measurements and parameters of ultra-wideband ranging."""

    samples: Samples
    """Measurements."""
    anchors: Array = leaf("shared", 2)
    """Positions of the anchors, world frame, m. (n_anchors, 3)"""
    pos: Array = leaf("parameter", 1, (3,), sparse=True)
    """Position of the antenna relative to the centre of mass, body frame, m. (3,)"""
    bias: Array = leaf("parameter", 1, (1,), sparse=True)
    """Error of every distance, m. (1,)"""
    noise: Array = leaf("parameter", 1, (1,), sparse=True)
    """Standard deviation of a distance, m. (1,)"""
    outliers: Array = leaf("parameter", 1, (1,), sparse=True)
    """Probability that a distance is measured along a detour, 0 to 1. (1,)"""
    detour: Array = leaf("parameter", 1, (1,), sparse=True)
    """Mean length of a detour, m. (1,)"""


class UWB(Sensor):
    """Distances to anchors by two-way ranging, m, or their differences from the first distance (TDoA), m.

    A distance has a bias, white noise, and, at random, a detour of exponentially distributed length, as of reflected
    signals. All anchors are measured at the same time.
    """

    anchors: ArrayLike = parameter()
    """Positions of the anchors, world frame, m. (n_anchors, 3)"""
    noise: ArrayLike = parameter(default=0.0, low=0.0)
    """Standard deviation of a distance, m; a difference has sqrt(2) times as much. () or (n_worlds, n_drones)"""
    bias: ArrayLike = parameter(default=0.0)
    """Constant error of every distance, m; it cancels in differences. () or (n_worlds, n_drones)"""
    outliers: ArrayLike = parameter(default=0.0, low=0.0, high=1.0)
    """Probability that a distance is measured along a detour, 0 to 1. () or (n_worlds, n_drones)"""
    detour: ArrayLike = parameter(default=1.0, low=0.0)
    """Mean length of a detour, m. () or (n_worlds, n_drones)"""
    pos: ArrayLike = parameter(default=(0.0, 0.0, 0.0))
    """Position of the antenna relative to the centre of mass, body frame, m. (3,) or (n_worlds, n_drones, 3)"""
    _: dataclasses.KW_ONLY
    tdoa: bool = False
    """True for differences of distances."""
    freq: int | None = 50
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    name: str = "uwb"

    @property
    def channels(self) -> Mapping[str, int]:
        n = len(np.asarray(self.anchors))
        return {"difference": n - 1} if self.tdoa else {"distance": n}

    def record(self, sim: Simulation) -> UWBData:
        anchors = _point_array("anchors", self.anchors, 2 if self.tdoa else 1)
        return self.fill_record(sim, UWBData, anchors=device_array(anchors, sim.data.states.pos.dtype))

    def ideal(self, data: SimData) -> Array:
        """Return the distances, (n_anchors,), or their differences from the first, (n_anchors - 1,), m."""
        return self._to_measurement(self._distances(data))

    def measure(self, data: SimData, record: UWBData, key: Array) -> tuple[Array, UWBData]:
        distance = self._distances(data)
        keys, shape, dtype = jax.random.split(key), distance.shape, distance.dtype
        random_numbers = uniform(keys[0], (*shape, 2), dtype)
        detour = jnp.where(
            random_numbers[:, 1] < record.outliers, -record.detour * jnp.log(1 - random_numbers[:, 0]), 0.0
        )
        distance = distance + record.bias + detour + record.noise * normal(keys[1], shape, dtype)
        return self._to_measurement(distance), record

    def _distances(self, data: SimData) -> Array:
        """Return the distances of one antenna from the anchors, m. (n_anchors,)"""
        record, s = self.read(data), data.states
        return rotation.safe_norm(rotation.rotate(s.quat, record.pos, s.pos) - record.anchors)[:, 0]

    def _to_measurement(self, distance: Array) -> Array:
        return distance[1:] - distance[0] if self.tdoa else distance


class LighthouseData(PyTree):
    """Measurements and parameters of lighthouses."""

    samples: Samples
    """Measurements."""
    stations: Array = leaf("shared", 2)
    """Positions of the base stations, world frame, m. (n_stations, 3)"""
    quat: Array = leaf("shared", 2)
    """Attitudes of the base stations, station to world, unit, xyzw. (n_stations, 4)"""
    diodes: Array = leaf("shared", 2)
    """Positions of the photodiodes relative to the centre of mass, body frame, m. (n_diodes, 3)"""
    noise: Array = leaf("parameter", 1, (1,), sparse=True)
    """Standard deviation of an angle, rad. (1,)"""


class Lighthouse(Sensor):
    """Angles at which the two light planes of base stations pass photodiodes, rad, and 1 for each diode in view.

    In a station's frame, x forwards and z upwards, a plane with tilt t passes the point (x, y, z) at
    ``atan2(y, x) + asin(z tan(t) / sqrt(x^2 + y^2))`` (Taffanel et al. 2021, arXiv:2104.11523). A diode is in view of a
    station if it is in front of the station, and the station is above the plane of the body's x and y axes. Angles of
    diodes out of view are zero. Objects do not hide diodes.
    """

    stations: ArrayLike = parameter()
    """Positions of the base stations, world frame, m. (n_stations, 3)"""
    rpy: ArrayLike = parameter()
    """Roll, pitch and yaw of the base stations, world frame, rad. (n_stations, 3)"""
    noise: ArrayLike = parameter(default=0.0, low=0.0)
    """Standard deviation of an angle, rad. () or (n_worlds, n_drones)"""
    diodes: ArrayLike = parameter(default=((0.0, 0.0, 0.0),))
    """Positions of the photodiodes relative to the centre of mass, body frame, m. (n_diodes, 3)"""
    _: dataclasses.KW_ONLY
    freq: int | None = 50
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    name: str = "lighthouse"

    @property
    def channels(self) -> Mapping[str, int]:
        """Names and lengths of the parts of a measurement, which are sorted by station, then diode, then plane."""
        n = len(np.asarray(self.stations)) * len(np.asarray(self.diodes))
        return {"angle": 2 * n, "visible": n}

    def record(self, sim: Simulation) -> LighthouseData:
        stations, rpy = _point_array("stations", self.stations, 1), _point_array("rpy", self.rpy, 1)
        if stations.shape != rpy.shape:
            raise ConfigError(f"expected rpy of shape {stations.shape}, one for each station, got {rpy.shape}")
        dtype = sim.data.states.pos.dtype
        return self.fill_record(
            sim,
            LighthouseData,
            stations=device_array(stations, dtype),
            quat=jax.jit(rotation.from_rpy)(device_array(rpy, dtype)),
            diodes=device_array(_point_array("diodes", self.diodes, 1), dtype),
        )

    def ideal(self, data: SimData) -> Array:
        """Return the angles, rad, and 1 where a diode is in view, else 0. (3 n_stations n_diodes,)"""
        record, s = self.read(data), data.states
        diodes = rotation.rotate(s.quat, record.diodes, s.pos)
        offset = diodes - record.stations[:, None]
        station_frame_pos = rotation.rotate_inverse(record.quat[:, None], offset)
        angle = jnp.stack([sweep_angle(station_frame_pos, tilt) for tilt in SWEEP_TILTS], axis=-1)
        is_above = -rotation.dot(offset, rotation.z_axis(s.quat))[..., 0] > 0
        is_visible = (station_frame_pos[..., 0] > 0) & is_above
        angle = jnp.where(is_visible[..., None], angle, 0.0)
        return jnp.concatenate([angle.reshape(-1), is_visible.astype(angle.dtype).reshape(-1)])

    def measure(self, data: SimData, record: LighthouseData, key: Array) -> tuple[Array, LighthouseData]:
        truth = self.ideal(data)
        n = truth.shape[0] // 3
        visibility = jnp.repeat(truth[2 * n :], 2)
        angle = truth[: 2 * n] + visibility * record.noise * normal(key, (2 * n,), truth.dtype)
        return jnp.concatenate([angle, truth[2 * n :]]), record


def sweep_angle(pos: Array, tilt: float) -> Array:
    """Return the angle at which a tilted light plane passes a point, rad. (...)

    Args:
        pos: The point in the frame of the base station, x forwards, z upwards, m. (..., 3)
        tilt: Tilt of the plane, rad.
    """
    horizontal_distance = rotation.safe_norm(pos[..., :2])[..., 0]
    sine = pos[..., 2] * math.tan(tilt) / jnp.where(horizontal_distance > 1e-6, horizontal_distance, 1e-6)
    sine = rotation.clip(sine, -MAX_SINE, MAX_SINE)
    return rotation.safe_arctan2(pos[..., 1], pos[..., 0]) + jnp.arcsin(sine)


def _point_array(name: str, value: ArrayLike, min_points: int) -> np.ndarray:
    """Return the checked setting ``name`` as an array of vectors. (n, 3)"""
    points = np.asarray(value, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < min_points or not np.isfinite(points).all():
        raise ConfigError(f"expected {name} as at least {min_points} finite vectors (n, 3), got {points.tolist()}")
    return points
