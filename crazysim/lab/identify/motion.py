"""Motion capture with another clock, added to a log; derivatives and integrals over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, require
from crazysim.lab.identify.columns import Columns, stack_columns, unsigned_name
from crazysim.lab.identify.readers import Stream, resample
from crazysim.lab.live.attitude import multiply

LAG_STEP = 0.005
"""Interval at which angular velocities are compared, s."""
MAX_MEAN_INTERVAL = 0.5
"""Longest mean interval between valid samples, s."""
DERIVATIVE_DURATION = 0.06
"""Duration over which positions and attitudes are differentiated, s."""


def join_motion_capture(
    name: str,
    table: Mapping[str, NDArray],
    motion: Mapping[str, NDArray],
    columns: Columns,
    repairs: list[str],
) -> dict[str, NDArray]:
    """Return a log's columns, and the columns of motion capture that it lacks, on the clock of the log.

    The clocks may differ by any offset, which is found by correlating the magnitudes of the angular velocities.

    Args:
        motion: Columns of the motion capture.
        columns: Names of the columns in both.
        repairs: List that descriptions of repairs are appended to.

    Raises:
        ConfigError: If log and motion capture do not agree.
    """
    time, quat = columns.time, [unsigned_name(x) for x in columns.quat]
    ang_vel = stack_columns(name, table, columns.ang_vel, columns.rad_per_unit)
    missing = [c for c in (time, *quat) if c not in motion]
    if missing:
        raise ConfigError(
            f"{name}: expected columns {', '.join(missing)} in its motion capture, got {', '.join(sorted(motion))}. "
            "Give the names as time= and quat=."
        )
    t, motion_time = (np.asarray(x[time], np.float64) for x in (table, motion))
    motion_rates = body_rates(motion_time, stack_columns(name, motion, columns.quat))
    n_smoothing = round(DERIVATIVE_DURATION / LAG_STEP)
    # Size of the angular velocity on both clocks.
    series = []
    for times, rates in ((t, ang_vel), ((motion_time[1:] + motion_time[:-1]) / 2, motion_rates)):
        is_valid = np.isfinite(times) & np.all(np.isfinite(rates), axis=-1)
        order = np.unique(times[is_valid], return_index=True)[1]
        span = np.ptp(times[is_valid]) if len(order) > 1 else 0.0
        require(
            0 < span < MAX_MEAN_INTERVAL * len(order),
            f"{name}: expected samples at least every {MAX_MEAN_INTERVAL:g} s on average, got {len(order)} valid "
            f"samples over {span:.3g} s. Cut the log and its motion capture to the flight.",
        )
        grid = np.arange(times[is_valid].min(), times[is_valid].max(), LAG_STEP)
        speed = np.interp(grid, times[is_valid][order], np.linalg.norm(rates[is_valid][order], axis=-1))
        series.append((grid[0], np.convolve(speed, np.ones(n_smoothing) / n_smoothing, "same")))
    # Shift at which both agree best.
    (log_start, a), (motion_start, b) = series
    lag, agreement = _find_lag(a, b)
    if agreement < 0.7:
        raise ConfigError(
            f"{name}: expected motion capture of the same flight, got angular velocities that agree by "
            f"{agreement:.2f} of 1 at best. Check that both files are of one flight, that the drone rotates in it, and "
            "that quat= names the attitude."
        )
    shift = log_start - motion_start + lag * LAG_STEP
    repairs.append(f"moved the clock of the motion capture by {shift:.3f} s (agreement {agreement:.2f} of 1)")
    # Both on the clock of the log.
    streams = {
        "the log": Stream(t, _number_columns(table, len(t), (time,))),
        "motion capture": Stream(motion_time + shift, _number_columns(motion, len(motion_time), (time, *table))),
    }
    merged_table = resample(name, streams, repairs, columns)
    return merged_table | {time: merged_table.pop("t")}


def _number_columns(table: Mapping[str, NDArray], n: int, excluded: Sequence[str]) -> dict[str, NDArray]:
    columns = {key: np.asarray(x) for key, x in table.items() if key not in excluded}
    return {key: x.astype(np.float64) for key, x in columns.items() if x.shape == (n,) and x.dtype.kind in "fiub"}


def _find_lag(a: NDArray, b: NDArray) -> tuple[float, float]:
    n = len(a) + len(b)

    def cross_correlate(x: NDArray, y: NDArray) -> NDArray:
        return np.fft.irfft(np.fft.rfft(x, n) * np.conj(np.fft.rfft(y, n)), n)

    ones_a, ones_b = np.ones(len(a)), np.ones(len(b))
    count = np.round(cross_correlate(ones_a, ones_b))
    safe_count = np.maximum(count, 1)
    mean_a, mean_b = cross_correlate(a, ones_b) / safe_count, cross_correlate(ones_a, b) / safe_count
    covariance = cross_correlate(a, b) / safe_count - mean_a * mean_b
    variance = (cross_correlate(a * a, ones_b) / safe_count - mean_a**2) * (
        cross_correlate(ones_a, b * b) / safe_count - mean_b**2
    )
    overlap = count >= 0.5 * min(len(a), len(b))
    agreement = np.where(overlap, covariance / np.sqrt(np.maximum(variance, 1e-12)), -1.0)
    k = int(np.argmax(agreement))
    left, middle, right = agreement[k - 1], agreement[k], agreement[(k + 1) % n]
    curvature = left - 2 * middle + right
    peak = k + (0.5 * (left - right) / curvature if curvature < 0 else 0.0)
    return (peak if k < len(a) else peak - n), float(middle)


def body_rates(t: NDArray, quat: NDArray) -> NDArray:
    """Return the angular velocities between consecutive attitudes, body frame, rad/s. (n - 1, 3)"""
    turn = multiply(quat[:-1] * [-1, -1, -1, 1], quat[1:])
    return 2 * turn[:, :3] * np.sign(turn[:, 3:]) / np.diff(t)[:, None]


def fit_velocity(t: NDArray, pos: NDArray) -> NDArray:
    """Return velocities as slopes of lines fitted to positions over ``DERIVATIVE_DURATION``, m/s. (n, 3)"""
    half_window = max(1, round(DERIVATIVE_DURATION / float(np.median(np.diff(t))) / 2))
    padded_pos = np.concatenate(
        [2 * pos[:1] - pos[half_window:0:-1], pos, 2 * pos[-1:] - pos[-2 : -half_window - 2 : -1]]
    )
    times = np.concatenate([2 * t[:1] - t[half_window:0:-1], t, 2 * t[-1:] - t[-2 : -half_window - 2 : -1]])
    weights = np.arange(-half_window, half_window + 1)[::-1].astype(float)
    rate = np.stack([np.convolve(x, weights, "valid") for x in padded_pos.T], axis=-1)
    return rate / np.convolve(times, weights, "valid")[:, None]


def fit_ang_vel(t: NDArray, quat: NDArray) -> NDArray:
    """Return angular velocities from attitudes, averaged over about half of ``DERIVATIVE_DURATION``, rad/s. (n, 3)"""
    rates = body_rates(t, quat)
    rates = np.concatenate([rates[:1], (rates[1:] + rates[:-1]) / 2, rates[-1:]])
    half_window = max(1, round(DERIVATIVE_DURATION / float(np.median(np.diff(t))) / 4))
    kernel = np.ones(2 * half_window + 1) / (2 * half_window + 1)
    padded_rates = np.pad(rates, ((half_window, half_window), (0, 0)), mode="edge")
    return np.stack([np.convolve(x, kernel, "valid") for x in padded_rates.T], axis=-1)


def integrate(x: NDArray, t: NDArray) -> NDArray:
    """Return the integral over time from the first sample (trapezoidal rule). (n, ...)"""
    steps = (x[1:] + x[:-1]) / 2 * np.diff(t).reshape(-1, *[1] * (x.ndim - 1))
    return np.concatenate([np.zeros_like(x[:1]), np.cumsum(steps, axis=0)])
