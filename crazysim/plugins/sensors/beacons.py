"""Sensors that measure relative to known positions: distances to ultra-wideband anchors, lighthouse sweep angles."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Simulation, derived, param
from crazysim.core.random import normal, uniform
from crazysim.engine.pytree import device_array
from crazysim.errors import ConfigError
from crazysim.plugins.sensors.sensor import Sensor

SWEEP_TILTS = -math.pi / 6, math.pi / 6
"""Tilts of the two light planes of a lighthouse of the second generation, rad: 30 degrees either way (Taffanel et al.
2021, arXiv:2104.11523)."""
MAX_SINE = 1 - 1e-4
"""Limit of the argument of the arcsine in a sweep angle, which keeps gradients finite."""


class UWB(Sensor):
    """Distances to anchors by two-way ranging, m, or their differences from the first distance (TDoA), m.

    A distance has a bias, white noise, and, at random, a detour of exponentially distributed length, as of reflected
    signals. All anchors are measured at the same time.
    """

    anchors: Param = param(core=("anchors", 3), scope="shared")
    """Positions of the anchors, world frame, m. (n_anchors, 3)"""
    noise: Param = param(default=0.0, low=0.0, sparse=True)
    """Standard deviation of a distance, m; a difference has sqrt(2) times as much. (1,)"""
    bias: Param = param(default=0.0, sparse=True)
    """Constant error of every distance, m; it cancels in differences. (1,)"""
    outliers: Param = param(default=0.0, low=0.0, high=1.0, sparse=True)
    """Probability that a distance is measured along a detour, 0 to 1. (1,)"""
    detour: Param = param(default=1.0, low=0.0, sparse=True)
    """Mean length of a detour, m. (1,)"""
    pos: Param = param(default=(0.0, 0.0, 0.0), core=(3,), sparse=True)
    """Position of the antenna relative to the centre of mass, body frame, m. (3,)"""
    _: dataclasses.KW_ONLY
    tdoa: bool = False
    """True for differences of distances."""
    freq: int | None = 50
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    name: str = "uwb"

    @property
    def channels(self) -> Mapping[str, int]:
        """Names and lengths of the parts of a measurement."""
        n = np.shape(self.anchors)[0]
        return {"difference": n - 1} if self.tdoa else {"distance": n}

    def bind(self, sim: Simulation) -> UWB:
        return self.with_arrays(sim, anchors=_point_array(sim, "anchors", self.anchors, 2 if self.tdoa else 1))

    def ideal(self, data: SimData) -> Array:
        return self._to_measurement(self._distances(data))

    def measure(self, data: SimData, key: Array) -> tuple[Array, UWB]:
        distance = self._distances(data)
        keys, shape, dtype = jax.random.split(key), distance.shape, distance.dtype
        random_numbers = uniform(keys[0], (*shape, 2), dtype)
        detour = jnp.where(random_numbers[:, 1] < self.outliers, -self.detour * jnp.log(1 - random_numbers[:, 0]), 0.0)
        distance = distance + self.bias + detour + self.noise * normal(keys[1], shape, dtype)
        return self._to_measurement(distance), self

    def _distances(self, data: SimData) -> Array:
        s = data.states
        return rotation.safe_norm(rotation.rotate(s.quat, self.pos, s.pos) - self.anchors)[:, 0]

    def _to_measurement(self, distance: Array) -> Array:
        return distance[1:] - distance[0] if self.tdoa else distance


class Lighthouse(Sensor):
    """Angles at which the two light planes of base stations pass photodiodes, rad, and 1 for each diode in view.

    In a station's frame, x forwards and z upwards, a plane with tilt t passes the point (x, y, z) at
    ``atan2(y, x) + asin(z tan(t) / sqrt(x^2 + y^2))`` (Taffanel et al. 2021, arXiv:2104.11523). A diode is in view of a
    station if it is in front of the station, and the station is above the plane of the body's x and y axes. Angles of
    diodes out of view are zero. Objects do not hide diodes.
    """

    stations: Param = param(core=("stations", 3), scope="shared")
    """Positions of the base stations, world frame, m. (n_stations, 3)"""
    rpy: Param = param(core=("stations", 3), scope="shared", keep=False)
    """Roll, pitch and yaw of the base stations, world frame, rad. (n_stations, 3)"""
    noise: Param = param(default=0.0, low=0.0, sparse=True)
    """Standard deviation of an angle, rad. (1,)"""
    diodes: Param = param(default=((0.0, 0.0, 0.0),), core=("diodes", 3), scope="shared")
    """Positions of the photodiodes relative to the centre of mass, body frame, m. (n_diodes, 3)"""
    _: dataclasses.KW_ONLY
    quat: Array = derived(("stations", 4), scope="shared")
    """Attitudes of the base stations, station to world, unit, xyzw. (n_stations, 4)"""
    freq: int | None = 50
    """Measurements per second, Hz, a divisor of ``sim.freq``; None for every step."""
    name: str = "lighthouse"

    @property
    def channels(self) -> Mapping[str, int]:
        """Names and lengths of the parts of a measurement, which are sorted by station, then diode, then plane."""
        n = np.shape(self.stations)[0] * np.shape(self.diodes)[0]
        return {"angle": 2 * n, "visible": n}

    def bind(self, sim: Simulation) -> Lighthouse:
        stations, rpy, diodes = (
            _point_array(sim, name, getattr(self, name), 1) for name in ("stations", "rpy", "diodes")
        )
        if stations.shape != rpy.shape:
            raise ConfigError(f"expected rpy of shape {stations.shape}, one for each station, got {rpy.shape}")
        return self.with_arrays(sim, stations=stations, quat=jax.jit(rotation.from_rpy)(rpy), diodes=diodes)

    def ideal(self, data: SimData) -> Array:
        s = data.states
        offset = rotation.rotate(s.quat, self.diodes, s.pos) - self.stations[:, None]
        station_frame_pos = rotation.rotate_inverse(self.quat[:, None], offset)
        angle = jnp.stack([sweep_angle(station_frame_pos, tilt) for tilt in SWEEP_TILTS], axis=-1)
        is_above = -rotation.dot(offset, rotation.z_axis(s.quat))[..., 0] > 0
        is_visible = (station_frame_pos[..., 0] > 0) & is_above
        angle = jnp.where(is_visible[..., None], angle, 0.0)
        return jnp.concatenate([angle.reshape(-1), is_visible.astype(angle.dtype).reshape(-1)])

    def measure(self, data: SimData, key: Array) -> tuple[Array, Lighthouse]:
        truth, n = self.ideal(data), self.channels["angle"]
        deviation = jnp.repeat(truth[n:], 2) * self.noise
        angle = truth[:n] + deviation * normal(key, (n,), truth.dtype)
        return jnp.concatenate([angle, truth[n:]]), self


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


def _point_array(sim: Simulation, name: str, value: Any, min_points: int) -> Array:
    points = np.asarray(value, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < min_points or not np.isfinite(points).all():
        raise ConfigError(f"expected {name} as at least {min_points} finite vectors (n, 3), got {points.tolist()}")
    return device_array(points, sim.data.states.pos.dtype)
