"""Crazysim's versions of the firmware's filters against recorded outputs of the compiled C sources."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim import rotation
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.lab.estimators import complementary
from crazysim.lab.validate.firmware_controllers import RECORDINGS
from crazysim.lab.validate.rows import Row
from crazysim.plugins.estimators import error_state, updates

FILTER_RECORDINGS = RECORDINGS / "plugins" / "estimators"
"""Folder with the recorded outputs of filters."""
MEASUREMENT_KINDS = ("difference", "distance", "flow", "ground", "pose", "position", "range", "sweep")
"""Kinds of measurements of the Kalman filter, one for each recording. ``difference`` is between the distances to two
anchors; ``ground`` is the position, of a drone on the ground."""
ANCHORS = ((-3.0, -3.0, 0.2), (3.0, -3.0, 2.4), (3.0, 3.0, 0.2), (-3.0, 3.0, 2.4))
"""Positions of the anchors, m."""
DIODE_OFFSET = np.array([0.015, 0.0075, 0.0], np.float32)
"""Position of the Lighthouse sensor's diode, body frame, m."""
PROCESS_VARIANCE = np.square(np.array([5e-7, 5e-7, 1e-6, 5e-4, 5e-4, 1e-3, 1e-4, 1e-4, 1e-4], np.float32))
"""Variances of the process noise of one loop of 1 ms: position, velocity and attitude error. (9,)"""


