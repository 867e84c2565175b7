"""Extended Kalman filters with error states, as functions of one drone.

The equations, constants and guards follow the Crazyflie's firmware (kalman_core.c and the mm_*.c of
bitcraze/crazyflie-firmware, commit 2a18fc29), which is based on M. W. Mueller, M. Hamer and R. D'Andrea, Fusing
ultra-wideband range measurements with accelerometers and rate gyroscopes for quadrocopter state estimation, ICRA 2015,
and M. W. Mueller, M. Hehn and R. D'Andrea, Covariance correction step for Kalman filtering with an attitude, Journal of
Guidance, Control, and Dynamics 40 (2017). The drag that the firmware can model is zero on Crazyflies, and is left out.
An estimate may also contain the biases of the inertial sensors, which ``predict_biased`` and all updates use: the
filter of J. Solà, Quaternion kinematics for the error-state Kalman filter (2017, arXiv 1711.02508), with velocities in
the body frame.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.engine.pytree import PyTree, leaf

POS, VEL, ATT, GYRO = (0, 1, 2), (3, 4, 5), (6, 7, 8), (12, 13, 14)
"""Rows of the errors of position, velocity, attitude and the bias of the gyroscope."""
N, N_BIASED = 9, 15
"""Number of error states without biases, and with the biases of accelerometer and gyroscope, in this order."""
MAX_COVARIANCE, MIN_VARIANCE = 100.0, {N: 1e-6, N_BIASED: 1e-12}
"""Upper bound of covariances, and lower bound of variances by the number of errors. They are from kalman_core.c, except
that the lower bound with biases is an assumption, since the variances of biases are smaller."""
NORM_EPSILON = 1e-6
"""Number that is added to a norm before a division by it (kalman_core.c)."""
MAX_POS, MAX_VEL = 100.0, 10.0
"""Bounds of coordinates, m, and of velocities, body frame, m/s, beyond which the filter has failed
(kalman_supervisor.c)."""
SMALL_ANGLE, LARGE_ANGLE = 1e-4, 10.0
"""Smallest and largest attitude error that is moved into the attitude, rad (kalman_core.c)."""
REVERSION_FRACTION = 0.001
"""Fraction of the initial attitude that a prediction on the ground mixes in (kalman_core_params_defaults.h)."""


class Estimate(PyTree):
    """Estimate of one drone with its uncertainty."""

    pos: Array = leaf("drone", 1)
    """Position, world frame, m. (..., 3)"""
    vel: Array = leaf("drone", 1)
    """Velocity, body frame, m/s. (..., 3)"""
    quat: Array = leaf("drone", 1)
    """Attitude, body to world, xyzw. (..., 4)"""
    att_error: Array = leaf("drone", 1)
    """Attitude error that ``finalize`` moves into the attitude, body frame, rad. (..., 3)"""
    cov: Array = leaf("drone", 1)
    """Covariance of the n errors of position, velocity, attitude and biases: its upper triangle, row by row.
    (..., n (n + 1) / 2)"""
    accel_bias: Array | None = leaf("drone", 1)
    """Bias of the accelerometer, body frame, m/s^2; None if it is not estimated. (..., 3)"""
    gyro_bias: Array | None = leaf("drone", 1)
    """Bias of the gyroscope, body frame, rad/s; None if it is not estimated. (..., 3)"""


def covariance(upper: Array) -> Array:
    """Return the covariance (..., n, n) from its upper triangle, row by row, (..., n (n + 1) / 2)."""
    n = _n_errors(upper)
    # Unsigned, because JAX 0.10 adds the axis size to signed indices, with an integer type that depends on whether
    # float32 or float64 was indexed first.
    index = np.zeros((n, n), np.uint32)
    index[_upper_triangle(n)] = np.arange(upper.shape[-1])
    return upper[..., np.maximum(index, index.T)]


def initial_estimate(
    pos: Array,
    vel: Array,
    quat: Array,
    deviations: Sequence[Array | float],
    accel_bias: Array | None = None,
    gyro_bias: Array | None = None,
) -> Estimate:
    """Return an estimate with independent errors.

    Args:
        pos: Position, world frame, m. (3,)
        vel: Velocity, body frame, m/s. (3,)
        quat: Attitude, body to world, unit, xyzw. (4,)
        deviations: Standard deviations of the errors of position, velocity and attitude, m, m/s, rad, then of the
            biases, m/s^2, rad/s. (9,) or (15,)
        accel_bias: Bias of the accelerometer, body frame, m/s^2; None to estimate none. (3,)
        gyro_bias: Bias of the gyroscope, body frame, rad/s; None to estimate none. (3,)
    """
    variance = jnp.stack([jnp.asarray(d, pos.dtype) ** 2 for d in deviations])
    cov = jnp.diag(variance)[_upper_triangle(len(deviations))]
    return Estimate(pos, vel, quat, jnp.zeros_like(vel), cov, accel_bias, gyro_bias)


def predict(
    estimate: Estimate, accel: Array, gyro: Array, dt: float, resting_quat: Array | None = None, all_axes: bool = False
) -> Estimate:
    """Return the estimate after an interval, without process noise; ``add_noise`` also bounds the variances.

    Args:
        accel: Specific force, body frame, m/s^2. (3,)
        gyro: Angular velocity, body frame, rad/s. (3,)
        dt: Length of the interval, s.
        resting_quat: Attitude that is mixed into the attitude of a drone on the ground; None in flight. (4,)
        all_axes: True to use the force along all axes in flight; False to use only the force along the z axis of the
            body, as the firmware does, because rotors can generate no other force.
    """
    pos, vel, quat = estimate.pos, estimate.vel, estimate.quat
    rot, identity, angle = rotation.matrix(quat), jnp.eye(3, dtype=pos.dtype), dt * gyro
    gravity = GRAVITY_MAGNITUDE * rot[2]  # in the body frame

    # The linearised step: rows of the errors of position, velocity and attitude.
    vel_to_pos = dt * rot
    att_to_pos = -vel_to_pos @ rotation.cross_matrix(vel)
    vel_to_vel = identity - rotation.cross_matrix(angle)
    att_to_vel = -dt * rotation.cross_matrix(gravity)
    error_rot = _error_rotation(0.5 * angle)
    p = covariance(estimate.cov)
    pos_rows = p[:3] + vel_to_pos @ p[3:6] + att_to_pos @ p[6:]
    vel_rows = vel_to_vel @ p[3:6] + att_to_vel @ p[6:]
    rows = jnp.concatenate([pos_rows, vel_rows, error_rot @ p[6:]])
    pos_columns = rows[:, :3] + rows[:, 3:6] @ vel_to_pos.T + rows[:, 6:] @ att_to_pos.T
    vel_columns = rows[:, 3:6] @ vel_to_vel.T + rows[:, 6:] @ att_to_vel.T
    p = jnp.concatenate([pos_columns, vel_columns, rows[:, 6:] @ error_rot.T], axis=1)

    force = rotation.along_z(accel[2]) if resting_quat is None and not all_axes else accel
    shift = dt * vel + 0.5 * dt**2 * force
    pos = rotation.matvec(rot, shift, pos) - jnp.asarray([0.0, 0.0, 0.5 * GRAVITY_MAGNITUDE * dt**2], pos.dtype)
    new_vel = vel + dt * (force - rotation.cross(gyro, vel) - gravity)
    upper = p[_upper_triangle(N)]
    cov = jnp.where(_is_variance(N), upper, _limit_covariances(upper))
    return estimate.replace(pos=pos, vel=new_vel, quat=turn_attitude(quat, angle, resting_quat), cov=cov)


def propagate(estimate: Estimate, accel: Array, gyro: Array, dt: Array | float, gravity: Array) -> Estimate:
    """Return the estimate with biases after an interval, which may be negative, with an unchanged covariance.

    Args:
        accel: Mean specific force as measured, body frame, m/s^2. (3,)
        gyro: Mean angular velocity as measured, body frame, rad/s. (3,)
        dt: Length of the interval, s.
        gravity: Acceleration of gravity, world frame, m/s^2. (3,)
    """
    angle = dt * (gyro - estimate.gyro_bias)  # type: ignore[operator]
    mid_quat, end_quat = turn_attitude(estimate.quat, 0.5 * angle), turn_attitude(estimate.quat, angle)
    acc = rotation.matvec(rotation.matrix(mid_quat), accel - estimate.accel_bias, gravity)  # type: ignore[operator]
    vel = rotation.rotate(estimate.quat, estimate.vel)
    pos = estimate.pos + dt * vel + 0.5 * dt**2 * acc
    return estimate.replace(pos=pos, vel=rotation.rotate_inverse(end_quat, vel + dt * acc), quat=end_quat)


def predict_biased(
    estimate: Estimate,
    accel: Array,
    gyro: Array,
    dt: float,
    gravity: Array,
    accel_variance: Array,
    gyro_variance: Array,
) -> Estimate:
    """Return the estimate with biases after an interval, with the noise of the inertial sensors.

    Position and velocity follow the mean specific force, turned by half of the rotation in the interval. The errors
    follow Solà (2017), section 5.4.3, with the velocity turned into the body frame. R and v are attitude and
    velocity before the interval, R' and v' after it, M is the rotation in its first half, E = R'^T R, g gravity in the
    world frame, a and w are the errors of accelerometer and gyroscope, and [ ]x is the matrix of a cross product:

        d_pos' = d_pos + dt R d_vel - dt R [v]x d_att
        d_vel' = E d_vel + dt [R'^T g]x E d_att - dt [v']x w - dt E M a
        d_att' = E d_att - dt w

    Args:
        accel: Mean specific force as measured, body frame, m/s^2. (3,)
        gyro: Mean angular velocity as measured, body frame, rad/s. (3,)
        dt: Length of the interval, s.
        gravity: Acceleration of gravity, world frame, m/s^2. (3,)
        accel_variance: Variances of the mean specific force, m^2/s^4. (3,)
        gyro_variance: Variances of the mean angular velocity, rad^2/s^2. (3,)
    """
    # Estimate, and attitude in the middle of the interval.
    vel, predicted_estimate = estimate.vel, propagate(estimate, accel, gyro, dt, gravity)
    mid_quat = turn_attitude(estimate.quat, 0.5 * dt * (gyro - estimate.gyro_bias))  # type: ignore[operator]
    rot, rot_middle, rot_end = (rotation.matrix(q) for q in (estimate.quat, mid_quat, predicted_estimate.quat))

    # Jacobian of the errors, in blocks.
    error_rot, accel_to_vel = rot_end.T @ rot, -dt * (rot_end.T @ rot_middle)
    vel_to_pos, att_to_pos = dt * rot, -dt * rot @ rotation.cross_matrix(vel)
    gravity_to_vel, gyro_to_vel = (
        dt * rotation.cross_matrix(rot_end.T @ gravity),
        -dt * rotation.cross_matrix(predicted_estimate.vel),
    )

    def transform_errors(p: Array) -> Array:
        rotated_att = error_rot @ p[6:9]
        pos_rows = p[:3] + vel_to_pos @ p[3:6] + att_to_pos @ p[6:9]
        vel_rows = error_rot @ p[3:6] + gravity_to_vel @ rotated_att + accel_to_vel @ p[9:12] + gyro_to_vel @ p[12:]
        return jnp.concatenate([pos_rows, vel_rows, rotated_att - dt * p[12:], p[9:]])

    p = transform_errors(transform_errors(covariance(estimate.cov)).T)
    # Noise of accelerometer and gyroscope.
    gyro_noise = gyro_to_vel * gyro_variance
    vel_noise = (accel_to_vel * accel_variance) @ accel_to_vel.T + gyro_noise @ gyro_to_vel.T
    vel_att_noise = -dt * gyro_noise
    p = p.at[3:6, 3:6].add(vel_noise).at[3:6, 6:9].add(vel_att_noise).at[6:9, 3:6].add(vel_att_noise.T)
    p = p.at[6:9, 6:9].add(dt**2 * jnp.diag(gyro_variance))
    return predicted_estimate.replace(cov=bound_covariance(p))


def add_noise(estimate: Estimate, variances: Array) -> Estimate:
    """Return the estimate with process noise, given as variances that are added to the errors' variances. (n,)"""
    n, cov = variances.shape[0], estimate.cov
    variance = _is_variance(n)
    return estimate.replace(cov=cov.at[variance].set(_limit_variances(cov[variance] + variances, n)))


def update(estimate: Estimate, rows: Sequence[int], h: Array, error: Array, deviation: Array | float) -> Estimate:
    """Return the estimate after the measurement of one number.

    Args:
        rows: Indices of the errors that the measurement depends on, such as ``POS``.
        h: Derivatives of the measurement with respect to these errors. (len(rows),)
        error: The measurement minus its prediction by the estimate, in the unit of the measurement. ()
        deviation: Standard deviation of the measurement, in the same unit. ()
    """
    p, rows = covariance(estimate.cov), list(rows)
    n = p.shape[0]
    # Kalman gain of a single number.
    ph = p[:, rows] @ h
    r = deviation * deviation
    gain = ph * (1 / (jnp.dot(h, ph[jnp.asarray(rows)]) + r))
    # Joseph's form (I - K H) P (I - K H)' + K R K'; only the columns ``rows`` of I - K H differ from the identity.
    reduction = jnp.eye(n, dtype=p.dtype)[:, rows] - gain[:, None] * h
    unused_rows = np.setdiff1d(np.arange(n), rows)
    is_unused = np.zeros((n, 1), bool)
    is_unused[unused_rows] = True
    p = jnp.where(is_unused, p, 0.0) + reduction @ p[jnp.asarray(rows)]
    p = jnp.where(is_unused.T, p, 0.0) + p[:, rows] @ reduction.T
    p = p + r * gain[:, None] * gain
    # Correction of the estimate.
    correction = error * gain
    biases = {}
    if estimate.accel_bias is not None and estimate.gyro_bias is not None:
        biases = {
            "accel_bias": estimate.accel_bias + correction[9:12],
            "gyro_bias": estimate.gyro_bias + correction[12:],
        }
    return estimate.replace(
        pos=estimate.pos + correction[:3],
        vel=estimate.vel + correction[3:6],
        att_error=estimate.att_error + correction[6:9],
        cov=bound_covariance(p),
        **biases,
    )


def finalize(estimate: Estimate, min_angle: float = SMALL_ANGLE) -> Estimate:
    """Return the estimate with its attitude error moved into the attitude.

    Args:
        min_angle: Angle that a component of the error must exceed, rad, else the error is dropped; by default as in the
            firmware.
    """
    error, p = estimate.att_error, covariance(estimate.cov)
    size = jnp.abs(error)
    is_moved = jnp.any(size > min_angle) & jnp.all(size < LARGE_ANGLE)
    error_rot = _error_rotation(0.5 * jnp.where(is_moved, error, 0.0))
    p = jnp.concatenate([p[:6], error_rot @ p[6:9], p[9:]])
    p = jnp.concatenate([p[:, :6], p[:, 6:9] @ error_rot.T, p[:, 9:]], axis=1)
    quat = jnp.where(is_moved, turn_attitude(estimate.quat, error), estimate.quat)
    return estimate.replace(quat=quat, att_error=jnp.zeros_like(error), cov=bound_covariance(p))


def is_within_bounds(estimate: Estimate, max_pos: float = MAX_POS, max_vel: float = MAX_VEL) -> Array:
    """Whether all coordinates, m, and velocities, m/s, are within bounds. ()"""
    return jnp.all(jnp.abs(estimate.pos) <= max_pos) & jnp.all(jnp.abs(estimate.vel) <= max_vel)


def select_estimate(mask: Array, new: Estimate, old: Estimate) -> Estimate:
    """Return the new estimate where a flag is set, and the old one elsewhere."""
    return jax.tree.map(lambda a, b: jnp.where(mask, a, b), new, old)


def bound_covariance(p: Array) -> Array:
    """Return the upper triangle of a covariance, bounded; NaN becomes the upper bound.

    The firmware takes the mean of both triangles, which differ by rounding; with the upper triangle alone, the engine
    computes half as many entries.
    """
    n = p.shape[0]
    upper = p[_upper_triangle(n)]
    return jnp.where(_is_variance(n), _limit_variances(upper, n), _limit_covariances(upper))


def turn_attitude(quat: Array, angle: Array, resting_quat: Array | None = None) -> Array:
    """Return an attitude turned in the body frame by a rotation vector, rad, with the firmware's guards. (4,)

    If ``resting_quat`` is given, a fraction of it is mixed in (``REVERSION_FRACTION``).
    """
    size = rotation.safe_norm(angle) + NORM_EPSILON
    half_angle = 0.5 * size
    quat_step = jnp.concatenate([jnp.sin(half_angle) / size * angle, jnp.cos(half_angle)])
    quat = rotation.multiply(quat, quat_step)
    if resting_quat is not None:
        quat = (1 - REVERSION_FRACTION) * quat + REVERSION_FRACTION * resting_quat
    return quat / (rotation.safe_norm(quat) + NORM_EPSILON)


def _limit_covariances(covariances: Array) -> Array:
    return jnp.where(covariances <= MAX_COVARIANCE, covariances, MAX_COVARIANCE)


def _limit_variances(variances: Array, n: int) -> Array:
    return jnp.where(variances <= MAX_COVARIANCE, jnp.maximum(variances, MIN_VARIANCE[n]), MAX_COVARIANCE)


def _is_variance(n: int) -> np.ndarray:
    return np.equal(*_upper_triangle(n))


def _n_errors(upper: Array) -> int:
    return math.isqrt(2 * upper.shape[-1])


@functools.cache
def _upper_triangle(n: int) -> tuple[np.ndarray, ...]:
    return tuple([x.astype(np.uint32) for x in np.triu_indices(n)])


def _error_rotation(half_angle: Array) -> Array:
    cross = rotation.cross_matrix(half_angle)
    return jnp.eye(3, dtype=half_angle.dtype) - cross + 0.5 * (cross @ cross)
