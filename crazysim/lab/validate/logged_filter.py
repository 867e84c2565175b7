"""The firmware's filter on logged measurements, compared with the filter that ran on board."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim import rotation
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.errors import ConfigError
from crazysim.lab.validate.closed_loop import MAX_DISTANCE, commanded_samples, read_columns
from crazysim.lab.validate.flights import find_logs
from crazysim.lab.validate.rows import Row
from crazysim.plugins.estimators import error_state, updates
from crazysim.plugins.estimators.kalman import MEASUREMENT_STD

SAMPLE_PERIOD, LOOPS_PER_SAMPLE = 0.01, 10
"""Time between samples of a log, s, and the number of loops of the filter in that time; each loop adds process
noise."""
PROCESS_NOISE_STD = np.array([5e-7, 5e-7, 1e-6, 5e-4, 5e-4, 1e-3, 1e-4, 1e-4, 1e-4])
"""Deviations of the noise of a loop of 1 ms, m, m/s, rad: (0.5, 0.5, 1) m/s^2 and 0.1 rad/s of the firmware."""
SETTLING_TIME = 2.0
"""Time from the first setpoint, s, after which estimates are compared and drones fly."""


def read_filter_log(path: Path) -> dict[str, NDArray]:
    """Return a log of NanoBench from its first setpoint to its last, as arrays by name. (n, k) each

    The names are ``accel``, m/s^2, ``gyro``, rad/s, ``pos`` and ``quat`` of motion capture (see ``thrust_attitudes``),
    ``est_pos`` and ``est_quat`` of the filter on board, and ``goal``, m.
    """
    names = {
        "accel": [f"imu_acc_{k}" for k in "xyz"],
        "gyro": [f"imu_gyro_{k}" for k in "xyz"],
        "pos": [f"p{k}" for k in "xyz"],
        "quat": [f"q{k}" for k in "xyzw"],
        "est_pos": [f"est_stateEstimate_{k}" for k in "xyz"],
        "est_quat": [f"att_stateEstimate_q{k}" for k in "xyzw"],
        "goal": [f"sp_ctrltarget_{k}" for k in "xyz"],
    }
    column_names = [name for columns in names.values() for name in columns]
    table = dict(zip(column_names, read_columns(path, column_names).astype(np.float32), strict=True))
    log = {key: np.stack([table[name] for name in columns], axis=-1) for key, columns in names.items()}
    commanded = commanded_samples(path.name, log["goal"][:, 2])
    log = {k: x[commanded[0] : commanded[-1]] for k, x in log.items()}
    accel = np.float32(GRAVITY_MAGNITUDE) * log["accel"]
    return log | {"accel": accel, "quat": thrust_attitudes(log["pos"], log["quat"])}


def thrust_attitudes(pos: NDArray, quat: NDArray) -> NDArray:
    """Return the attitudes of a body whose z axis is the mean direction of the thrust in a flight. (n, 4)

    The frame of the tracked body depends on its markers, while the filter assumes that the thrust is along the z axis
    of the body. The direction is the mean of R^T (a + g) from ``SETTLING_TIME`` on, with the acceleration a of the
    positions, compared with which the mean drag is small.

    Args:
        pos: Position of the tracked body, world frame, m. (n, 3)
        quat: Attitude of the tracked body, body to world, xyzw. (n, 4)
    """
    accel = np.gradient(np.gradient(pos, SAMPLE_PERIOD, axis=0), SAMPLE_PERIOD, axis=0) + [0, 0, GRAVITY_MAGNITUDE]
    force = np.asarray(rotation.rotate_inverse(jnp.asarray(quat), jnp.asarray(accel)))[
        round(SETTLING_TIME / SAMPLE_PERIOD) :
    ]
    x, y, z = np.mean(force, axis=0) / np.linalg.norm(np.mean(force, axis=0))
    tilt = np.array([-y, x, 0, 1 + z]) / np.sqrt(2 + 2 * z)  # the shortest rotation of the z axis to (x, y, z)
    return np.asarray(rotation.multiply(jnp.asarray(quat), jnp.asarray(tilt, quat.dtype)))


@jax.jit
def replay_filter(accel: Array, gyro: Array, pos: Array, quat: Array) -> tuple[Array, Array]:
    """Return positions, m, (n, 3), and attitudes, xyzw, (n, 4), of the filter on measurements at 100 Hz.

    Args:
        accel: Specific force, body frame, m/s^2. (n, 3)
        gyro: Angular velocity, body frame, rad/s. (n, 3)
        pos: Measured position, world frame, m. (n, 3)
        quat: Measured attitude, body to world, xyzw. (n, 4)
    """
    noise = jnp.asarray(LOOPS_PER_SAMPLE * PROCESS_NOISE_STD**2, accel.dtype)

    def tick(estimate: error_state.Estimate, x: Any) -> tuple[Any, Any]:
        force, rate, measured_pos, attitude = x
        estimate = error_state.add_noise(error_state.predict(estimate, force, rate, SAMPLE_PERIOD), noise)
        estimate = updates.update_pos(estimate, measured_pos, MEASUREMENT_STD["pos"])
        estimate = error_state.finalize(updates.update_quat(estimate, attitude, MEASUREMENT_STD["quat"]))
        return estimate, (estimate.pos, estimate.quat)

    start = error_state.initial_estimate(pos[0], jnp.zeros(3), quat[0], (100, 100, 1, *[0.01] * 6))
    return jax.lax.scan(tick, start, (accel, gyro, pos, quat))[1]


def estimate_errors(log: dict[str, NDArray], pos: NDArray, quat: NDArray) -> tuple[float, float]:
    """Return the RMS differences of estimates from motion capture, of position, m, and of attitude, degrees."""
    settled_index = round(SETTLING_TIME / SAMPLE_PERIOD)
    rotation_error = np.asarray(rotation.multiply(rotation.conjugate(jnp.asarray(log["quat"])), jnp.asarray(quat)))[
        settled_index:
    ]
    angle = 2 * np.arctan2(np.linalg.norm(rotation_error[:, :3], axis=-1), np.abs(rotation_error[:, 3]))
    distance = np.linalg.norm(pos - log["pos"], axis=-1)[settled_index:]
    return float(np.sqrt(np.mean(distance**2))), float(np.degrees(np.sqrt(np.mean(angle**2))))


def compare_filter(folder: Path) -> Iterable[Row]:
    """Yield the errors of crazysim's filter divided by the on-board filter's, for each flight that did not crash."""
    flights = {}
    for path in find_logs(folder, "*"):
        try:
            flights[path.stem] = read_filter_log(path)
        except ConfigError as error:  # the other logs are still compared
            yield Row(path.stem, "filter on board", problem=str(error))
    n = max((len(log["pos"]) for log in flights.values()), default=0)
    for name, log in flights.items():
        if np.max(np.linalg.norm(log["pos"] - log["goal"], axis=-1)) > MAX_DISTANCE:
            continue
        size = len(log["pos"])  # all logs are padded to one length, so that the filter compiles once
        padded_columns = (log[k][np.minimum(np.arange(n), size - 1)] for k in ("accel", "gyro", "pos", "quat"))
        own_errors = estimate_errors(log, *(np.asarray(x)[:size] for x in replay_filter(*padded_columns)))
        board_errors = estimate_errors(log, log["est_pos"], log["est_quat"])
        for quantity, unit, own_error, board_error in zip(
            ("position", "attitude"), ("m", "degrees"), own_errors, board_errors, strict=True
        ):
            yield Row(f"{name}: {quantity}", "filter on board", own_error / board_error, "", (0, 1.1),
                      f"on board {board_error:.3g} {unit}, here {own_error:.3g} {unit}", series=quantity,
                      x=name.partition("_")[2])  # fmt: skip
