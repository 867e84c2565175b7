"""Attitudes on the host, in float64; quaternions are xyzw."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray


def rotate(quat: NDArray, vec: NDArray) -> NDArray:
    """Return vectors turned by unit quaternions, xyzw. (..., 3)"""
    axis, w = quat[..., :3], quat[..., 3:]
    double_cross = 2 * _cross(axis, vec)
    return vec + w * double_cross + _cross(axis, double_cross)


def _cross(a: NDArray, b: NDArray) -> NDArray:
    return a.take(_NEXT_AXIS, -1) * b.take(_SECOND_NEXT_AXIS, -1) - a.take(_SECOND_NEXT_AXIS, -1) * b.take(
        _NEXT_AXIS, -1
    )


_NEXT_AXIS, _SECOND_NEXT_AXIS = np.array([1, 2, 0]), np.array([2, 0, 1])


def multiply(p: NDArray, q: NDArray) -> NDArray:
    """Return products of quaternions, xyzw: turn by ``q``, then by ``p``. (..., 4)"""
    pv, pw, qv, qw = p[..., :3], p[..., 3:], q[..., :3], q[..., 3:]
    vector = pw * qv + qw * pv + _cross(pv, qv)
    return np.concatenate([vector, pw * qw - (pv * qv).sum(-1, keepdims=True)], axis=-1)


def from_rpy(rpy: ArrayLike) -> NDArray:
    """Return quaternions, xyzw, of roll, pitch and yaw, rad. (..., 4)"""
    half_angles = np.asarray(rpy, float) / 2
    (sr, sp, sy), (cr, cp, cy) = (np.moveaxis(f(half_angles), -1, 0) for f in (np.sin, np.cos))
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
    """Return roll, pitch and yaw, rad, of unit quaternions, xyzw. (..., 3)

    As :func:`crazysim.rotation.to_rpy`, which explains the formula.
    """
    x, y, z, w = np.moveaxis(np.asarray(quat, float), -1, 0)
    half_sum, half_difference = np.arctan2(z + x, w - y), np.arctan2(z - x, w + y)
    cos_pitch = np.hypot(1 - 2 * (y * y + z * z), 2 * (x * y + w * z))
    pitch = np.arctan2(2 * (w * y - x * z), cos_pitch)
    roll, yaw = (np.angle(np.exp(1j * angle)) for angle in (half_sum - half_difference, half_sum + half_difference))
    return np.stack([roll, pitch, yaw], axis=-1)


def from_yaw(yaw: float) -> NDArray:
    """Return the quaternion, xyzw, of a level body with a yaw, rad. (4,)"""
    return np.array([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)])


def yaw_from_quat(quat: NDArray) -> float:
    """Return the yaw of a unit quaternion, xyzw, rad."""
    x, y, z, w = quat
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def decompress_quat(packed: NDArray) -> NDArray:
    """Return the quaternions in 32 bits of Bitcraze's quatcompress.h, xyzw. (n,) -> (n, 4)

    The lowest 30 bits hold the three smaller components, the last of them in the lowest bits. Each component takes nine
    bits for its magnitude, in units of 1 / (511 sqrt(2)), and above them a bit that is set if it is negative. The
    highest two bits hold the index of the largest component.
    """
    largest, quat = packed >> 30, np.zeros((len(packed), 4))
    for k in (3, 2, 1, 0):
        is_small = largest != k
        size = (packed & 511) / 511 * np.sqrt(0.5)
        quat[:, k] = np.where(is_small, np.where(packed & 512, -size, size), 0.0)
        packed = np.where(is_small, packed >> 10, packed)
    largest_value = np.sqrt(np.clip(1 - np.sum(quat**2, axis=1), 0, 1))
    quat[np.arange(len(quat)), largest] = largest_value
    return quat
