"""Lidars, rotating or solid-state: distances along the rays of a pattern."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.random import normal, uniform
from crazysim.core.settings import setting
from crazysim.errors import ConfigError
from crazysim.plugins.sensors.errors import quantise
from crazysim.plugins.sensors.image_sensor import COLORS, FLOWS, ImageSensor

VLP16_ELEVATIONS = tuple(range(15, -16, -2))
"""Elevations of the 16 rows, degrees (VLP-16 User Manual, 63-9243 revision D, table 9-1)."""
VLP16_RANGE, VLP16_NOISE, VLP16_RESOLUTION = 100.0, 0.03, 0.002
"""Range, m; accuracy, m, used as a standard deviation; steps of the distance, m (VLP-16 User Manual, 63-9243
revision D: up to 100 m, +-3 cm typical, 2 mm granularity)."""
VL53L5CX_ZONES, VL53L5CX_FOV, VL53L5CX_RANGE = 8, 45.0, 4.0
"""Zones on a side; width and height of the square field of view, degrees; range, m (ST, user manual UM2884: 8 x 8
zones, 63 degrees along the diagonal, which is 45 degrees on a side, and up to 4 m)."""


class Lidar(ImageSensor):
    """Lidar on every drone: a ray for each pair of an elevation and an azimuth, all at one instant.

    Images have a row for each elevation and a column for each azimuth. A ray without a return has ``max_range``.
    """

    elevation: ArrayLike = setting(default=VLP16_ELEVATIONS, low=-90.0, high=90.0, shapes=(("any",),))
    """Elevation of each row above the x and y axes of the sensor, degrees. (n_rows,)"""
    azimuth: ArrayLike = setting(default=tuple(range(179, -181, -1)), low=-360.0, high=360.0, shapes=(("any",),))
    """Azimuth of each column from x ahead to y left, degrees. (n_columns,)"""
    _: dataclasses.KW_ONLY
    outputs: tuple[str, ...] = ("distance",)
    """Images to take, some of ``"distance"``, ``"normal"`` and ``"segmentation"``; see ``ImageSensor``."""
    max_range: float = setting(default=VLP16_RANGE, positive=True)
    """Largest distance, m; also the value without a return."""
    min_range: float = setting(default=0.0, low=0.0)
    """Smallest distance, m; nearer surfaces give no return."""
    noise: float = setting(default=0.0, low=0.0)
    """Standard deviation of a distance, m."""
    relative_noise: float = setting(default=0.0, low=0.0)
    """Additional standard deviation of a distance, as a fraction of the distance, 1."""
    resolution: float = setting(default=0.0, low=0.0)
    """Steps of a distance, m; 0 for none."""
    dropout: float = setting(default=0.0, low=0.0, high=1.0)
    """Probability that a ray has no return, 0 to 1."""
    name: str = "lidar"

    def __post_init__(self) -> None:
        super().__post_init__()
        if {"depth", *COLORS, *FLOWS} & {*self.outputs}:
            raise ConfigError(
                "expected outputs of a lidar without 'depth', since it has no axis, colours and flow. Use 'distance'."
            )
        if 0 in self.image_size:
            raise ConfigError(f"expected at least one elevation and azimuth, got {self.image_size} of them")

    @classmethod
    def vlp16(cls, columns: int = 360, **settings: Any) -> Lidar:
        """Return a Velodyne VLP-16: 16 rows from 15 to -15 degrees, 100 m, with its noise of 3 cm.

        Args:
            columns: Rays of a row in a revolution; the sensor has 900 to 3600.
            **settings: Other settings; the sensor rotates at ``freq`` of 5 to 20 Hz.
        """
        azimuth = 180 - 360 * (np.arange(columns) + 0.5) / columns
        defaults: dict[str, Any] = {"max_range": VLP16_RANGE, "noise": VLP16_NOISE, "resolution": VLP16_RESOLUTION}
        return cls(VLP16_ELEVATIONS, azimuth, **defaults | settings)

    @classmethod
    def vl53l5cx(cls, **settings: Any) -> Lidar:
        """Return a VL53L5CX, a solid-state sensor of 8 x 8 zones over 45 degrees, 4 m.

        Each zone has one ray, in its middle; zones have equal angles, an assumption. The noise depends on light and
        reflectance: set ``noise`` and ``relative_noise``.
        """
        n, fov = VL53L5CX_ZONES, VL53L5CX_FOV
        angle = fov / 2 - fov * (np.arange(n) + 0.5) / n
        defaults: dict[str, Any] = {"max_range": VL53L5CX_RANGE}
        return cls(angle, angle, **defaults | settings)

    @property
    def image_size(self) -> tuple[int, int]:
        return np.size(self.elevation), np.size(self.azimuth)

    @property
    def rays(self) -> np.ndarray:
        elevation, azimuth = np.meshgrid(np.radians(self.elevation), np.radians(self.azimuth), indexing="ij")
        cos_elevation = np.cos(elevation)
        return np.stack([cos_elevation * np.cos(azimuth), cos_elevation * np.sin(azimuth), np.sin(elevation)], axis=-1)

    @property
    def optics(self) -> dict[str, Any]:
        return {name: np.asarray(getattr(self, name), float).tolist() for name in ("elevation", "azimuth")}

    @property
    def far(self) -> float:
        return float(self.max_range)

    @property
    def has_errors(self) -> bool:
        return any((self.noise, self.relative_noise, self.resolution, self.dropout, self.min_range))

    def measure(self, distance: Array, is_hidden: Array | None, key: Array) -> Array:
        del is_hidden
        deviation = self.noise + self.relative_noise * distance
        measured_distance = distance + deviation * normal(key, distance.shape, distance.dtype)
        if self.resolution:
            measured_distance = quantise(measured_distance, jnp.asarray(self.resolution, distance.dtype))
        has_return = (distance < self.max_range) & (distance >= self.min_range)
        if self.dropout:
            random_numbers = uniform(jax.random.fold_in(key, 1), distance.shape, distance.dtype)
            has_return &= random_numbers >= self.dropout
        return jnp.where(has_return, jnp.clip(measured_distance, 0.0, self.max_range), self.max_range)
