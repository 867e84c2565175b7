"""Measurement updates of the error-state Kalman filters, for one drone.

The models of the Crazyflie's firmware use the attitude ``rot`` at the end of the previous step (the mm_*.c of
bitcraze/crazyflie-firmware, commit 2a18fc29).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.plugins.estimators.error_state import ATT, GYRO, POS, VEL, Estimate, select_estimate, update

MIN_FLOW_HEIGHT = 0.1
"""Smallest height for which the flow is predicted, m (mm_flow.c)."""
MIN_TILT_COSINE = 0.1
"""Least cosine of the tilt at which a distance to the ground is used (mm_tof.c)."""
HALF_CONE_ANGLE = 0.5 * 15 * math.pi / 180
"""Half the opening angle of the time-of-flight sensor's cone, rad (mm_tof.c)."""


def update_pos(estimate: Estimate, pos: Array, deviation: Array | float, point: Array | None = None) -> Estimate:
    """Return the estimate after a measured position.

    Args:
        pos: The position, world frame, m. (3,)
        deviation: Its standard deviation, m. () or (3,)
        point: Point of the drone whose position is measured, body frame, m; None for the centre of mass. (3,)
    """
    rot = rotation.matrix(estimate.quat)
    for k, std in enumerate(_std_per_axis(deviation)):
        rows, h, predicted = [k], jnp.ones_like(pos[:1]), estimate.pos[k]
        if point is not None:
            slope = rotation.cross(point, rot[k])  # the derivative with respect to the attitude
            rows, h = [k, *ATT], jnp.concatenate([h, slope])
            predicted = predicted + rotation.dot(rot[k], point)[0] + rotation.dot(slope, estimate.att_error)[0]
        estimate = update(estimate, rows, h, pos[k] - predicted, std)
    return estimate


def update_vel(
    estimate: Estimate, vel: Array, deviation: Array | float, point: Array | None = None, gyro: Array | None = None
) -> Estimate:
    """Return the estimate after a measured velocity.

    Args:
        vel: The velocity, world frame, m/s. (3,)
        deviation: Its standard deviation along each axis, m/s. () or (3,)
        point: Point of the drone whose velocity is measured, body frame, m; None for the centre of mass. (3,)
        gyro: Angular velocity as measured, body frame, rad/s; for a point only. (3,)
    """
    rot = rotation.matrix(estimate.quat)
    for k, std in enumerate(_std_per_axis(deviation)):
        body_vel, rows, slopes = estimate.vel, [*VEL, *ATT], []
        if point is not None:
            body_vel = body_vel + rotation.cross(gyro - estimate.gyro_bias, point)  # type: ignore[operator]
            rows, slopes = [*rows, *GYRO], [rotation.cross(rot[k], point)]
        attitude_slope = rotation.cross(body_vel, rot[k])  # the derivative with respect to the attitude
        predicted = rotation.dot(rot[k], body_vel)[0] + rotation.dot(attitude_slope, estimate.att_error)[0]
        h = jnp.concatenate([rot[k], attitude_slope, *slopes])
        estimate = update(estimate, rows, h, vel[k] - predicted, std)
    return estimate


def update_direction(
    estimate: Estimate, direction: Array, world_direction: Array, deviation: Array | float
) -> Estimate:
    """Return the estimate after a measured direction, such as the direction of a magnetic field.

    Args:
        direction: Measured direction, body frame, of about unit length. (3,)
        world_direction: The direction, world frame, unit. (3,)
        deviation: Standard deviation along each axis, rad. () or (3,)
    """
    predicted = rotation.rotate_inverse(estimate.quat, world_direction)
    slopes = rotation.cross_matrix(predicted)
    for k, std in enumerate(_std_per_axis(deviation)):
        error = direction[k] - predicted[k] - rotation.dot(slopes[k], estimate.att_error)[0]
        estimate = update(estimate, ATT, slopes[k], error, std)
    return estimate


