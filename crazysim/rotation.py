"""Rotations as unit quaternions, xyzw, body to world, with finite gradients everywhere.

Small products are unrolled: matrix products of this size are slow on every device, and sums of
products fuse.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax


def dot(a: Array, b: Array) -> Array:
    """Return the scalar product over the last axis. (..., n) -> (..., 1)"""
    return jnp.sum(a * b, axis=-1, keepdims=True)


def cross(a: Array, b: Array) -> Array:
    """Return the vector product. (..., 3)"""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def cross_matrix(a: Array) -> Array:
    """Return the matrix of the cross product with a vector, ``cross_matrix(a) @ b = a x b``. (..., 3, 3)"""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    zero = jnp.zeros_like(x)
    return jnp.stack([jnp.stack(row, axis=-1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))], axis=-2)


def along_z(value: Array) -> Array:
    """Return the vectors along z with these values. (...) -> (..., 3)"""
    zero = jnp.zeros_like(value)
    return jnp.stack([zero, zero, value], axis=-1)


def add_cross(offset: Array, a: Array, b: Array) -> Array:
    """Return ``offset + a x b``, computed by six multiply-adds. (..., 3)"""
    x, y, z = offset[..., 0], offset[..., 1], offset[..., 2]
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return jnp.stack([x + ay * bz - az * by, y + az * bx - ax * bz, z + ax * by - ay * bx], axis=-1)


def matvec(matrix: Array, vector: Array, offset: Array | None = None) -> Array:
    """Return ``matrix @ vector + offset`` for small arrays, column by column. (..., m)

    Args:
        matrix: (..., m, n)
        vector: (..., n)
        offset: First summand; None for zero. (..., m)
    """
    columns = (matrix[..., :, k] * vector[..., k : k + 1] for k in range(matrix.shape[-1]))
    initial: Any = 0 if offset is None else offset
    return sum(columns, initial)


@jax.custom_jvp
def safe_sqrt(x: Array) -> Array:
    """Return the square root of positive values, and zero with gradient zero for others; NaN stays NaN. (...)"""
    return jnp.sqrt(jnp.maximum(x, 0.0))


@safe_sqrt.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (x_dot,) = primals, tangents
    root = safe_sqrt(x)
    is_positive = ~(x <= 0)
    return root, jnp.where(is_positive, 0.5 / jnp.where(is_positive, root, 1.0), 0.0) * x_dot


def safe_norm(x: Array) -> Array:
    """Return the Euclidean norm over the last axis, with gradient zero at zero. (..., 1)"""
    return safe_sqrt(dot(x, x))


def safe_normalize(x: Array, fallback: Array) -> Array:
    """Return ``x`` scaled to length one, or ``fallback`` where ``x`` is zero. (..., n)"""
    norm = safe_norm(x)
    is_zero = norm == 0
    return jnp.where(is_zero, fallback, x / jnp.where(is_zero, 1.0, norm))


def clip(x: Array, low: Array | float, high: Array | float) -> Array:
    """Return ``x`` clipped to limits, with gradient one at the limits, as between them. (...)

    The gradient of ``jnp.clip`` at a limit is one half, the slope of neither side.
    """
    raised = jnp.where(x < low, low, x)
    return jnp.where(raised > high, high, raised)


def safe_arctan2(y: Array, x: Array) -> Array:
    """Return the angle of the point (x, y), rad, zero with gradient zero at the origin. (...)

    A point close to the origin, with a squared distance that underflows to zero, is treated as the origin: the gradient
    divides by the squared distance.
    """
    is_origin = x * x + y * y == 0
    return jnp.where(is_origin, 0.0, jnp.arctan2(y, jnp.where(is_origin, 1.0, x)))


def multiply(p: Array, q: Array) -> Array:
    """Return the quaternion of the rotation ``q`` followed by ``p``. (..., 4)"""
    px, py, pz, pw = p[..., 0], p[..., 1], p[..., 2], p[..., 3]
    qx, qy, qz, qw = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return jnp.stack(
        [
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
            pw * qw - px * qx - py * qy - pz * qz,
        ],
        axis=-1,
    )


def conjugate(q: Array) -> Array:
    """Return the inverse of a unit quaternion. (..., 4)"""
    return jnp.concatenate([-q[..., :3], q[..., 3:]], axis=-1)


def matrix(q: Array) -> Array:
    """Return the rotation matrix of a unit quaternion, body to world. (..., 3, 3)"""
    x, y, z, w = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    x2, y2, z2 = 2 * x, 2 * y, 2 * z
    wx, wy, wz, xx, yy, zz = w * x2, w * y2, w * z2, x * x2, y * y2, z * z2
    rows = [
        [1 - yy - zz, x * y2 - wz, x * z2 + wy],
        [x * y2 + wz, 1 - xx - zz, y * z2 - wx],
        [x * z2 - wy, y * z2 + wx, 1 - xx - yy],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def rotate(q: Array, v: Array, offset: Array | None = None) -> Array:
    """Return a body vector in the world frame, ``R(q) v``, plus an offset. (..., 3)"""
    return matvec(matrix(q), v, offset)


def rotate_inverse(q: Array, v: Array, offset: Array | None = None) -> Array:
    """Return a world vector in the body frame, ``R(q)^T v``, plus an offset. (..., 3)"""
    return matvec(jnp.swapaxes(matrix(q), -1, -2), v, offset)


def z_axis(q: Array) -> Array:
    """Return the body z axis in the world frame. (..., 3)"""
    return matrix(q)[..., 2]


def integrate_attitude(q: Array, ang_vel: Array, dt: float, normalize: bool = True) -> Array:
    """Return the attitude after a rotation with constant angular velocity, by at most half a turn. (..., 4)

    Up to rounding, the result is ``q (sin(h) ang_vel / |ang_vel|, cos(h))`` with half the angle,
    ``h = |ang_vel| dt / 2``. ``jnp.sin`` and ``jnp.cos`` would cost more than the rest of a physics step. A normalised
    result needs only the ratio of sine to cosine. This is the ratio of imaginary to real part of the numerator of the
    Pade approximation of ``exp(2ih)``. Without normalisation, Taylor polynomials replace sine and cosine.

    Args:
        q: Attitude, body to world, unit, xyzw. (..., 4)
        ang_vel: Angular velocity, body frame, rad/s. (..., 3)
        dt: Duration, s.
        normalize: Whether to scale the result to unit length, which keeps rounding errors from accumulating. Attitudes
            at intermediate points of a Runge-Kutta step do not need it.
    """
    is_float32 = ang_vel.dtype == jnp.float32
    if normalize:
        order = 6 if is_float32 else 11
        coefficients = [2**n * math.comb(order, n) / math.perm(2 * order, n) for n in range(order + 1)]
    else:
        coefficients = [1 / math.factorial(n) for n in range(14 if is_float32 else 22)]
    signed_coefficients = [(-1) ** (n // 2) * c * (dt / 2) ** n for n, c in enumerate(coefficients)]
    square = dot(ang_vel, ang_vel)
    vector = _polynomial(square, signed_coefficients[1::2]) * ang_vel
    increment = jnp.concatenate([vector, _polynomial(square, signed_coefficients[::2])], axis=-1)
    product = multiply(q, increment)
    return product * lax.rsqrt(dot(product, product)) if normalize else product


def _polynomial(x: Array, coefficients: list[float]) -> Array:
    value = jnp.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):  # Horner's scheme: one multiply-add per coefficient
        value = value * x + coefficient
    return value


def from_rpy(rpy: Array) -> Array:
    """Return the quaternion of ``Rz(yaw) Ry(pitch) Rx(roll)``, angles in rad. (..., 3) -> (..., 4)"""
    half = 0.5 * rpy
    c, s = jnp.cos(half), jnp.sin(half)
    cr, cp, cy = c[..., 0], c[..., 1], c[..., 2]
    sr, sp, sy = s[..., 0], s[..., 1], s[..., 2]
    return jnp.stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ],
        axis=-1,
    )


def to_rpy(q: Array) -> Array:
    """Return roll, pitch, yaw in rad, pitch in [-pi/2, pi/2]. (..., 4) -> (..., 3)

    Roll and yaw are computed from half their sum and half their difference (Bernardes and Viollet 2022). At any pitch,
    at least one of these two angles is well-defined, so :func:`from_rpy` returns the same rotation. At a pitch of 90
    degrees, roll and yaw are not unique, and the angle that is not well-defined is set to zero.
    """
    x, y, z, w = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    half_sum, half_difference = safe_arctan2(z + x, w - y), safe_arctan2(z - x, w + y)
    r00, r10 = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z)
    cos_pitch = safe_norm(jnp.stack([r00, r10], axis=-1))[..., 0]
    pitch = jnp.arctan2(2 * (w * y - x * z), cos_pitch)
    return jnp.stack([_wrap_angle(half_sum - half_difference), pitch, _wrap_angle(half_sum + half_difference)], axis=-1)


def _wrap_angle(angle: Array) -> Array:
    return angle - 2 * jnp.pi * ((angle > jnp.pi).astype(angle.dtype) - (angle < -jnp.pi).astype(angle.dtype))


def yaw(q: Array) -> Array:
    """Return the yaw angle of a quaternion of any length, rad; zero for the zero quaternion. (...)"""
    x, y, z, w = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return safe_arctan2(2 * (x * y + w * z), x * x + w * w - y * y - z * z)


def heading(q: Array) -> tuple[Array, Array]:
    """Return the horizontal unit vectors along the yaw of a quaternion of any length, and to the left. (..., 3) each

    They are computed without an angle. For a quaternion shorter than 1e-6, or exactly at a pitch of 90 degrees, they
    are the vectors of yaw zero.
    """
    x, y, z, w = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    projection = jnp.stack([x * x + w * w - y * y - z * z, 2 * (x * y + w * z)], axis=-1)
    square = dot(projection, projection)
    is_zero = square < 1e-24  # the gradient divides by ``square ** 1.5``
    inverse = 1 / jnp.sqrt(jnp.where(is_zero, 1.0, square))
    projection = jnp.where(is_zero, jnp.asarray([1.0, 0.0], q.dtype), projection * inverse)
    cos, sin, zero = projection[..., 0], projection[..., 1], jnp.zeros_like(x)
    return jnp.stack([cos, sin, zero], axis=-1), jnp.stack([-sin, cos, zero], axis=-1)


def heading_axes(yaw: Array) -> tuple[Array, Array]:
    """Return the horizontal unit vectors along a yaw angle, and to the left of it. (..., 3) each

    Args:
        yaw: Yaw, rad. (..., 1)
    """
    cos, sin, zero = jnp.cos(yaw), jnp.sin(yaw), jnp.zeros_like(yaw)
    return jnp.concatenate([cos, sin, zero], axis=-1), jnp.concatenate([-sin, cos, zero], axis=-1)


def axes_from_z(z: Array, forward: Array, left: Array) -> tuple[Array, Array, Array]:
    """Return unit axes x, y, z of the frame with z along a vector and x in the plane of z and a heading. (..., 3) each

    Args:
        z: Vector of any length; zero is replaced by up. (..., 3)
        forward: Horizontal unit vector of the heading. (..., 3)
        left: Horizontal unit vector to its left, the y axis where z is along the heading. (..., 3)
    """
    z = safe_normalize(z, jnp.asarray([0.0, 0.0, 1.0], z.dtype))
    y = safe_normalize(cross(z, forward), left)
    return cross(y, z), y, z


def rpy_from_axes(x: Array, y: Array, z: Array) -> Array:
    """Return roll, pitch, yaw of the frame with these orthonormal axes in the world frame, rad. (..., 3)"""
    cos_pitch = safe_norm(jnp.stack([x[..., 0], x[..., 1]], axis=-1))[..., 0]
    return jnp.stack(
        [
            safe_arctan2(y[..., 2], z[..., 2]),
            jnp.arctan2(-x[..., 2], cos_pitch),
            safe_arctan2(x[..., 1], x[..., 0]),
        ],
        axis=-1,
    )


def quat_from_axes(x: Array, y: Array, z: Array) -> Array:
    """Return the quaternion of the frame with these orthonormal axes in the world frame. (..., 3) -> (..., 4)

    The four products ``4 q_i q``, ``by_x`` to ``by_w``, are linear in the axes. A product with ``q_i^2 >= 1 / 4`` is
    scaled to length one, so that there is no division by small numbers, and value and gradient are accurate at every
    attitude. The sign of the quaternion is arbitrary.
    """
    xx, yy, zz = x[..., 0], y[..., 1], z[..., 2]
    xy, xz, yz = x[..., 1] + y[..., 0], x[..., 2] + z[..., 0], y[..., 2] + z[..., 1]
    wx, wy, wz = y[..., 2] - z[..., 1], z[..., 0] - x[..., 2], x[..., 1] - y[..., 0]
    by_x = jnp.stack([1 + xx - yy - zz, xy, xz, wx], axis=-1)
    by_y = jnp.stack([xy, 1 - xx + yy - zz, yz, wy], axis=-1)
    by_z = jnp.stack([xz, yz, 1 - xx - yy + zz, wz], axis=-1)
    by_w = jnp.stack([wx, wy, wz, 1 + xx + yy + zz], axis=-1)
    x_or_y = jnp.where((xx > yy)[..., None], by_x, by_y)
    z_or_w = jnp.where((xx + yy < 0)[..., None], by_z, by_w)
    product = jnp.where((zz < 0)[..., None], x_or_y, z_or_w)
    return product * lax.rsqrt(dot(product, product))
