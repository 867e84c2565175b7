"""Frames of motion capture, and the conventions in which systems send them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.errors import ConfigError


@dataclass(frozen=True, eq=False)
class Frame:
    """Poses of all bodies that a motion capture system has measured at one time."""

    stamp: float
    """Time of the measurement, clock of the source, s."""
    names: tuple[str, ...]
    """Names of the bodies, as the source sends them."""
    pos: NDArray
    """Positions, world frame, m. (n, 3)"""
    quat: NDArray
    """Attitudes, body to world, xyzw. (n, 4)"""
    received: float = 0.0
    """Time of arrival, clock of this computer (``time.monotonic``), s."""

    @staticmethod
    def of(stamp: float, bodies: dict[str, tuple[Any, Any]], received: float | None = None) -> Frame:
        """Return a frame of bodies by name, each with its position, m, and attitude, xyzw.

        Args:
            stamp: Time of the measurement, s.
            bodies: Position and attitude of each body.
            received: Time of arrival, s; None for ``stamp``.

        Raises:
            ConfigError: If a pose has a wrong shape.
        """
        try:
            pos = np.array([p for p, _ in bodies.values()], float).reshape(len(bodies), 3)
            quat = np.array([q for _, q in bodies.values()], float).reshape(len(bodies), 4)
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"expected a position of 3 and an attitude of 4 numbers for each body, got {error}. Use "
                f"{{'cf1': ((x, y, z), (qx, qy, qz, qw))}}."
            ) from None
        return Frame(float(stamp), tuple(bodies), pos, quat, float(stamp if received is None else received))


@dataclass(frozen=True)
class Convention:
    """Axes, order of quaternions and unit of length of a motion capture system.

    The world frame of crazysim has z up, its quaternions are xyzw and its lengths are in metres. With y up, the axes x,
    y, z of the source are the axes x, z, -y of the world, which turns positions and attitudes by 90 degrees about x.
    """

    up: str = "z"
    """Axis that points up: ``"y"`` or ``"z"``."""
    quat: str = "xyzw"
    """Order of the components of quaternions: ``"xyzw"`` or ``"wxyz"``."""
    unit: float = 1.0
    """Length of the unit of positions, m; 0.001 for millimetres."""

    def __post_init__(self) -> None:
        if self.up not in ("y", "z") or self.quat not in ("xyzw", "wxyz") or not 0 < self.unit < np.inf:
            raise ConfigError(
                f"expected up as 'y' or 'z', quat as 'xyzw' or 'wxyz' and a positive unit, got {self.up!r}, "
                f"{self.quat!r} and {self.unit!r}. Use Convention('y', 'xyzw', 0.001) for millimetres with y up, for "
                f"example."
            )

    def to_world(self, pos: ArrayLike, quat: ArrayLike) -> tuple[NDArray, NDArray]:
        """Return positions, m (..., 3), and attitudes, xyzw (..., 4), in the world frame, of poses of the source."""
        pos, quat = np.asarray(pos, float) * self.unit, np.asarray(quat, float)
        if self.quat == "wxyz":
            quat = quat[..., [1, 2, 3, 0]]
        if self.up == "y":
            pos = pos[..., [0, 2, 1]] * (1, -1, 1)
            quat = quat[..., [0, 2, 1, 3]] * (1, -1, 1, 1)
        return pos, quat

    def from_world(self, pos: ArrayLike, quat: ArrayLike) -> tuple[NDArray, NDArray]:
        """Return positions (..., 3) and attitudes (..., 4) as the source sends them; the inverse of ``to_world``."""
        pos, quat = np.asarray(pos, float) / self.unit, np.asarray(quat, float)
        if self.up == "y":
            pos = pos[..., [0, 2, 1]] * (1, 1, -1)
            quat = quat[..., [0, 2, 1, 3]] * (1, 1, -1, 1)
        if self.quat == "wxyz":
            quat = quat[..., [3, 0, 1, 2]]
        return pos, quat

    def convert(self, frame: Frame) -> Frame:
        """Return a frame of the source in the world frame of crazysim."""
        if self == Convention():
            return frame
        pos, quat = self.to_world(frame.pos, frame.quat)
        return replace(frame, pos=pos, quat=quat)


def rotate(quat: NDArray, vec: NDArray) -> NDArray:
    """Return vectors turned by unit quaternions, xyzw; on the host, in float64. (..., 3)"""
    axis, w = quat[..., :3], quat[..., 3:]
    twice = 2 * _cross(axis, vec)
    return vec + w * twice + _cross(axis, twice)


def _cross(a: NDArray, b: NDArray) -> NDArray:
    """Return cross products; ``np.cross`` takes five times as long for a few vectors. (..., 3)"""
    return a.take(_NEXT, -1) * b.take(_AFTER, -1) - a.take(_AFTER, -1) * b.take(_NEXT, -1)


_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])


def multiply(p: NDArray, q: NDArray) -> NDArray:
    """Return products of quaternions, xyzw: turn by ``q``, then by ``p``; on the host, in float64. (..., 4)"""
    pv, pw, qv, qw = p[..., :3], p[..., 3:], q[..., :3], q[..., 3:]
    vector = pw * qv + qw * pv + _cross(pv, qv)
    return np.concatenate([vector, pw * qw - (pv * qv).sum(-1, keepdims=True)], axis=-1)


def from_rpy(rpy: ArrayLike) -> NDArray:
    """Return quaternions, xyzw, of roll, pitch and yaw, rad; on the host, in float64. (..., 4)"""
    half = np.asarray(rpy, float) / 2
    (sr, sp, sy), (cr, cp, cy) = (np.moveaxis(f(half), -1, 0) for f in (np.sin, np.cos))
    return np.stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ],
        axis=-1,
    )


def to_rpy(quat: NDArray) -> NDArray:
    """Return roll, pitch and yaw, rad, of unit quaternions, xyzw; on the host, in float64. (..., 3)

    As :func:`crazysim.rotation.to_rpy`, which explains the formula.
    """
    x, y, z, w = np.moveaxis(np.asarray(quat, float), -1, 0)
    half_sum, half_difference = np.arctan2(z + x, w - y), np.arctan2(z - x, w + y)
    cos_pitch = np.hypot(1 - 2 * (y * y + z * z), 2 * (x * y + w * z))
    pitch = np.arctan2(2 * (w * y - x * z), cos_pitch)
    roll, yaw = (np.angle(np.exp(1j * angle)) for angle in (half_sum - half_difference, half_sum + half_difference))
    return np.stack([roll, pitch, yaw], axis=-1)