def update_quat(estimate: Estimate, quat: Array, deviation: Array | float) -> Estimate:
    """Return the estimate after a measured attitude, body to world, unit, xyzw, (4,).

    Its standard deviation about each axis is in rad. () or (3,)
    """
    residual = rotation.multiply(rotation.conjugate(estimate.quat), quat)
    error = 2 * residual[:3] / residual[3]
    for k, std in enumerate(_std_per_axis(deviation)):
        estimate = update(estimate, [ATT[k]], jnp.ones_like(quat[:1]), error[k], std)
    return estimate


def update_flow(
    estimate: Estimate, rot: Array, flow: Array, gyro: Array, scale: Array, deviation: Array | float
) -> Estimate:
    """Return the estimate after a measured motion of the image of the ground.

    Without biases, both components are predicted from the prior estimate, as in the firmware, although the second
    prediction is then correlated with the first. With biases, the second component is predicted after the first update.

    Args:
        rot: Attitude at the end of the previous step, as a matrix. (3, 3)
        flow: Motion of the image along x and y of the body, pixels. (2,)
        gyro: Angular velocity as measured, body frame, rad/s. (3,)
        scale: Pixels by which the image moves at 1 rad/s. ()
        deviation: Standard deviation of a motion, pixels.
    """
    prior = estimate
    for k, (axis, sign) in enumerate(((1, -1.0), (0, 1.0))):
        height = jnp.maximum(prior.pos[2], MIN_FLOW_HEIGHT)
        flow_per_vel = rot[2, 2] / height
        turn_rate, rows = gyro[axis], [POS[2], VEL[k]]
        slopes = [-prior.vel[k] * flow_per_vel / height, flow_per_vel]
        if prior.gyro_bias is not None:
            turn_rate = turn_rate - prior.gyro_bias[axis]
            rows, slopes = [*rows, GYRO[axis]], [*slopes, jnp.full_like(flow_per_vel, -sign)]
        predicted = scale * (prior.vel[k] * flow_per_vel + sign * turn_rate)
        estimate = update(estimate, rows, scale * jnp.stack(slopes), flow[k] - predicted, deviation)
        prior = prior if estimate.gyro_bias is None else estimate
    return estimate


def update_range(estimate: Estimate, rot: Array, distance: Array, deviation: Array | float) -> Estimate:
    """Return the estimate after a measured distance to the floor, m; unchanged if the tilt exceeds 84 degrees.

    Args:
        rot: Attitude at the end of the previous step, as a matrix. (3, 3)
        distance: Shortest distance within the cone of the sensor. ()
        deviation: Standard deviation of the distance, m.
    """
    is_upright = rot[2, 2] > MIN_TILT_COSINE
    cosine = jnp.where(is_upright, rot[2, 2], 1.0)
    tilt = rotation.safe_arctan2(rotation.safe_sqrt(jnp.maximum((1 - cosine) * (1 + cosine), 0.0)), cosine)
    gain = 1 / jnp.cos(jnp.maximum(tilt - HALF_CONE_ANGLE, 0.0))
    updated = update(estimate, [POS[2]], gain[None], distance - gain * estimate.pos[2], deviation)
    return select_estimate(is_upright, updated, estimate)


def update_ray(estimate: Estimate, distance: Array, deviation: Array | float) -> Estimate:
    """Return the estimate after a measured distance to level ground at z = 0 along the negative z axis of the body.

    Args:
        distance: The distance, m; the estimate is unchanged if the tilt exceeds 84 degrees. ()
        deviation: Standard deviation of the distance, m.
    """
    world_z = rotation.matrix(estimate.quat)[2]
    is_upright = world_z[2] > MIN_TILT_COSINE
    gain = 1 / jnp.where(is_upright, world_z[2], 1.0)
    predicted = gain * estimate.pos[2]
    h = gain * jnp.stack([jnp.ones_like(gain), predicted * world_z[1], -predicted * world_z[0]])
    return select_estimate(
        is_upright, update(estimate, [POS[2], *ATT[:2]], h, distance - predicted, deviation), estimate
    )


