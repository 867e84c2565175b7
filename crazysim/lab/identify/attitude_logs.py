"""Preparation of logs for the identification of fitted dynamics: outliers, levelling, filters with derivatives."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim import rotation
from crazysim.errors import require

LEVEL_DURATION = 0.1
"""Duration at the start of a log over which the mean attitude is defined as level, s."""
OUTLIER_DISTANCE = 0.3
"""Distance along an axis from the median over ``MEDIAN_DURATION`` beyond which a position is an outlier, m."""
MEDIAN_DURATION = 0.1
"""Duration over which the median is taken, s; with a longer one, fast turns look like outliers."""
CUTOFFS = {"translation": 6.0, "rotation": 8.0}
"""Cutoffs of the filters of Crazyflow's identification, Hz."""


def preprocessing(data: Mapping[str, ArrayLike]) -> dict[str, NDArray]:
    """Return a log with time from zero, outliers interpolated, and attitudes relative to the mean of the first 0.1 s.

    Args:
        data: ``time``, s, (n,); ``pos``, m, (n, 3); ``quat``, body to world, xyzw, (n, 4); ``cmd_rpy``, rad, (n, 3);
            ``cmd_f``, collective thrust, N, (n,).

    Returns:
        The same columns, and ``dt``, s, (n - 1,), and ``rpy``, rad, (n, 3).
    """
    keys = ("time", "pos", "quat", "cmd_rpy", "cmd_f")
    require(
        not (missing := [key for key in keys if key not in data]),
        f"expected {', '.join(keys)}, got no {', '.join(missing)}. Add them to the log.",
    )
    log = {key: np.array(x, np.float64) for key, x in data.items()}
    time, pos, quat = log["time"] - log["time"][0], log["pos"], log["quat"]
    require(
        np.all(np.diff(time) > 0), "expected a time that increases, got repeated or earlier samples. Drop them first."
    )
    dt = np.diff(time)
    half_window = max(1, round(MEDIAN_DURATION / 2 / float(np.mean(dt))))
    median_pos = np.stack(
        [np.median(pos[max(0, k - half_window) : k + half_window + 1], axis=0) for k in range(len(time))]
    )
    is_valid = ~np.any(np.abs(pos - median_pos) > OUTLIER_DISTANCE, axis=-1)
    require(
        np.sum(is_valid) >= 2, "expected positions along a path, got jumps at nearly every sample. Check their unit."
    )
    sign = np.cumprod(np.r_[1.0, np.where(np.sum(quat[1:] * quat[:-1], axis=-1) < 0, -1.0, 1.0)])
    quat = sign[:, None] * quat
    pos, quat = (np.stack([np.interp(time, time[is_valid], c[is_valid]) for c in x.T], axis=-1) for x in (pos, quat))
    level_quat = np.mean(quat[: max(1, round(LEVEL_DURATION / float(np.mean(dt))))], axis=0)
    inverse = level_quat / np.linalg.norm(level_quat) * [-1, -1, -1, 1]
    quat = np.asarray(rotation.multiply(jnp.asarray(inverse), jnp.asarray(quat)), np.float64)
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    rpy = np.unwrap(np.asarray(rotation.to_rpy(jnp.asarray(quat)), np.float64), axis=0)
    return log | {"time": time, "dt": dt, "pos": pos, "quat": quat, "rpy": rpy}