def update_with_measurements(
    kind: str, k: Any, measurement: Any, gyro: Array, estimate: Any, rot: Array, stations: Any
) -> Any:
    """Return the estimate after the measurements of one loop of the Kalman filter.

    The measurements are used in the same loops and with the same standard deviations as in
    tests/plugins/estimators/record_filter.py.

    Args:
        kind: One of ``MEASUREMENT_KINDS``.
        k: Number of the loop, from 1. ()
        measurement: Measurements of the loop. (9,)
        gyro: Angular velocity, body frame, rad/s. (3,)
        estimate: Estimate before the measurements.
        rot: Attitude at the end of the previous loop, as a matrix. (3, 3)
        stations: Positions, m, (2, 3), and attitudes, station to world, (2, 3, 3), of the two Lighthouse stations.
    """
    if kind in ("position", "ground"):
        return error_state.select_estimate(k % 10 == 5, updates.update_pos(estimate, measurement[:3], 0.01), estimate)
    if kind == "pose":
        updated_estimate = updates.update_quat(
            updates.update_pos(estimate, measurement[:3], 0.01), measurement[3:7], 0.05
        )
        return error_state.select_estimate(k % 10 == 0, updated_estimate, estimate)
    if kind in ("flow", "range"):
        updated_estimate = updates.update_flow(
            estimate, rot, 0.1 * measurement[:2], gyro, jnp.asarray(0.01 * 35 / 0.71674), 0.2
        )
        estimate = error_state.select_estimate(k % 10 == 0, updated_estimate, estimate)
        has_range = (k % 25 == 10) & (kind == "range")
        return error_state.select_estimate(
            has_range, updates.update_range(estimate, rot, measurement[2], 0.02), estimate
        )
    if kind == "sweep":
        estimate = error_state.select_estimate(k == 2, updates.update_pos(estimate, measurement[:3], 0.01), estimate)
        station = stations[0][k // 8 % 2], stations[1][k // 8 % 2]
        for loop_offset, tilt in ((0, math.pi / 6), (4, -math.pi / 6)):
            updated_estimate = updates.update_sweep(
                estimate, rot, jnp.asarray(DIODE_OFFSET), station, tilt, measurement[0], 0.001
            )
            estimate = error_state.select_estimate(k % 8 == loop_offset, updated_estimate, estimate)
        return estimate
    anchors, a = jnp.asarray(ANCHORS), k // 5 % 4
    if kind == "distance":
        updated_estimate = updates.update_distance(estimate, anchors[a], measurement[0], 0.25)
    else:
        updated_estimate = updates.update_difference(estimate, anchors[a], anchors[(a + 1) % 4], measurement[0], 0.15)
    return error_state.select_estimate(k % 5 == 0, updated_estimate, estimate)


def kalman_states(kind: str) -> tuple[NDArray, NDArray]:
    """Return states and covariances of crazysim's and the firmware's Kalman filter, every 0.1 s of a 4 s recording.

    Args:
        kind: One of ``MEASUREMENT_KINDS``. In ``"ground"`` the drone is on the ground, in other recordings it flies
            fast.

    Returns:
        Position, m, velocity, body frame, m/s, attitude error, rad, quaternion, wxyz, and the upper triangle of the
        covariance, row by row. (40, 58) each
    """
    level_quat = jnp.array([0.0, 0.0, 0.0, 1.0])
    with np.load(FILTER_RECORDINGS / "firmware_filter.npz") as file:
        inertial = jnp.asarray(file[f"inertial/{'ground' if kind == 'ground' else 'air'}"])[1:]
        inputs, recorded = jnp.asarray(file[f"{kind}/inputs"]), file[f"{kind}/outputs"]
        stations = jnp.asarray(file["sweep/places"]), jnp.asarray(file["sweep/frames"])

    def loop(carry: Any, x: Any) -> tuple[Any, Array]:
        (estimate, rot), (loop_index, inertial_row, measurement) = carry, x
        accel, gyro = inertial_row[:3], inertial_row[3:]
        predicted = error_state.predict(estimate, accel, gyro, 0.01, level_quat if kind == "ground" else None)
        estimate = error_state.add_noise(
            error_state.select_estimate(loop_index % 10 == 0, predicted, estimate), jnp.asarray(PROCESS_VARIANCE)
        )
        estimate = error_state.finalize(
            update_with_measurements(kind, loop_index, measurement, gyro, estimate, rot, stations)
        )
        state = estimate.pos, estimate.vel, estimate.att_error, jnp.roll(estimate.quat, 1), estimate.cov
        return (estimate, rotation.matrix(estimate.quat)), jnp.concatenate(state)

    start = error_state.initial_estimate(
        jnp.array([0.05, -0.05, 1.25]), jnp.zeros(3), level_quat, (100, 100, 1, *[0.01] * 6)
    )
    loops = jnp.arange(1, len(inputs) + 1), inertial, inputs
    run = jax.jit(lambda start, x: jax.lax.scan(loop, (start, jnp.eye(3)), x)[1])
    return np.asarray(run(start, loops))[99::100], recorded


def complementary_states(kind: str) -> tuple[NDArray, NDArray]:
    """Return states of crazysim's and the firmware's complementary filter, every 20 ms of a 2 s recording.

    Args:
        kind: Source of the height: ``"pressure"`` or ``"ground"``.

    Returns:
        Quaternion, xyzw, height, m, and climb rate, m/s. (100, 6) each
    """
    with np.load(FILTER_RECORDINGS / "firmware_complementary.npz") as file:
        inputs, recorded = jnp.asarray(file[f"{kind}/inputs"]), file[f"{kind}/outputs"]

    def tick(carry: Any, x: Any) -> tuple[Any, Array]:
        (quat, integral, inertial_climb, height, climb_rate, over_surface), (k, row) = carry, x
        gyro, accel = jnp.radians(row[:3]), GRAVITY_MAGNITUDE * row[3:6]
        attitude_update = complementary.update_mahony(quat, integral, gyro, accel, 0.004, 0.4, 0.001)
        attitude_update = (
            *attitude_update,
            complementary.inertial_climb(inertial_climb, attitude_update[0], accel, 0.004),
        )
        quat, integral, inertial_climb = (
            jnp.where(k % 4 == 0, *pair) for pair in zip(attitude_update, carry[:3], strict=True)
        )
        shift = 0.01 * inertial_climb
        pressure_height = complementary.filtered_height(height, row[6:7], shift)
        is_useful = row[8:] <= 1000 * complementary.MAX_RANGE_AGE
        new_height, new_over_surface = complementary.height_over_surface(
            height, pressure_height, row[7:8], is_useful, over_surface, shift
        )
        is_height_tick = k % 10 == 0
        climb_rate, over_surface = (
            jnp.where(is_height_tick, (new_height - height) / 0.01, climb_rate),
            jnp.where(is_height_tick, new_over_surface, over_surface),
        )
        height = jnp.where(is_height_tick, new_height, height)
        return (quat, integral, inertial_climb, height, climb_rate, over_surface), jnp.concatenate(
            [quat, height, climb_rate]
        )

    zero = jnp.zeros(1)
    start = jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.zeros(3), zero, inputs[0, 6:7], zero, zero
    run = jax.jit(lambda start, x: jax.lax.scan(tick, start, (jnp.arange(len(x)), x))[1])
    return np.asarray(run(start, inputs))[19::20], recorded


def compare_filters() -> Iterable[Row]:
    """Yield the largest differences between the states of crazysim's filters and of the compiled firmware."""
    for kind in MEASUREMENT_KINDS:
        estimates, recorded = kalman_states(kind)
        difference = np.abs(estimates - recorded)
        # the limits allow for float32 rounding errors, which accumulate over 4,000 loops
        yield Row(f"Kalman filter, {kind}: position, velocity, attitude error", "compiled C, 4 s",
                  float(difference[:, :9].max()), "m, m/s, rad", (0, 2e-4))  # fmt: skip
        yield Row(f"Kalman filter, {kind}: quaternion", "compiled C, 4 s",
                  float(difference[:, 9:13].max()), "", (0, 5e-6))  # fmt: skip
        relative = difference[:, 13:] / (1e-5 + np.abs(recorded[:, 13:]))
        yield Row(f"Kalman filter, {kind}: covariance", "compiled C, 4 s", float(relative.max()), "",
                  (0, 5e-3))  # fmt: skip
    for kind in ("pressure", "ground"):
        estimates, recorded = complementary_states(kind)
        yield Row(f"complementary filter, {kind}: quaternion, height in m", "compiled C, 2 s",
                  float(np.abs(estimates - recorded)[:, :5].max()), "", (0, 5e-6))  # fmt: skip
