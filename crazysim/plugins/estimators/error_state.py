"""Extended Kalman filters with error states, as functions of one drone.

The equations, constants and guards are those of the Crazyflie's firmware (kalman_core.c and the mm_*.c of
bitcraze/crazyflie-firmware, commit 2a18fc29), whose sources are M. W. Mueller, M. Hamer and R. D'Andrea, Fusing
ultra-wideband range measurements with accelerometers and rate gyroscopes for quadrocopter state estimation, ICRA 2015,
and M. W. Mueller, M. Hehn and R. D'Andrea, Covariance correction step for Kalman filtering with an attitude, Journal of
Guidance, Control, and Dynamics 40 (2017). The drag that the firmware can model is zero on Crazyflies, and left out.
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
from crazysim.pytree import PyTree, leaf

POS, VEL, ATT, GYRO = (0, 1, 2), (3, 4, 5), (6, 7, 8), (12, 13, 14)
"""Rows of the errors of position, velocity, attitude and the bias of the gyroscope."""
N, N_BIASED = 9, 15
"""Number of error states without biases, and with those of accelerometer and gyroscope, in this order."""
MAX_COVARIANCE, MIN_VARIANCE = 100.0, {N: 1e-6, N_BIASED: 1e-12}
"""Bounds of a covariance and a variance (kalman_core.c); with biases, whose variances are smaller, an assumption."""
EPS = 1e-6
"""Added to a norm that something is divided by (kalman_core.c)."""
MAX_POS, MAX_VEL = 100.0, 10.0
"""Bounds of coordinates, m, and of velocities, body frame, m/s, beyond which the filter has failed
(kalman_supervisor.c)."""
SMALL_ANGLE, LARGE_ANGLE = 1e-4, 10.0
"""Smallest attitude error that is moved into the attitude, and the largest, rad (kalman_core.c)."""
GRAVITY = 9.81
"""Acceleration of gravity, m/s^2 (physicalConstants.h)."""
LOWEST = 0.1
"""Least height that the flow is predicted for, m (mm_flow.c)."""
LOWEST_COSINE = 0.1
"""Least cosine of the tilt at which a distance to the ground is used (mm_tof.c)."""
HALF_CONE = 0.5 * 15 * math.pi / 180
"""Half the opening angle of the sensor's cone, rad (mm_tof.c)."""
REVERSION = 0.001
"""Share of the initial attitude that a prediction on the ground mixes in (kalman_core_params_defaults.h)."""


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
    """Return the covariance, (..., n, n), from its upper triangle, row by row. (..., n (n + 1) / 2)"""
    n = _n_errors(upper)
    # Unsigned: to signed indices JAX 0.10 adds sizes of the precision in which it indexed first, float32 or float64.
    place = np.zeros((n, n), np.uint32)
    place[_upper(n)] = np.arange(upper.shape[-1])
    return upper[..., np.maximum(place, place.T)]


