"""Repairs of logs, which are reported."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, require

MAX_REPAIRED_SHARE = 0.05
"""Largest share of samples that may be repaired; a log with more is an error."""
NORM_TOLERANCE = 1e-3
"""Deviation of a quaternion's norm from 1 that counts as rounding."""
MAX_INTERPOLATION = 0.03
"""Longest time that is interpolated, s. A straight line over T differs from a sine of frequency f by at most
``(2 pi f T)^2 / 8`` of its amplitude: by 11% at 5 Hz, about the fastest motion of a small drone."""
PERIOD_RANGE = (1e-4, 0.2)
"""Intervals between samples that a log of a flight can have, s: gyroscopes give up to 8 kHz; less than 5 Hz would not
show the rotation."""
TIME_UNITS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Units in which times may be logged by mistake, s."""
MIN_SAMPLES = 20
"""Least number of samples of a log."""
GROUND_DURATION = 1.0
"""Shortest stay on the ground that is left out of a log, and the time left out before and after it, s."""
CARRIED_SHARE, IDLE_SHARE = 0.75, 0.4
"""Shares of the typical thrust. A drone is on the ground where its thrust is below the first share for longer than
``GROUND_DURATION`` and falls below the second share: flight controllers raise the thrust slowly before take-off."""
N_NEIGHBOURS = 10
"""Number of samples on each side of an interval from which lost time and jitter are distinguished."""


def check_period(name: str, t: NDArray) -> None:
    """Check that the interval between samples is plausible for a log of a flight.

    Args:
        t: Time, s. (n,)
    """
    steps = np.diff(t[np.isfinite(t)])
    steps = steps[steps > 0]
    period, (low, high) = float(np.median(steps)) if len(steps) else 0.0, PERIOD_RANGE
    if not len(steps) or low <= period <= high:
        return
    units = [(unit, x) for unit, x in TIME_UNITS.items() if low <= period * x <= high]
    hint = f"The times seem to be in {units[0][0]}: give seconds_per_unit={units[0][1]:g}" if units else (
        "Give seconds_per_unit, the factor from the logged times to s"
    )  # fmt: skip
    raise ConfigError(f"{name}: expected samples every {low:g} to {high:g} s, got every {period:.4g} s. {hint}.")


def increasing_samples(name: str, t: NDArray, repairs: list[str]) -> NDArray:
    """Return True for the samples of the longest sequence whose time increases. (n,)

    If a single time is too early or too late, only that sample is dropped.
    """
    is_kept = np.isfinite(t)
    if not np.all(np.diff(t[is_kept]) > 0):
        is_kept = _longest_increasing_sequence(t)
    if np.sum(is_kept) > 2:  # A clock that is set at the start, or garbage at the end.
        indices, dt = np.flatnonzero(is_kept), np.median(np.diff(t[is_kept]))
        is_kept[
            [indices[k] for k, step in ((0, 0), (-1, -2)) if t[indices[step + 1]] - t[indices[step]] > 100 * dt]
        ] = False
    n_bad = int(np.sum(~is_kept))
    if len(t) >= MIN_SAMPLES and 2 * (n_different := len(np.unique(t))) < len(t):
        raise ConfigError(
            f"{name}: expected a different time for each sample, got {n_different} times of {len(t)} samples. "
            "Export the time with more digits, or name another column as time."
        )
    require(
        len(t) >= MIN_SAMPLES and n_bad <= MAX_REPAIRED_SHARE * len(t),
        f"{name}: expected at least {MIN_SAMPLES} samples whose time increases, got {len(t)} of which {n_bad} do "
        "not. Cut the log into flights.",
    )
    if n_bad:
        repairs.append(f"dropped {n_bad} samples whose time is not between those of their neighbours")
    return is_kept


def _longest_increasing_sequence(t: NDArray) -> NDArray:
    end_times: list[float] = []
    last_indices: list[int] = []
    predecessors = np.full(len(t), -1)
    for k, x in enumerate(t):
        if np.isfinite(x):
            length = bisect_left(end_times, x)
            predecessors[k] = last_indices[length - 1] if length else -1
            end_times[length : length + 1], last_indices[length : length + 1] = [float(x)], [k]
    is_kept, k = np.zeros(len(t), bool), last_indices[-1] if last_indices else -1
    while k >= 0:
        is_kept[k], k = True, int(predecessors[k])
    return is_kept


def find_gaps(name: str, t: NDArray, repairs: list[str]) -> NDArray:
    """Return the indices of samples that follow a gap. (n_gaps,)

    A gap is an interval of over 1.5 times the median, after which the samples stay late. If the next intervals are
    shorter, the times only jitter.
    """
    steps = np.diff(t)
    dt = float(np.median(steps))
    late_samples = 1 + np.flatnonzero(steps > 1.5 * dt)
    n_intervals = min(5 * N_NEIGHBOURS, len(t) - 1)
    lateness = t - t[0] - np.median(t[n_intervals:] - t[:-n_intervals]) / n_intervals * np.arange(len(t))
    sides = [(lateness[max(k - N_NEIGHBOURS, 0) : k], lateness[k : k + N_NEIGHBOURS]) for k in late_samples]
    is_lost = [np.median(b) - np.median(a) > dt / 2 and np.min(b) > np.max(a) for a, b in sides]
    gaps = late_samples[np.array(is_lost, bool)]
    if len(late_samples) > len(gaps):
        longest = float(np.max(steps[late_samples - 1]))
        repairs.append(
            f"kept {len(late_samples) - len(gaps)} intervals of up to {longest:.3g} s as jitter, since shorter "
            "intervals follow"
        )
    if len(gaps):
        longest = float(np.max(steps[gaps - 1]))
        if longest > 10 * (t[-1] - t[0] - longest):
            raise ConfigError(f"{name}: expected one flight, got a pause of {longest:.3g} s. Cut the log into flights.")
        repairs.append(
            f"{len(gaps)} gap{'s' * (len(gaps) > 1)}, the longest {longest:.3g} s; no prediction crosses them"
        )
    return gaps


def interpolate_missing(
    name: str, t: NDArray, data: dict[str, NDArray], repairs: list[str]
) -> tuple[NDArray, dict[str, NDArray]]:
    """Return time and data with missing values interpolated over up to ``MAX_INTERPOLATION``, without longer gaps.

    A value is missing where it is not finite. An attitude is also missing where its quaternion is zero, which some
    motion capture systems send for a lost body.
    """
    is_kept, lost_keys, columns = np.ones(len(t), bool), [], {}
    for key, x in data.items():
        # Samples with finite numbers.
        is_valid = np.all(np.isfinite(x), axis=-1)
        if key == "quat":
            is_valid &= np.linalg.norm(np.where(np.isfinite(x), x, 0.0), axis=-1) > NORM_TOLERANCE
        if 2 * np.sum(is_valid) < len(t):
            raise ConfigError(
                f"{name}: expected finite {key}{' that is not zero' if key == 'quat' else ''}, got {np.sum(~is_valid)} "
                f"samples of {len(t)} that are not. Cut the log to where it is whole."
            )
        if key == "quat":
            x = x.copy()
            x[is_valid] = normalise_quats(name, x[is_valid], repairs)
            if not np.all(is_valid):
                x[is_valid] = align_signs(x[is_valid])
        # Pauses that are too long to be filled.
        indices = np.flatnonzero(is_valid)
        pauses = np.flatnonzero((np.diff(indices) > 1) & (np.diff(t[indices]) > MAX_INTERPOLATION))
        is_known = np.zeros(len(t), bool)
        is_known[indices[0] : indices[-1] + 1] = True
        for k in pauses:
            is_known[indices[k] + 1 : indices[k + 1]] = False
        if not np.all(is_known):
            lost_keys.append(key)
            is_kept &= is_known
        # Short pauses, filled linearly.
        n_filled = int(np.sum(is_known & ~is_valid))
        require(
            n_filled <= MAX_REPAIRED_SHARE * len(t),
            f"{name}: expected finite {key}, got {n_filled} samples of {len(t)} that are not. "
            "Cut the log to where it is whole, or leave the column out.",
        )
        if n_filled:
            repairs.append(
                f"interpolated {n_filled} samples of {key} that were not finite{' or zero' * (key == 'quat')}"
            )
        if not np.all(is_valid):
            x = np.stack([np.interp(t, t[is_valid], c[is_valid]) for c in x.T], axis=-1)
            x = x / np.linalg.norm(x, axis=-1, keepdims=True) if key == "quat" else x
        columns[key] = x
    if lost_keys:
        repairs.append(
            f"dropped {np.sum(~is_kept)} samples, in which {', '.join(lost_keys)} were missing for over "
            f"{MAX_INTERPOLATION:g} s"
        )
    return t[is_kept], {key: x[is_kept] for key, x in columns.items()}


def airborne_samples(name: str, t: NDArray, thrust: NDArray, repairs: list[str]) -> NDArray:
    """Return True for the samples in the air, by the size of the thrust. (n,)

    Args:
        t: Time, s. (n,)
        thrust: Sum of the squares of the rotor speeds, or the commanded thrust, in any unit. (n,)
        repairs: List that descriptions of repairs are appended to.
    """
    from scipy.ndimage import median_filter  # takes 0.2 s to import

    smoothed = median_filter(
        np.maximum(thrust, 0.0), size=2 * max(1, round(0.1 / float(np.median(np.diff(t))))) + 1, mode="nearest"
    )
    order = np.argsort(smoothed)
    weight = np.cumsum(smoothed[order] ** 2)  # Idling rotors have little weight, however long they idle.
    median_thrust = smoothed[order[np.searchsorted(weight, weight[-1] / 2)]]
    require(
        median_thrust > 0,
        f"{name}: expected a flight, got rotors at rest. Check rotor_vel or attitude_command, or take another log.",
    )
    is_low = np.r_[False, smoothed < CARRIED_SHARE * median_thrust, False]
    starts, ends = np.flatnonzero(np.diff(is_low.astype(int)) == 1), np.flatnonzero(np.diff(is_low.astype(int)) == -1)
    is_kept = np.ones(len(t), bool)
    for start, end in zip(starts, ends, strict=True):
        is_inner = start > 0 and end < len(t)
        if np.min(smoothed[start:end]) < IDLE_SHARE * median_thrust and not (
            is_inner and t[end - 1] - t[start] < GROUND_DURATION
        ):
            is_kept &= (t < t[start] - GROUND_DURATION) | (t > t[end - 1] + GROUND_DURATION)
    if np.all(is_kept):
        return is_kept
    if np.sum(is_kept) < MIN_SAMPLES:
        raise ConfigError(
            f"{name}: expected at least {MIN_SAMPLES} samples in the air, got {np.sum(is_kept)} of {t[-1] - t[0]:.3g} "
            "s. Take a longer flight, and check rotor_vel or attitude_command."
        )
    repairs.append(
        f"left out {np.sum(~is_kept)} samples on the ground, or within {GROUND_DURATION:g} s of it, by the thrust"
    )
    return is_kept


def remove_spikes(name: str, x: NDArray, repairs: list[str]) -> NDArray:
    """Return rotor speeds, interpolated where they are negative or more than three times their median. (n, n_rotors)"""
    is_valid = (x >= 0) & (x <= 3 * np.median(x, axis=0))
    n_invalid = int(np.sum(~is_valid))
    require(
        n_invalid <= MAX_REPAIRED_SHARE * x.size,
        f"{name}: expected rotor speeds from 0 to three times their median, got {n_invalid} others. "
        "Cut the log to the flight, and check that the columns are speeds.",
    )
    if not n_invalid:
        return x
    repairs.append(f"interpolated {n_invalid} rotor speeds that were negative or more than three times the median")
    index = np.arange(len(x))
    return np.stack([np.interp(index, index[g], c[g]) for c, g in zip(x.T, is_valid.T, strict=True)], axis=-1)


def normalise_quats(name: str, quat: NDArray, repairs: list[str]) -> NDArray:
    """Return unit quaternions. An offset of each component is found by fitting a unit sphere, and subtracted."""
    norm = np.linalg.norm(quat, axis=-1)
    if np.all(np.abs(norm - 1) < NORM_TOLERANCE):
        return quat / norm[:, None]
    if not np.all(np.abs(norm - 1) < 0.2):
        raise ConfigError(
            f"{name}: expected unit quaternions, got norms from {norm.min():.3g} to {norm.max():.3g}. "
            "Name four components, x, y, z and w in this order, as quat."
        )
    solution, *_ = np.linalg.lstsq(np.c_[2 * quat, np.ones(len(quat))], norm**2, rcond=None)
    centred = quat - solution[:4]
    centred_norm = np.linalg.norm(centred, axis=-1)
    if np.all(np.abs(centred_norm - 1) < NORM_TOLERANCE):
        offset = ", ".join(f"{x:.4f}" for x in solution[:4])
        repairs.append(f"subtracted ({offset}) from the quaternions, which makes them unit")
        return centred / centred_norm[:, None]
    repairs.append(f"normalised quaternions of norms from {norm.min():.4f} to {norm.max():.4f}")
    return quat / norm[:, None]


def unwrap_angles(angles: NDArray, period: float = 2 * np.pi) -> NDArray:
    """Return angles without jumps by a period, for interpolation; missing angles stay NaN. (n,)"""
    is_valid = np.isfinite(angles)
    angles = np.where(is_valid, angles, np.nan)
    angles[is_valid] = np.unwrap(angles[is_valid], period=period)
    return angles


def align_signs(quat: NDArray) -> NDArray:
    """Return the same attitudes as quaternions that do not flip from q to -q, for interpolation. (n, 4)"""
    return quat * np.cumprod(np.r_[1.0, np.where(np.sum(quat[1:] * quat[:-1], axis=-1) < 0, -1.0, 1.0)])[:, None]