def derivatives_svf(data: Mapping[str, ArrayLike]) -> dict[str, NDArray]:
    """Return a log with filtered signals and their derivatives, without phase shift.

    Butterworth low-passes have a cutoff of 6 Hz for position and thrust and of 8 Hz for angles. Commands are held from
    sample to sample, as flight controllers do.

    Args:
        data: A log from ``preprocessing``.

    Returns:
        The same columns, and ``SVF_pos``, m, ``SVF_vel``, m/s, ``SVF_acc``, m/s^2, and ``SVF_jerk``, m/s^3, world
        frame, (n, 3); ``SVF_rpy``, rad, ``SVF_drpy``, rad/s, ``SVF_ddrpy``, rad/s^2, and ``SVF_dddrpy``, rad/s^3, (n,
        3); ``SVF_quat``, body to world, unit, xyzw, (n, 4); ``SVF_cmd_f``, N, (n,); ``SVF_cmd_rpy``, rad, (n, 3).
    """
    log = {key: np.asarray(x, np.float64) for key, x in data.items()}
    time = log["time"]

    def filter_signal(key: str, cutoff: str, zero_order_hold: bool = False) -> NDArray:
        return state_variable_filter(log[key].T, time, CUTOFFS[cutoff], 3, zero_order_hold=zero_order_hold)

    def derivative_columns(x: NDArray, k: int) -> NDArray:
        return x[:, k].T

    pos, rpy = filter_signal("pos", "translation"), filter_signal("rpy", "rotation")
    log |= {f"SVF_{key}": derivative_columns(pos, k) for k, key in enumerate(("pos", "vel", "acc", "jerk"))}
    log |= {f"SVF_{key}": derivative_columns(rpy, k) for k, key in enumerate(("rpy", "drpy", "ddrpy", "dddrpy"))}
    log["SVF_quat"] = np.asarray(rotation.from_rpy(jnp.asarray(log["SVF_rpy"])), np.float64)
    log["SVF_cmd_f"] = filter_signal("cmd_f", "translation", zero_order_hold=True)[0]
    log["SVF_cmd_rpy"] = derivative_columns(filter_signal("cmd_rpy", "rotation", zero_order_hold=True), 0)
    return log


def state_variable_filter(
    y: ArrayLike, t: ArrayLike, f_c: float = 1.0, N_deriv: int = 2, *, zero_order_hold: bool = False
) -> NDArray:
    """Filter a signal by a Butterworth low-pass backward and forward in time; return it and its derivatives.

    The low-pass of order ``N_deriv + 2`` is simulated exactly for a signal that is linear between samples, or constant
    with ``zero_order_hold``. Signals at uneven times are resampled.

    Args:
        y: Signals. (n,) or (n_signals, n)
        t: Times, s. (n,)
        f_c: Cutoff, Hz.
        N_deriv: Number of derivatives.
        zero_order_hold: Whether the signals stay constant until the next sample.

    Returns:
        Filtered signals and derivatives, (n_signals, N_deriv + 1, n), without axes of length one.
    """
    from scipy.linalg import expm  # a fifth of a second to import

    y, t = np.atleast_2d(np.asarray(y, np.float64)), np.asarray(t, np.float64)
    even_times = np.linspace(t[0], t[-1], len(t))
    # ``u`` is the input of the low-pass, the signals at even times.
    if zero_order_hold:
        u = y[:, np.clip(np.searchsorted(t, even_times + 1e-9, side="right") - 1, 0, len(t) - 1)]
    else:
        u = np.stack([np.interp(even_times, t, x) for x in y])
    order, omega = N_deriv + 2, 2 * np.pi * f_c
    poles = np.exp(1j * np.pi * (2 * np.arange(1, order + 1) + order - 1) / (2 * order))
    # State: signal and derivatives in the time unit 1 / omega, then the input and its change over a sample.
    a = np.zeros((order + 2, order + 2))
    a[: order - 1, 1:order] = np.eye(order - 1)
    a[order - 1, :order] = -np.real(np.poly(poles))[:0:-1]
    a[order - 1, order] = 1.0
    step = omega * (t[-1] - t[0]) / (len(t) - 1)
    a *= step
    a[order, order + 1] = 1.0
    step_matrix = expm(a)[:order]

    def low_pass(u: NDArray, input_change: NDArray) -> NDArray:
        x = np.zeros((len(u), order))
        x[:, 0] = u[:, 0]
        inputs = u[..., None] * step_matrix[:, order] + input_change[..., None] * step_matrix[:, order + 1]
        states, transition = np.empty((*u.shape, order)), step_matrix[:, :order].T
        for k in range(u.shape[1]):
            states[:, k] = x
            x = x @ transition + inputs[:, k]
        return states

    zero = np.zeros((len(u), 1))
    if zero_order_hold:  # backward in time, the input between two samples is the value of the earlier sample
        backward_pass = low_pass(np.concatenate([u[:, -2::-1], u[:, :1]], axis=1), np.zeros_like(u))[:, ::-1, 0]
    else:
        backward_pass = low_pass(u[:, ::-1], np.concatenate([np.diff(u[:, ::-1], axis=1), zero], axis=1))[:, ::-1, 0]
    states = low_pass(backward_pass, np.concatenate([np.diff(backward_pass, axis=1), zero], axis=1))
    interpolated = [[np.interp(t, even_times, omega**k * x[:, k]) for k in range(N_deriv + 1)] for x in states]
    return np.squeeze(np.array(interpolated))