def start(
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
    cov = jnp.diag(variance)[_upper(len(deviations))]
    return Estimate(pos, vel, quat, jnp.zeros_like(vel), cov, accel_bias, gyro_bias)


def predict(
    estimate: Estimate, accel: Array, gyro: Array, dt: float, resting: Array | None = None, all_axes: bool = False
) -> Estimate:
    """Return the estimate after an interval, without process noise, which bounds the variances.

    Args:
        estimate: The estimate.
        accel: Specific force, body frame, m/s^2. (3,)
        gyro: Angular velocity, body frame, rad/s. (3,)
        dt: Length of the interval, s.
        resting: Attitude to which that of a drone on the ground is drawn, (4,); None in flight.
        all_axes: True to use the force along all axes in flight; False for that along the z axis of the body only, as
            the firmware does, because rotors can make no other.
    """
    pos, vel, quat = estimate.pos, estimate.vel, estimate.quat
    rot, identity, angle = rotation.matrix(quat), jnp.eye(3, dtype=pos.dtype), dt * gyro
    gravity = GRAVITY * rot[2]  # in the body frame

    # The linearised step: rows of the errors of position, velocity and attitude.
    to_pos = dt * rot
    att_to_pos = -to_pos @ rotation.cross_matrix(vel)
    keep_vel = identity - rotation.cross_matrix(angle)
    att_to_vel = -dt * rotation.cross_matrix(gravity)
    turn = _turn(0.5 * angle)
    p = covariance(estimate.cov)
    pos_rows = p[:3] + to_pos @ p[3:6] + att_to_pos @ p[6:]
    vel_rows = keep_vel @ p[3:6] + att_to_vel @ p[6:]
    rows = jnp.concatenate([pos_rows, vel_rows, turn @ p[6:]])
    pos_columns = rows[:, :3] + rows[:, 3:6] @ to_pos.T + rows[:, 6:] @ att_to_pos.T
    vel_columns = rows[:, 3:6] @ keep_vel.T + rows[:, 6:] @ att_to_vel.T
    p = jnp.concatenate([pos_columns, vel_columns, rows[:, 6:] @ turn.T], axis=1)

    force = rotation.along_z(accel[2]) if resting is None and not all_axes else accel
    shift = dt * vel + 0.5 * dt**2 * force
    pos = rotation.matvec(rot, shift, pos) - jnp.asarray([0.0, 0.0, 0.5 * GRAVITY * dt**2], pos.dtype)
    new_vel = vel + dt * (force - rotation.cross(gyro, vel) - gravity)
    upper = p[_upper(N)]
    cov = jnp.where(_is_variance(N), upper, _at_most(upper))
    return estimate.replace(pos=pos, vel=new_vel, quat=_turned(quat, angle, resting), cov=cov)


def moved(estimate: Estimate, accel: Array, gyro: Array, dt: Array | float, gravity: Array) -> Estimate:
    """Return the estimate with biases after an interval, or before one where it is negative, with its covariance as is.

    Args:
        estimate: The estimate.
        accel: Mean specific force as measured, body frame, m/s^2. (3,)
        gyro: Mean angular velocity as measured, body frame, rad/s. (3,)
        dt: Length of the interval, s.
        gravity: Acceleration of gravity, world frame, m/s^2. (3,)
    """
    angle = dt * (gyro - estimate.gyro_bias)  # type: ignore[operator]
    middle, end = _turned(estimate.quat, 0.5 * angle), _turned(estimate.quat, angle)
    acc = rotation.matvec(rotation.matrix(middle), accel - estimate.accel_bias, gravity)  # type: ignore[operator]
    vel = rotation.rotate(estimate.quat, estimate.vel)
    pos = estimate.pos + dt * vel + 0.5 * dt**2 * acc
    return estimate.replace(pos=pos, vel=rotation.rotate_inverse(end, vel + dt * acc), quat=end)


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

    Position and velocity move with the mean specific force, turned by half of the rotation in the interval; the errors
    are those of Solà (2017), section 5.4.3, with the velocity turned into the body frame. R and v are attitude and
    velocity before the interval, R' and v' after it, M is the rotation in its first half, E = R'^T R, g gravity in the
    world frame, a and w are the errors of accelerometer and gyroscope, and [ ]x is the matrix of a cross product:

        d_pos' = d_pos + dt R d_vel - dt R [v]x d_att
        d_vel' = E d_vel + dt [R'^T g]x E d_att - dt [v']x w - dt E M a
        d_att' = E d_att - dt w

    Args:
        estimate: The estimate.
        accel: Mean specific force as measured, body frame, m/s^2. (3,)
        gyro: Mean angular velocity as measured, body frame, rad/s. (3,)
        dt: Length of the interval, s.
        gravity: Acceleration of gravity, world frame, m/s^2. (3,)
        accel_variance: Variances of the mean specific force, m^2/s^4. (3,)
        gyro_variance: Variances of the mean angular velocity, rad^2/s^2. (3,)
    """
    vel, after = estimate.vel, moved(estimate, accel, gyro, dt, gravity)
    middle = _turned(estimate.quat, 0.5 * dt * (gyro - estimate.gyro_bias))  # type: ignore[operator]
    rot, rot_middle, rot_end = (rotation.matrix(q) for q in (estimate.quat, middle, after.quat))

    turn, accel_to_vel = rot_end.T @ rot, -dt * (rot_end.T @ rot_middle)
    vel_to_pos, att_to_pos = dt * rot, -dt * rot @ rotation.cross_matrix(vel)
    fall, gyro_to_vel = dt * rotation.cross_matrix(rot_end.T @ gravity), -dt * rotation.cross_matrix(after.vel)

    def rows(p: Array) -> Array:
        """Return the linearised step times a matrix."""
        turned = turn @ p[6:9]
        pos_rows = p[:3] + vel_to_pos @ p[3:6] + att_to_pos @ p[6:9]
        vel_rows = turn @ p[3:6] + fall @ turned + accel_to_vel @ p[9:12] + gyro_to_vel @ p[12:]
        return jnp.concatenate([pos_rows, vel_rows, turned - dt * p[12:], p[9:]])

    p = rows(rows(covariance(estimate.cov)).T)
    by_gyro = gyro_to_vel * gyro_variance
    vel_noise = (accel_to_vel * accel_variance) @ accel_to_vel.T + by_gyro @ gyro_to_vel.T
    both = -dt * by_gyro
    p = p.at[3:6, 3:6].add(vel_noise).at[3:6, 6:9].add(both).at[6:9, 3:6].add(both.T)
    p = p.at[6:9, 6:9].add(dt**2 * jnp.diag(gyro_variance))
    return after.replace(cov=_bounded(p))


def add_noise(estimate: Estimate, variances: Array) -> Estimate:
    """Return the estimate with process noise, given as variances that are added to those of the errors. (n,)"""
    n, cov = variances.shape[0], estimate.cov
    variance = _is_variance(n)
    return estimate.replace(cov=cov.at[variance].set(_variances(cov[variance] + variances, n)))


def update(estimate: Estimate, rows: Sequence[int], h: Array, error: Array, deviation: Array | float) -> Estimate:
    """Return the estimate after the measurement of one number.

    Args:
        estimate: The estimate.
        rows: Indices of the errors that the measurement depends on, such as ``POS``.
        h: Its derivatives with respect to them. (len(rows),)
        error: The measurement minus its prediction by the estimate, in the unit of the measurement. ()
        deviation: Standard deviation of the measurement, in the same unit. ()
    """
    p, rows = covariance(estimate.cov), list(rows)
    n = p.shape[0]
    ph = p[:, rows] @ h
    r = deviation * deviation
    gain = ph * (1 / (jnp.dot(h, ph[jnp.asarray(rows)]) + r))
    # Joseph's form (I - K H) P (I - K H)' + K R K'; only the columns of I - K H that belong to rows are not trivial.
    left = jnp.eye(n, dtype=p.dtype)[:, rows] - gain[:, None] * h
    others = np.setdiff1d(np.arange(n), rows)
    keep = np.zeros((n, 1), bool)
    keep[others] = True
    p = jnp.where(keep, p, 0.0) + left @ p[jnp.asarray(rows)]
    p = jnp.where(keep.T, p, 0.0) + p[:, rows] @ left.T
    p = p + r * gain[:, None] * gain
    step = error * gain
    biases = {}
    if estimate.accel_bias is not None and estimate.gyro_bias is not None:
        biases = {"accel_bias": estimate.accel_bias + step[9:12], "gyro_bias": estimate.gyro_bias + step[12:]}
    return estimate.replace(
        pos=estimate.pos + step[:3],
        vel=estimate.vel + step[3:6],
        att_error=estimate.att_error + step[6:9],
        cov=_bounded(p),
        **biases,
    )


def update_pos(estimate: Estimate, pos: Array, deviation: Array | float) -> Estimate:
    """Return the estimate after a measured position, world frame, m, (3,), of a standard deviation, m. () or (3,)"""
    for k, std in enumerate(_each(deviation)):
        estimate = update(estimate, [k], jnp.ones_like(pos[:1]), pos[k] - estimate.pos[k], std)
    return estimate


def update_vel(estimate: Estimate, vel: Array, deviation: Array | float) -> Estimate:
    """Return the estimate after a measured velocity, world frame, m/s, (3,), of a standard deviation. () or (3,)"""
    rot = rotation.matrix(estimate.quat)
    for k, std in enumerate(_each(deviation)):
        across = rotation.cross(estimate.vel, rot[k])  # the derivative with respect to the attitude
        predicted = rotation.dot(rot[k], estimate.vel)[0] + rotation.dot(across, estimate.att_error)[0]
        estimate = update(estimate, [*VEL, *ATT], jnp.concatenate([rot[k], across]), vel[k] - predicted, std)
    return estimate


def update_direction(estimate: Estimate, direction: Array, known: Array, deviation: Array | float) -> Estimate:
    """Return the estimate after a measured direction, such as that of a magnetic field.

    Args:
        estimate: The estimate.
        direction: Measured direction, body frame; its length is that of ``known`` but for errors. (3,)
        known: The direction, world frame, unit. (3,)
        deviation: Standard deviation along each axis, rad. () or (3,)
    """
    predicted = rotation.rotate_inverse(estimate.quat, known)
    slopes = rotation.cross_matrix(predicted)
    for k, std in enumerate(_each(deviation)):
        error = direction[k] - predicted[k] - rotation.dot(slopes[k], estimate.att_error)[0]
        estimate = update(estimate, ATT, slopes[k], error, std)
    return estimate


def update_quat(estimate: Estimate, quat: Array, deviation: Array | float) -> Estimate:
    """Return the estimate after a measured attitude, body to world, unit, xyzw, (4,).

    Its standard deviation about each axis is in rad. () or (3,)
    """
    residual = rotation.multiply(rotation.conjugate(estimate.quat), quat)
    error = 2 * residual[:3] / residual[3]
    for k, std in enumerate(_each(deviation)):
        estimate = update(estimate, [ATT[k]], jnp.ones_like(quat[:1]), error[k], std)
    return estimate


def update_flow(
    estimate: Estimate, rot: Array, flow: Array, gyro: Array, scale: Array, deviation: Array | float
) -> Estimate:
    """Return the estimate after a measured motion of the image of the ground.

    Args:
        estimate: The estimate.
        rot: Attitude at the end of the loop before, as a matrix. (3, 3)
        flow: Motion of the image along x and y of the body, pixels. (2,)
        gyro: Angular velocity as measured, body frame, rad/s. (3,)
        scale: Pixels by which the image moves at 1 rad/s. ()
        deviation: Standard deviation of a motion, pixels.
    """
    for k, (axis, sign) in enumerate(((1, -1.0), (0, 1.0))):
        height = jnp.maximum(estimate.pos[2], LOWEST)
        rate = rot[2, 2] / height
        turn, rows, slopes = gyro[axis], [POS[2], VEL[k]], [-estimate.vel[k] * rate / height, rate]
        if estimate.gyro_bias is not None:
            turn = turn - estimate.gyro_bias[axis]
            rows, slopes = [*rows, GYRO[axis]], [*slopes, jnp.full_like(rate, -sign)]
        predicted = scale * (estimate.vel[k] * rate + sign * turn)
        estimate = update(estimate, rows, scale * jnp.stack(slopes), flow[k] - predicted, deviation)
    return estimate


def update_range(estimate: Estimate, rot: Array, distance: Array, deviation: Array | float) -> Estimate:
    """Return the estimate after a measured distance to the floor, m; a drone tilted by 84 degrees measures none.

    Args:
        estimate: The estimate.
        rot: Attitude at the end of the loop before, as a matrix. (3, 3)
        distance: Shortest distance within the cone of the sensor. ()
        deviation: Standard deviation of the distance, m.
    """
    upright = rot[2, 2] > LOWEST_COSINE
    cosine = jnp.where(upright, rot[2, 2], 1.0)
    tilt = rotation.safe_arctan2(rotation.safe_sqrt(jnp.maximum(1 - cosine**2, 0.0)), cosine)
    gain = 1 / jnp.cos(jnp.maximum(tilt - HALF_CONE, 0.0))
    after = update(estimate, [POS[2]], gain[None], distance - gain * estimate.pos[2], deviation)
    return select(upright, after, estimate)


def update_ray(estimate: Estimate, distance: Array, deviation: Array | float) -> Estimate:
    """Return the estimate after a measured distance to level ground at z = 0 along the negative z axis of the body.

    Args:
        estimate: The estimate.
        distance: The distance, m; a drone tilted by 84 degrees measures none. ()
        deviation: Standard deviation of the distance, m.
    """
    down = rotation.matrix(estimate.quat)[2]
    sees = down[2] > LOWEST_COSINE
    gain = 1 / jnp.where(sees, down[2], 1.0)
    predicted = gain * estimate.pos[2]
    h = gain * jnp.stack([jnp.ones_like(gain), predicted * down[1], -predicted * down[0]])
    return select(sees, update(estimate, [POS[2], *ATT[:2]], h, distance - predicted, deviation), estimate)


def update_distance(estimate: Estimate, anchor: Array, distance: Array, deviation: Array | float) -> Estimate:
    """Return the estimate after a measured distance, m, () to an anchor, world frame, m. (3,)"""
    apart = estimate.pos - anchor
    predicted = rotation.safe_norm(apart)
    away = predicted > 0
    direction = jnp.where(away, apart / jnp.where(away, predicted, 1.0), jnp.asarray([1.0, 0.0, 0.0], apart.dtype))
    return update(estimate, POS, direction, distance - predicted[0], deviation)


def update_difference(
    estimate: Estimate, first: Array, second: Array, difference: Array, deviation: Array | float
) -> Estimate:
    """Return the estimate after a measured difference of distances to two anchors, m.

    Args:
        estimate: The estimate.
        first: Position of the first anchor, world frame, m. (3,)
        second: Position of the second anchor. (3,)
        difference: Distance to the second minus distance to the first. ()
        deviation: Standard deviation of the difference, m.
    """
    to_first, to_second = estimate.pos - first, estimate.pos - second
    d_first, d_second = rotation.safe_norm(to_first), rotation.safe_norm(to_second)
    away = (d_first > 0) & (d_second > 0)
    h = to_second / jnp.where(away, d_second, 1.0) - to_first / jnp.where(away, d_first, 1.0)
    after = update(estimate, POS, h, difference - (d_second - d_first)[0], deviation)
    return select(away[0], after, estimate)


def update_differences(estimate: Estimate, anchors: Array, differences: Array, deviation: Array | float) -> Estimate:
    """Return the estimate after measured differences of distances to that to the first anchor, all at one time.

    They have the errors of the first distance in common. A distance minus the mean of those before it is a combination
    of the differences whose errors are independent, with k distances before it of the variance ``1 + 1 / k``.

    Args:
        estimate: The estimate.
        anchors: Positions of the anchors, world frame, m. (n, 3)
        differences: Distances to all anchors but the first minus the distance to the first, m. (n - 1,)
        deviation: Standard deviation of a distance, m.
    """
    at, apart = estimate.pos, estimate.pos - anchors
    distance = rotation.safe_norm(apart)
    direction = apart / jnp.where(distance > 0, distance, 1.0)
    for k in range(1, anchors.shape[0]):
        h = direction[k] - jnp.sum(direction[:k], axis=0) / k
        predicted = distance[k, 0] - jnp.sum(distance[:k]) / k + jnp.dot(h, estimate.pos - at)
        measured = differences[k - 1] - jnp.sum(differences[: k - 1]) / k
        estimate = update(estimate, POS, h, measured - predicted, math.sqrt(1 + 1 / k) * deviation)
    return estimate


def update_sweep(
    estimate: Estimate,
    rot: Array,
    sensor: Array,
    station: tuple[Array, Array],
    tilt: float,
    angle: Array,
    deviation: Array | float,
) -> Estimate:
    """Return the estimate after a measured angle of a light plane that sweeps over the drone.

    Args:
        estimate: The estimate.
        rot: Attitude at the end of the loop before, as a matrix. (3, 3)
        sensor: Position of the sensor, body frame, m. (3,)
        station: Position of the station, world frame, m, (3,) and its attitude, station to world, as a matrix. (3, 3)
        tilt: Tilt of the plane, rad.
        angle: The angle of the sweep, rad. ()
        deviation: Standard deviation of the angle, rad.
    """
    place, frame = station
    x, y, z = frame.T @ (rotation.matvec(rot, sensor, estimate.pos) - place)
    tangent, squared = math.tan(tilt), x * x + y * y
    rest = squared - (z * tangent) ** 2
    sees = rest > 1e-4
    squared, rest = jnp.where(sees, squared, 1.0), jnp.where(sees, rest, 1.0)
    ratio = jnp.where(sees, z * tangent, 0.0) / jnp.sqrt(squared)
    predicted = rotation.safe_arctan2(y, x) + rotation.safe_arctan2(ratio, jnp.sqrt(1 - ratio**2))
    q = tangent / jnp.sqrt(rest)
    h = frame @ jnp.stack([(-y - x * z * q) / squared, (x - y * z * q) / squared, q])
    return select(sees, update(estimate, POS, h, angle - predicted, deviation), estimate)


def finalize(estimate: Estimate, least: float = SMALL_ANGLE) -> Estimate:
    """Return the estimate with its attitude error moved into the attitude.

    Args:
        estimate: The estimate.
        least: Size of the error, rad, up to which the firmware drops it.
    """
    error, p = estimate.att_error, covariance(estimate.cov)
    size = jnp.abs(error)
    moves = jnp.any(size > least) & jnp.all(size < LARGE_ANGLE)
    turn = _turn(0.5 * jnp.where(moves, error, 0.0))
    p = jnp.concatenate([p[:6], turn @ p[6:9], p[9:]])
    p = jnp.concatenate([p[:, :6], p[:, 6:9] @ turn.T, p[:, 9:]], axis=1)
    quat = jnp.where(moves, _turned(estimate.quat, error), estimate.quat)
    return estimate.replace(quat=quat, att_error=jnp.zeros_like(error), cov=_bounded(p))


def within_bounds(estimate: Estimate, max_pos: float = MAX_POS, max_vel: float = MAX_VEL) -> Array:
    """Return True where all coordinates, m, and velocities, m/s, are within bounds, by default the firmware's. ()"""
    return jnp.all(jnp.abs(estimate.pos) <= max_pos) & jnp.all(jnp.abs(estimate.vel) <= max_vel)


def select(which: Array, one: Estimate, other: Estimate) -> Estimate:
    """Return one estimate where a flag is set, and the other elsewhere."""
    return jax.tree.map(lambda a, b: jnp.where(which, a, b), one, other)


def _bounded(p: Array) -> Array:
    """Return the upper triangle of a covariance, bounded; NaN becomes the upper bound.

    The firmware takes the mean of both triangles, which differ by rounding; with one, the engine computes half of them.
    """
    n = p.shape[0]
    upper = p[_upper(n)]
    return jnp.where(_is_variance(n), _variances(upper, n), _at_most(upper))


def _at_most(covariances: Array) -> Array:
    """Return covariances within their upper bound, which NaN becomes."""
    return jnp.where(covariances <= MAX_COVARIANCE, covariances, MAX_COVARIANCE)


def _variances(variances: Array, n: int) -> Array:
    """Return variances within their bounds, of ``n`` errors; NaN becomes the upper bound."""
    return jnp.where(variances <= MAX_COVARIANCE, jnp.maximum(variances, MIN_VARIANCE[n]), MAX_COVARIANCE)


def _is_variance(n: int) -> np.ndarray:
    """Return True for the variances of the upper triangle of a covariance of ``n`` errors. (n (n + 1) / 2)"""
    return np.equal(*_upper(n))


def _n_errors(upper: Array) -> int:
    """Return the number of errors of a covariance whose upper triangle is given."""
    return math.isqrt(2 * upper.shape[-1])


@functools.cache
def _upper(n: int) -> tuple[np.ndarray, ...]:
    """Return rows and columns of the upper triangle of a matrix (n, n), row by row."""
    return tuple([places.astype(np.uint32) for places in np.triu_indices(n)])


def _each(deviation: Array | float) -> Sequence[Array | float]:
    """Return the standard deviation of each of three axes."""
    return [deviation] * 3 if jnp.ndim(deviation) == 0 else [deviation[k] for k in range(3)]  # type: ignore[index]


def _turn(half: Array) -> Array:
    """Return the rotation of the error of an attitude that turns by twice ``half``, to second order. (3, 3)"""
    cross = rotation.cross_matrix(half)
    return jnp.eye(3, dtype=half.dtype) - cross + 0.5 * (cross @ cross)


def _turned(quat: Array, angle: Array, resting: Array | None = None) -> Array:
    """Return an attitude turned in the body frame by a rotation vector, rad, with the firmware's guards. (4,)

    A part of an attitude at rest is mixed in where one is given.
    """
    size = rotation.safe_norm(angle) + EPS
    half = 0.5 * size
    step = jnp.concatenate([jnp.sin(half) / size * angle, jnp.cos(half)])
    quat = rotation.multiply(quat, step)
    if resting is not None:
        quat = (1 - REVERSION) * quat + REVERSION * resting
    return quat / (rotation.safe_norm(quat) + EPS)
