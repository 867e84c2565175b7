"""Errors of real depth cameras: noise of stereo matching, occlusion, and distortion of the lens."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.random import normal
from crazysim.core.settings import check_settings, setting
from crazysim.errors import ConfigError
from crazysim.plugins.sensors.errors import quantise

D435_WIDTH, D435_HFOV = 848, 90.0
"""Image width at which a RealSense D435 measures best, pixels; its horizontal field of view, degrees (Intel, *Subpixel
Linearity Improvement for Intel RealSense Depth Camera D400 Series*, revision 1.3)."""
D435_BASELINE = 0.05
"""Distance between the imagers of a D435, m (extrinsics that a D435 reports: 0.05003; orb_slam_2_ros issue 46)."""
D435_DISPARITY_NOISE = 0.08
"""Error of a matched disparity, pixels: "it is best to use about 0.08" (A. Grunnet-Jepsen of Intel, librealsense issue
3904)."""
D435_MIN_DEPTH = 0.17
"""Smallest depth of a D435 at 848 x 480 pixels, m (A. Grunnet-Jepsen of Intel, librealsense issue 999)."""
D435_RESOLUTION = 1e-3
"""Steps in which a D400 camera reports depth by default, m (librealsense issue 999: 1000 um)."""

N_NEWTON_STEPS = 30
"""Number of Newton steps that invert a distortion."""


@dataclasses.dataclass(frozen=True)
class StereoNoise:
    """Errors of a camera that measures depth by stereo matching.

    A disparity of ``d = f b / z`` pixels is matched with an error of ``disparity_noise`` pixels, so that the depth has
    the standard deviation ``z^2 / (f b) * disparity_noise`` (Intel, *Tuning depth cameras for best performance*).
    Points that nearer objects hide from the second imager, which is on the right, have no depth: a second ray to each
    point finds them.
    """

    focal: float = setting(default=D435_WIDTH / 2 / np.tan(np.radians(D435_HFOV / 2)), positive=True)
    """Focal length f of the images that are matched, pixels. They may be finer than the returned images."""
    baseline: float = setting(default=D435_BASELINE, positive=True)
    """Distance b between the imagers, m."""
    disparity_noise: float = setting(default=D435_DISPARITY_NOISE, low=0.0)
    """Standard deviation of a matched disparity, pixels."""
    min_depth: float = setting(default=D435_MIN_DEPTH, low=0.0)
    """Smallest depth that is measured, m; nearer pixels are holes."""
    resolution: float = setting(default=D435_RESOLUTION, low=0.0)
    """Steps of the depth, m; 0 for none."""
    has_holes: bool = True
    """True for holes behind the edges of nearer objects."""

    def __post_init__(self) -> None:
        check_settings(self)

    def apply(self, depth: Array, is_hidden: Array | None, key: Array) -> Array:
        """Return depths as they are measured, m, 0 in holes. (height, width)

        Args:
            depth: True depths, m, finite. (height, width)
            is_hidden: True where the second imager does not see the point; None for nowhere. (height, width)
        """
        deviation = depth**2 * (self.disparity_noise / (self.focal * self.baseline))
        measured_depth = depth + deviation * normal(key, depth.shape, depth.dtype)
        measured_depth = (
            quantise(measured_depth, jnp.asarray(self.resolution, depth.dtype)) if self.resolution else measured_depth
        )
        is_hole = depth < self.min_depth
        if self.has_holes and is_hidden is not None:
            is_hole |= is_hidden
        return jnp.where(is_hole, 0.0, measured_depth)


@dataclasses.dataclass(frozen=True)
class Distortion:
    """Radial and tangential distortion of a lens, with the coefficients of OpenCV (Brown, Conrady).

    With x to the right, y down and r^2 = x^2 + y^2 at distance 1 in front of the camera, a point appears at
    ``x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)`` and
    ``y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y`` times the focal length.
    """

    k1: float = 0.0
    """Radial coefficient of r^2, 1."""
    k2: float = 0.0
    """Radial coefficient of r^4, 1."""
    p1: float = 0.0
    """Tangential coefficient, 1."""
    p2: float = 0.0
    """Tangential coefficient, 1."""
    k3: float = 0.0
    """Radial coefficient of r^6, 1."""

    def __post_init__(self) -> None:
        check_settings(self)

    def distort(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distort points at distance 1 to image positions, in units of the focal length. (...) each"""
        r2 = x**2 + y**2
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        return (
            x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x**2),
            y * radial + self.p1 * (r2 + 2 * y**2) + 2 * self.p2 * x * y,
        )

    def undistort(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find the points at distance 1 that have image positions, the inverse of ``distort``. (...) each"""
        # (u, v) is the point, (a, b) its image position, and xx, xy, yy are the derivatives at the point.
        u, v = x.copy(), y.copy()
        with np.errstate(all="ignore"):
            for _ in range(N_NEWTON_STEPS):
                (a, b), (xx, xy, yy) = self.distort(u, v), self._slopes(u, v)
                det = xx * yy - xy**2
                u, v = u - (yy * (a - x) - xy * (b - y)) / det, v - (xx * (b - y) - xy * (a - x)) / det
            (a, b), (xx, xy, yy) = self.distort(u, v), self._slopes(u, v)
            is_inverse = (np.hypot(a - x, b - y) < 1e-9) & (xx * yy - xy**2 > 0) & (xx + yy > 0)
        if not np.all(is_inverse):
            raise ConfigError(
                f"expected a distortion that maps the field of view one to one, got {self}, which folds the image at "
                f"{int(np.sum(~is_inverse))} of {x.size} pixels. Use a smaller fovy=, or the coefficients of this lens."
            )
        return u, v

    def _slopes(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        r2 = x**2 + y**2
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        slope = 2 * (self.k1 + r2 * (2 * self.k2 + r2 * 3 * self.k3))
        return (
            radial + x**2 * slope + 2 * self.p1 * y + 6 * self.p2 * x,
            x * y * slope + 2 * self.p1 * x + 2 * self.p2 * y,
            radial + y**2 * slope + 6 * self.p1 * y + 2 * self.p2 * x,
        )