def update_distance(estimate: Estimate, anchor: Array, distance: Array, deviation: Array | float) -> Estimate:
    """Return the estimate after a measured distance, m (), to an anchor at a position, world frame, m. (3,)"""
    offset = estimate.pos - anchor
    predicted = rotation.safe_norm(offset)
    is_apart = predicted > 0
    direction = jnp.where(
        is_apart, offset / jnp.where(is_apart, predicted, 1.0), jnp.asarray([1.0, 0.0, 0.0], offset.dtype)
    )
    return update(estimate, POS, direction, distance - predicted[0], deviation)


def update_difference(
    estimate: Estimate, first_anchor: Array, second_anchor: Array, difference: Array, deviation: Array | float
) -> Estimate:
    """Return the estimate after a measured difference of distances to two anchors, m.

    Args:
        first_anchor: Position of the first anchor, world frame, m. (3,)
        second_anchor: Position of the second anchor. (3,)
        difference: Distance to the second minus distance to the first. ()
        deviation: Standard deviation of the difference, m.
    """
    offset_1, offset_2 = estimate.pos - first_anchor, estimate.pos - second_anchor
    distance_1, distance_2 = rotation.safe_norm(offset_1), rotation.safe_norm(offset_2)
    is_apart = (distance_1 > 0) & (distance_2 > 0)
    h = offset_2 / jnp.where(is_apart, distance_2, 1.0) - offset_1 / jnp.where(is_apart, distance_1, 1.0)
    updated = update(estimate, POS, h, difference - (distance_2 - distance_1)[0], deviation)
    return select_estimate(is_apart[0], updated, estimate)


def update_differences(estimate: Estimate, anchors: Array, differences: Array, deviation: Array | float) -> Estimate:
    """Return the estimate after measured differences between the distances to the other anchors and to the first one.

    The distances are measured at the same time, so all differences contain the error of the first distance. A distance
    minus the mean of the k distances before it is a combination of differences. Such combinations have independent
    errors, with ``1 + 1 / k`` times the variance of one distance.

    Args:
        anchors: Positions of the anchors, world frame, m. (n, 3)
        differences: Distances to all anchors but the first minus the distance to the first, m. (n - 1,)
        deviation: Standard deviation of a distance, m.
    """
    pos, offsets = estimate.pos, estimate.pos - anchors
    distance = rotation.safe_norm(offsets)
    direction = offsets / jnp.where(distance > 0, distance, 1.0)
    for k in range(1, anchors.shape[0]):
        h = direction[k] - jnp.sum(direction[:k], axis=0) / k
        predicted = distance[k, 0] - jnp.sum(distance[:k]) / k + jnp.dot(h, estimate.pos - pos)
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
        rot: Attitude at the end of the previous step, as a matrix. (3, 3)
        sensor: Position of the photodiode, body frame, m. (3,)
        station: Position of the station, world frame, m, (3,) and its attitude, station to world, as a matrix. (3, 3)
        tilt: Tilt of the plane, rad.
        angle: The angle of the sweep, rad. ()
        deviation: Standard deviation of the angle, rad.
    """
    station_pos, station_rot = station
    x, y, z = station_rot.T @ (rotation.matvec(rot, sensor, estimate.pos) - station_pos)
    tangent, r_squared = math.tan(tilt), x * x + y * y
    radicand = r_squared - (z * tangent) ** 2
    is_visible = radicand > 1e-4
    r_squared, radicand = jnp.where(is_visible, r_squared, 1.0), jnp.where(is_visible, radicand, 1.0)
    ratio = jnp.where(is_visible, z * tangent, 0.0) / jnp.sqrt(r_squared)
    predicted = rotation.safe_arctan2(y, x) + rotation.safe_arctan2(ratio, jnp.sqrt((1 - ratio) * (1 + ratio)))
    q = tangent / jnp.sqrt(radicand)  # derivative of the angle with respect to z
    h = station_rot @ jnp.stack([(-y - x * z * q) / r_squared, (x - y * z * q) / r_squared, q])
    return select_estimate(is_visible, update(estimate, POS, h, angle - predicted, deviation), estimate)


def _std_per_axis(deviation: Array | float) -> Sequence[Array | float]:
    return [deviation] * 3 if jnp.ndim(deviation) == 0 else [deviation[k] for k in range(3)]  # type: ignore[index]
