"""Moments of inertia, torque curve and delay from fast rotation, by linear regression.

Over a fraction of a second, aerodynamic torques of the flow around the drone are several times those that turn it, and
no simple model predicts them to some percent. A fit of long predictions therefore explains them by moments of inertia
that are far too large, which make the prediction insensitive to its torques. Fast rotation does not have this problem:
above some hertz the torque of the rotors turns the body. So both sides of the equation of motion are band-passed.

Telemetry of rotor speeds is held, quantised and late, which biases coefficients towards zero (errors in variables).
Commands are free of that: where a log has them, they are the instruments of two-stage least squares.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from crazysim.dynamics import first_principles
from crazysim.dynamics.rotor import RPM_TO_RAD_S
from crazysim.errors import ConfigError
from crazysim.identify.logs import Log

FAST, SLOW, YAW_SLOW = 0.05, 0.33, 1.0
"""Widths of the Hann windows whose difference is the band-pass, s: some 3 to 20 Hz, and 1 to 20 Hz about z."""
LAGS = 0.15
"""Duration of the response from commands to rotor speeds, s."""
BLOCK = 10.0
"""Duration of the blocks of a log that are solved for themselves, each with a delay of its own, s."""
FEWEST = 3
"""Fewest blocks whose scatter gives a standard deviation."""
LONGEST = 0.04
"""Largest delay, s."""


class FastRotation(NamedTuple):
    """Moments of inertia, torque curve and delays, with deviations."""

    values: NDArray
    """Factors of the moments of inertia about x, y, z, of the torque curve and of the rotors' inertia. (5,)"""
    deviations: NDArray
    """Standard deviations, from the scatter between blocks. (5,)"""
    delays: NDArray
    """Delay of the state behind the rotor speeds in each log, s. (n_logs,)"""


def fast_rotation(logs: Sequence[Log], params: first_principles.Params, thrust_factor: float = 1.0) -> FastRotation:
    """Return what fast rotation shows.

    About x and y, thrust and arms give the torque, and so the scale. About z neither the drag torque nor the rotors'
    inertia is known, so that only their ratios to the moment of inertia are: that moment is in proportion to the other
    two, as in the airframe. Results are weighted medians over blocks, because streams of telemetry drift against each
    other and lose packets, which spoils single blocks.

    Args:
        logs: Logs of the same sample time.
        params: Parameters of the airframe.
        thrust_factor: Factor of its thrust curve.

    Raises:
        ConfigError: If the rotors do not turn the drone as the airframe says, or the logs are too short.
    """
    blocks = [_blocks(_Prepared.create(log, params, thrust_factor)) for log in logs]
    found = np.concatenate(blocks)
    if not len(found):
        raise ConfigError(f"expected logs of over {YAW_SLOW + 1:g} s without gaps, got none. Use longer logs.")
    medians = [median(found[:, k], found[:, k + 5]) for k in range(4)]
    (roll, pitch, drag, reaction), deviations = zip(*medians, strict=True)
    if not (roll > 0 and pitch > 0):
        raise ConfigError(
            "expected rotors that turn the drone in the direction of their torque, got the opposite. "
            "Check the order of the rotors and the frames of attitude and angular velocity."
        )
    inertia = np.diag(np.asarray(params.J, np.float64))
    x, y = 1 / roll / inertia[0], 1 / pitch / inertia[1]
    z = (x * inertia[0] + y * inertia[1]) / (inertia[0] + inertia[1])
    inertia = inertia * [x, y, z]
    values = np.array([x, y, z, max(drag, 0.0) * inertia[2], max(reaction, 0.0) * inertia[2]])
    tilt = np.array(deviations[:2]) / [roll, pitch]
    turn = np.hypot(*(tilt * inertia[:2])) / np.sum(inertia[:2])
    spread = [*tilt * [x, y], turn * z, *inertia[2] * np.array(deviations[2:])]
    every = median(found[:, 4], np.ones(len(found)))[0]
    delays = [median(b[:, 4], b[:, 5])[0] if len(b) else every for b in blocks]
    return FastRotation(values, np.array(spread), np.array(delays))


def aligned(log: Log, delay: float) -> Log:
    """Return the log with rotor speeds and commands that are later by a delay, s."""

    def late(x: NDArray) -> NDArray:
        return np.stack([np.interp(log.t - delay, log.t, c) for c in x.T], axis=-1)

    command = None if log.command is None else late(log.command)
    return replace(log, rotor_vel=late(log.rotor_vel), command=command)


def median(x: NDArray, variance: NDArray) -> tuple[float, float]:
    """Return the median, weighted by inverse variances, and its standard deviation from the scatter.

    The standard deviation is NaN for fewer than ``FEWEST`` numbers.
    """
    weight = 1 / np.maximum(variance, 0.25 * np.median(variance))  # so that no single block decides

    def middle(x: NDArray) -> float:
        order = np.argsort(x)
        return float(x[order][np.searchsorted(np.cumsum(weight[order]), 0.5 * np.sum(weight))])

    center = middle(x)
    if len(x) < FEWEST:
        return center, math.nan
    count = np.sum(weight) ** 2 / np.sum(weight**2)
    # 1.4826: from the median absolute to the standard deviation; 1.2533: of the median over that of the mean (Gauss).
    return center, 1.4826 * 1.2533 * middle(np.abs(x - center)) / np.sqrt(count)


class _Prepared(NamedTuple):
    """One log as the regression uses it."""

    dt: float
    gaps: NDArray
    turned: NDArray
    """Change of the angular velocity over two samples, plus that of gyroscopic torques, rad/s. (n, 3)"""
    ang_vel: NDArray
    torque: NDArray
    """Torque of the rotors' thrusts about x and y, and of their drag about z, N m. (n, 3)"""
    reaction: NDArray
    """Torque about z of the rotors' acceleration, N m. (n,)"""
    instrument: NDArray
    """As ``torque``, of the speeds that commands explain. (n, 3)"""
    instrument_reaction: NDArray
    """As ``reaction``, of the speeds that commands explain. (n,)"""

    @staticmethod
    def create(log: Log, params: first_principles.Params, thrust_factor: float) -> _Prepared:
        mixing, arm = np.asarray(params.mixing_matrix, np.float64), float(params.L[0])
        inertia = np.asarray(params.J, np.float64)
        curves = [np.atleast_2d(np.asarray(c, np.float64)) for c in (params.rpm2thrust, params.rpm2torque)]
        rotor_inertia = np.asarray(params.prop_inertia, np.float64) * RPM_TO_RAD_S

        def torques(speed: NDArray) -> tuple[NDArray, NDArray]:
            thrust, drag = [c[:, 0] + speed * (c[:, 1] + speed * c[:, 2]) for c in curves]
            tilt = thrust_factor * arm * thrust @ mixing[:2].T
            # The drag of the air on rotors and their acceleration turn the body the same way.
            spin = (rotor_inertia * np.gradient(speed, log.dt, axis=0)) @ mixing[2]
            return np.c_[tilt, drag @ mixing[2]], spin

        w, dt = log.ang_vel, log.dt
        gyro = np.linalg.solve(inertia, np.cross(w, w @ inertia).T).T
        change = np.zeros_like(w)
        change[1:-1] = w[2:] - w[:-2]
        speeds = log.rotor_vel if log.command is None else _explained(log)
        return _Prepared(
            dt, log.gaps, change + _over_two(gyro, dt), w, *torques(log.rotor_vel), *torques(speeds)
        )  # fmt: skip


def _explained(log: Log) -> NDArray:
    """Return the rotor speeds that commands explain: a finite impulse response, and squares. (n, n_rotors)"""
    n, count = len(log.t), round(LAGS / log.dt)
    index = np.clip(np.arange(n)[:, None] - np.arange(-1, count)[None], 0, n - 1)
    speeds = []
    for command, speed in zip(np.asarray(log.command).T, log.rotor_vel.T, strict=True):
        terms = np.c_[np.ones(n), command[index], command[index[:, 1:6]] ** 2]
        speeds.append(terms @ np.linalg.lstsq(terms, speed, rcond=None)[0])
    return np.stack(speeds, axis=-1)


def _over_two(x: NDArray, dt: float) -> NDArray:
    """Return the integral over the two intervals around each sample (Simpson's rule)."""
    total = np.zeros_like(x)
    total[1:-1] = (x[:-2] + 4 * x[1:-1] + x[2:]) * (dt / 3)
    return total


def _band(x: NDArray, dt: float, slow: float) -> NDArray:
    """Return the band-passed signal. (n, k)"""

    def smooth(width: float) -> NDArray:
        size = 2 * max(1, round(width / dt / 2)) + 1
        kernel = np.hanning(size + 2)[1:-1]
        return np.stack([np.convolve(c, kernel / kernel.sum(), "same") for c in x.T], axis=-1)

    return smooth(FAST) - smooth(slow)


def _blocks(d: _Prepared) -> NDArray:
    """Return the solution of each block.

    Coefficients of torque about x and y, of drag torque and of reaction; delay; variances of the coefficients.
    (n_blocks, 9)
    """
    n, margin = len(d.turned), round(YAW_SLOW / d.dt / 2)
    keep = np.ones(n, bool)
    for at in (0, *d.gaps, n):
        keep[max(0, at - margin) : at + margin] = False
    size, found = max(1, round(BLOCK / d.dt)), []
    for k in range(0, n, size):
        at = np.flatnonzero(keep[k : k + size]) + k
        if len(at) * d.dt < 1:
            continue
        delay = 0.0
        for _ in range(6):
            tilt = [_solved(d, axis, delay, at) for axis in (0, 1)]
            # Torque and its rate over time: torque(t - e) = torque - e rate.
            delay -= float(np.mean([x[1] / x[0] for x, _ in tilt]))
            delay = float(np.clip(delay, -LONGEST, LONGEST))
        turn, variance = _solved(d, 2, delay, at)
        found.append([*(x[0] for x, _ in tilt), *turn[:2], delay, *(v[0] for _, v in tilt), *variance[:2]])
    return np.reshape(found, (-1, 9))


def _solved(d: _Prepared, axis: int, delay: float, at: NDArray) -> tuple[NDArray, NDArray]:
    """Return the coefficients of the regressors and their variances, at some samples.

    Regressors are torque and rate of the torque about x and y, drag torque and reaction of the rotors about z; after
    them the angular velocity.
    """
    times = np.arange(len(d.turned), dtype=float)

    def late(x: NDArray) -> NDArray:
        return np.interp(times - delay / d.dt, times, x)

    def terms(torque: NDArray, reaction: NDArray) -> NDArray:
        first = late(torque[:, axis])
        second = late(reaction) if axis == 2 else np.gradient(first, d.dt)
        return _over_two(np.c_[first, second, d.ang_vel[:, axis]], d.dt)

    slow = YAW_SLOW if axis == 2 else SLOW
    regressors, instruments, turned = (
        _band(x, d.dt, slow)[at]
        for x in (terms(d.torque, d.reaction), terms(d.instrument, d.instrument_reaction), d.turned[:, axis : axis + 1])
    )
    inverse = np.linalg.pinv(instruments.T @ regressors)
    x = inverse @ instruments.T @ turned[:, 0]
    rest = turned[:, 0] - regressors @ x
    return x, np.mean(rest**2) * np.diag(inverse @ (instruments.T @ instruments) @ inverse.T)
