"""Moments of inertia, torque curve and delay from fast rotation, by linear regression.

Over a fraction of a second, aerodynamic torques of the flow around the drone are several times larger than the torques
that turn it, and no simple model predicts them within a few percent. A fit of long predictions therefore explains them
by moments of inertia that are far too large, which make the prediction insensitive to its torques. Fast rotation does
not have this problem: above a few hertz, the torque of the rotors turns the body. Both sides of the equation of motion
are therefore band-passed.

Telemetry of rotor speeds is held, quantised and late, which biases coefficients towards zero (errors in variables).
Commands have no such errors. If a log has commands, they are the instruments of two-stage least squares.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from crazysim.dynamics import first_principles
from crazysim.dynamics.rotor import RPM_TO_RAD_S
from crazysim.errors import require
from crazysim.lab.identify.logs import Log

FAST_WIDTH, SLOW_WIDTH, YAW_SLOW_WIDTH = 0.05, 0.33, 1.0
"""Widths of the Hann windows whose difference is the band-pass, s: about 3 to 20 Hz, and 1 to 20 Hz about z."""
RESPONSE_DURATION = 0.15
"""Duration of the response from commands to rotor speeds, s."""
BLOCK_DURATION = 10.0
"""Duration of the blocks of a log that are solved separately, each with its delay, s."""
PIECE_DURATION = 2.0
"""Duration of the pieces of a log whose influences on a fit give its standard deviation, s."""
MIN_PIECES = 5
"""Fewest pieces whose scatter gives a standard deviation."""
MAX_DELAY = 0.04
"""Largest delay, s."""
SAMPLING_ERROR = 5e-4
"""Relative error of integrals between samples, which is the same in all blocks. In simulated flights without noise, at
100 and 500 Hz, it changed moments of inertia by 0.04 to 0.12%."""
YAW_DELAY_STD = 0.03
"""Standard deviation of the delay of yaw torques, samples. Where the command of a motor changes at a sample, its speed
has a corner that quadrature rounds off: in simulated flights at 100 Hz, delays came out 0.01 to 0.04 samples short."""
MEDIAN_OVER_MEAN = 1.2533
"""Ratio of the standard deviations of median and mean of normal numbers, the root of pi / 2."""
MAX_ITERATIONS = 50
"""Largest number of fits, each with gyroscopic torques from the moments of inertia of the previous fit."""


class FastRotation(NamedTuple):
    """Moments of inertia, torque curve and delays, with deviations."""

    values: NDArray
    """Factors of the moments of inertia about x, y, z, of the torque curve and of the rotors' inertia. (5,)"""
    deviations: NDArray
    """Standard deviations, from ``deviation_of_sum``, ``SAMPLING_ERROR``, the change in a narrower band and that by the
    last iteration. (5,)"""
    delays: NDArray
    """Delay of the state behind the rotor speeds in each log, s. (n_logs,)"""
    delay_deviation: float
    """Standard deviation of the mean of the delays, s."""


def fast_rotation(logs: Sequence[Log], params: first_principles.Params, thrust_factor: float = 1.0) -> FastRotation:
    """Fit moments of inertia, torque curve and delays to the fast rotation of logs.

    About x and y, thrust and arms give the torque, and therefore the scale of the moments of inertia. About z, only the
    ratios of drag torque and rotor inertia to the moment of inertia are observable. The moment about z is therefore
    assumed to be in the same proportion to the moments about x and y as in the airframe. Results are weighted medians
    over blocks, because streams of telemetry drift against each other and lose packets, which spoils single blocks.

    Noise of rotor speeds, filters of the state and integrals between samples bias a fit the more, the higher its
    frequencies. A fit in a band of half the upper limit shows how much.

    Args:
        logs: Logs of the same sample time.
        params: Parameters of the airframe.
        thrust_factor: Factor of the airframe's thrust curve.

    Raises:
        ConfigError: If the rotors turn the drone against their torque, or the logs are too short.
    """
    moments = np.diag(np.asarray(params.J, np.float64))
    values, delays = np.ones(5), np.zeros(len(logs))
    for _ in range(MAX_ITERATIONS):
        last_values = values
        log_terms = [
            _LogTerms.create(log, params, thrust_factor, values, delay) for log, delay in zip(logs, delays, strict=True)
        ]
        medians, delays, influences = _solve_logs(log_terms, FAST_WIDTH)
        roll, pitch, drag, reaction = medians[:4]
        require(
            roll > 0 and pitch > 0,
            "expected rotors that turn the drone in the direction of their torque, got the opposite. "
            "Check the order of the rotors and the frames of attitude and angular velocity.",
        )
        x_factor, y_factor = 1 / roll / moments[0], 1 / pitch / moments[1]
        z_factor = (x_factor * moments[0] + y_factor * moments[1]) / (moments[0] + moments[1])
        rotor_factors = (max(c, 0.0) * moments[2] * z_factor for c in (drag, reaction))
        values = np.array([x_factor, y_factor, z_factor, *rotor_factors])
        # Figure eights of 1.5 to 3 rad/s needed 7 to 18 iterations, a flight with fast turns 4.
        if np.all(np.abs(values - last_values) < 0.02 * SAMPLING_ERROR):
            break
    slow_medians, _, slow_influences = _solve_logs(log_terms, 2 * FAST_WIDTH)
    change = slow_medians - medians
    chance = deviation_of_sum(slow_influences - influences)
    # What exceeds chance is bias. It grows with the square of the frequency, so a quarter of it is in both bands.
    bias = 4 / 3 * np.sqrt(np.maximum(change**2 - np.nan_to_num(chance) ** 2, 0.0))
    yaw_change = _solve_logs(log_terms, FAST_WIDTH, has_corners=True)[0] - medians
    deviations = np.sqrt(deviation_of_sum(influences) ** 2 + bias**2 + yaw_change**2)
    inertia = moments * values[:3]
    relative_deviations = deviations[:2] / [roll, pitch]
    mean_tilt_deviation = np.hypot(*(relative_deviations * inertia[:2])) / np.sum(inertia[:2])
    deviation = np.hypot(
        [
            *relative_deviations * [x_factor, y_factor],
            mean_tilt_deviation * z_factor,
            *np.hypot(inertia[2] * deviations[2:4], mean_tilt_deviation * values[3:]),
        ],
        np.hypot(SAMPLING_ERROR * values, values - last_values),
    )
    return FastRotation(values, deviation, delays, float(deviations[4]))


def aligned(log: Log, delay: float) -> Log:
    """Delay the rotor speeds and commands of a log by ``delay``, s."""
    command = None if log.command is None else shift_series(log.command, delay / log.dt)
    return replace(log, rotor_vel=shift_series(log.rotor_vel, delay / log.dt), command=command)


def weighted_medians(x: NDArray, variances: NDArray) -> tuple[NDArray, NDArray]:
    """Return the medians of columns, weighted by inverse variances, (k,), and the weights, which sum to 1. (n, k)"""
    weights = 1 / np.maximum(variances, 0.25 * np.median(variances, axis=0))  # so that no single block decides
    weights = weights / np.sum(weights, axis=0)
    medians = []
    for column, weight in zip(x.T, weights.T, strict=True):
        order = np.argsort(column)
        cumulative_weight = np.cumsum(weight[order]) - 0.5 * weight[order]
        medians.append(np.interp(0.5, cumulative_weight, column[order]))
    return np.array(medians), weights


def sum_pieces(influences: NDArray, duration: float) -> NDArray:
    """Return sums of the influences of samples over pieces of ``PIECE_DURATION``. (n_pieces, ...)"""
    n_pieces = max(1, round(duration / PIECE_DURATION))
    return np.array([piece.sum(axis=0) for piece in np.array_split(influences, n_pieces)])


def deviation_of_sum(influences: NDArray) -> NDArray:
    """Return standard deviations of sums of influences that are correlated with their neighbours. (k,)

    An influence is the change of a fitted number by a piece of the logs. Errors of neighbouring pieces are correlated,
    so the products of neighbours count, too (Newey and West 1987, Econometrica 55, 703-708), over a number of pieces
    that grows with the cube root of their number. The deviations are NaN for fewer than ``MIN_PIECES``.

    Args:
        influences: Influences of consecutive pieces. (n, k)
    """
    n = len(influences)
    if n < MIN_PIECES:
        return np.full(influences.shape[1], np.nan)
    n_neighbours = round(n ** (1 / 3)) - 1
    centred = influences - influences.mean(axis=0)
    variance = np.sum(centred**2, axis=0)
    for k in range(1, n_neighbours + 1):
        variance += 2 * (1 - k / (n_neighbours + 1)) * np.sum(centred[k:] * centred[:-k], axis=0)
    n_independent = n / (1 + n_neighbours / 2)
    return deviation_factor(n_independent) * np.sqrt(np.maximum(variance, 0.0) * n / (n - 1))


def deviation_factor(n: float) -> float:
    """Return the factor by which a standard deviation from n numbers must be larger for the same confidence.

    It is the ratio of the quantiles of Student's t distribution with n - 1 degrees of freedom and the normal
    distribution, by the expansion of Abramowitz and Stegun, Handbook of Mathematical Functions, 26.7.5, at three
    standard deviations.
    """
    v = n - 1
    return (3 + 30 / (4 * v) + 1656 / (96 * v**2) + 11592 / (384 * v**3)) / 3


class _LogTerms(NamedTuple):
    """Terms of the regression for one log, over the two intervals around each sample."""

    dt: float
    """Interval between samples, s."""
    gaps: NDArray
    """Indices of samples that follow a gap. (n_gaps,)"""
    ang_vel_change: NDArray
    """Change of the angular velocity, plus the change by gyroscopic torques, rad/s. (n, 3)"""
    angle: NDArray
    """Integral of the angular velocity, rad. (n, 3)"""
    rotors: _Rotors
    """Thrusts and torques at the measured rotor speeds."""
    instruments: _Rotors
    """Thrusts and torques at the rotor speeds that commands explain."""

    @staticmethod
    def create(
        log: Log, params: first_principles.Params, thrust_factor: float, values: NDArray, delay: float
    ) -> _LogTerms:
        mixing, arm = np.asarray(params.mixing_matrix, np.float64), float(params.L[0])
        root = np.sqrt(values[:3])
        inertia = np.asarray(params.J, np.float64) * np.outer(root, root)
        curves = [np.atleast_2d(np.asarray(c, np.float64)) for c in (params.rpm2thrust, params.rpm2torque)]
        rotor_inertia = np.asarray(params.prop_inertia, np.float64) * RPM_TO_RAD_S

        def make_rotors(speed: NDArray) -> _Rotors:
            thrust, drag = [c[:, 0] + speed * (c[:, 1] + speed * c[:, 2]) for c in curves]
            thrust = thrust_factor * thrust
            torque = np.c_[arm * thrust @ mixing[:2].T, drag @ mixing[2]]
            # The drag of the air on rotors and their acceleration turn the body the same way.
            reaction = _centred_change((rotor_inertia * speed) @ mixing[2])
            return _Rotors(
                _two_interval_integral(torque, log.dt),
                _centred_change(torque),
                reaction,
                _two_interval_integral(thrust.sum(axis=1), log.dt),
            )

        w, dt = log.ang_vel, log.dt
        spin = np.zeros_like(w)
        spin[:, 2] = -values[4] * (rotor_inertia * shift_series(log.rotor_vel, delay / dt)) @ mixing[2]
        gyro = np.linalg.solve(inertia, np.cross(w, w @ inertia + spin).T).T
        speeds = log.rotor_vel if log.command is None else _fit_speeds(log)
        return _LogTerms(
            dt,
            log.gaps,
            _centred_change(w) + _two_interval_integral(gyro, dt),
            _two_interval_integral(w, dt),
            make_rotors(log.rotor_vel),
            make_rotors(speeds),
        )


class _Rotors(NamedTuple):
    """Thrusts and torques of rotors over the two intervals around each sample."""

    impulse: NDArray
    """Integral of the torque of the thrusts about x and y, and of the drag about z, N m s. (n, 3)"""
    torque_change: NDArray
    """Change of the torques whose integral is ``impulse``, N m. (n, 3)"""
    reaction: NDArray
    """Integral of the torque about z of the rotors' acceleration, N m s. (n,)"""
    thrust_impulse: NDArray
    """Integral of the collective thrust, N s. (n,)"""


def _fit_speeds(log: Log) -> NDArray:
    n, count = len(log.t), round(RESPONSE_DURATION / log.dt)
    index = np.clip(np.arange(n)[:, None] - np.arange(-1, count)[None], 0, n - 1)
    speeds = []
    for command, speed in zip(np.asarray(log.command).T, log.rotor_vel.T, strict=True):
        terms = np.c_[np.ones(n), command[index], command[index[:, 1:6]] ** 2]
        speeds.append(terms @ np.linalg.lstsq(terms, speed, rcond=None)[0])
    return np.stack(speeds, axis=-1)


def _centred_change(x: NDArray) -> NDArray:
    change = np.zeros_like(x)
    change[1:-1] = x[2:] - x[:-2]
    return change


def _two_interval_integral(x: NDArray, dt: float) -> NDArray:
    total = np.zeros_like(x)
    total[2:-2] = (114 * x[2:-2] + 34 * (x[1:-3] + x[3:-1]) - x[:-4] - x[4:]) * (dt / 90)
    return total


def _band_pass(x: NDArray, dt: float, fast_width: float, slow_width: float) -> NDArray:
    def smooth_columns(width: float) -> NDArray:
        size = 2 * max(1, round(width / dt / 2)) + 1
        kernel = np.hanning(size + 2)[1:-1]
        return np.stack([np.convolve(c, kernel / kernel.sum(), "same") for c in x.T], axis=-1)

    return smooth_columns(fast_width) - smooth_columns(slow_width)


class _Block(NamedTuple):
    """Solution of a block: the coefficients of torque about x and y, of drag torque and of reaction, and the delay."""

    solution: NDArray
    """Coefficients, and the delay, s. (5,)"""
    variances: NDArray
    """Variances of the coefficients, if residuals were independent. (4,)"""
    influences: NDArray
    """Influences of the residuals of each piece on the solution. (n_pieces, 5)"""


def _solve_logs(
    logs: Sequence[_LogTerms], fast_width: float, *, has_corners: bool = False
) -> tuple[NDArray, NDArray, NDArray]:
    # The influences are those on the medians, and on the mean of the delays. With ``has_corners``, rotor speeds are
    # straight lines between samples for yaw, with ``YAW_DELAY_STD``: as if all their curvature were corners at samples.
    blocks = [_solve_blocks(log, fast_width, has_corners) for log in logs]
    all_blocks = list(itertools.chain.from_iterable(blocks))
    require(all_blocks, f"expected logs of over {YAW_SLOW_WIDTH + 1:g} s without gaps, got none. Use longer logs.")
    variances = np.array([[*b.variances, b.variances[0]] for b in all_blocks])
    variances[:, 4] = 1.0
    medians, shares = weighted_medians(np.array([b.solution for b in all_blocks]), variances)
    delays, influences = [], []
    for log_blocks in blocks:
        delays.append(medians[4])
        if log_blocks:
            delays[-1] = weighted_medians(
                np.array([b.solution[4:] for b in log_blocks]), np.array([b.variances[:1] for b in log_blocks])
            )[0][0]
        centre = np.array([*medians[:4], delays[-1]])
        influences += [b.influences + (b.solution - centre) / len(b.influences) for b in log_blocks]
    efficiency = MEDIAN_OVER_MEAN if len(all_blocks) >= 3 else 1.0
    return (
        medians,
        np.array(delays),
        np.concatenate([efficiency * w * x for w, x in zip(shares, influences, strict=True)]),
    )


def _solve_blocks(log_terms: _LogTerms, fast_width: float, has_corners: bool) -> list[_Block]:
    dt, n, margin = log_terms.dt, len(log_terms.ang_vel_change), round(YAW_SLOW_WIDTH / log_terms.dt / 2)
    is_kept = np.ones(n, bool)
    for gap in (0, *log_terms.gaps, n):
        is_kept[max(0, gap - margin) : gap + margin] = False
    size, blocks = max(1, round(BLOCK_DURATION / dt)), []
    for k in range(0, n, size):
        indices = np.flatnonzero(is_kept[k : k + size]) + k
        if len(indices) * dt < 1:
            continue
        delay = 0.0
        for _ in range(6):
            tilt_fits = [_solve_samples(log_terms, axis, delay, indices, fast_width) for axis in (0, 1)]
            # Torque and its rate over time: torque(t - e) = torque - e rate.
            delay -= float(np.mean([fit[0][1] / fit[0][0] for fit in tilt_fits]))
            delay = float(np.clip(delay, -MAX_DELAY, MAX_DELAY))
        (roll, roll_variance, roll_influences), (pitch, pitch_variance, pitch_influences) = tilt_fits
        yaw, yaw_variance, yaw_influences = _solve_samples(
            log_terms, 2, delay + has_corners * YAW_DELAY_STD * dt, indices, fast_width, 2 if has_corners else 6
        )
        late = -(roll_influences[:, 1] / roll[0] + pitch_influences[:, 1] / pitch[0]) / 2
        samples = np.c_[roll_influences[:, 0], pitch_influences[:, 0], yaw_influences[:, :2], late]
        blocks.append(
            _Block(
                np.array([roll[0], pitch[0], *yaw[:2], delay]),
                np.array([roll_variance[0], pitch_variance[0], *yaw_variance[:2]]),
                sum_pieces(samples, len(indices) * dt),
            )
        )
    return blocks


def _solve_samples(
    log_terms: _LogTerms, axis: int, delay: float, samples: NDArray, fast_width: float, n_taps: int = 6
) -> tuple[NDArray, NDArray, NDArray]:
    # Regressors about x and y are the torque, its rate, and the thrust, for an offset of the centre of mass; about z
    # the drag torque and the reaction of the rotors; about each axis also the angular velocity, as the last regressor.
    # All are integrated over the two intervals around each sample.
    def terms(rotors: _Rotors) -> NDArray:
        if axis == 2:
            columns = rotors.impulse[:, 2], rotors.reaction
        else:
            columns = rotors.impulse[:, axis], rotors.torque_change[:, axis], rotors.thrust_impulse
        return np.c_[shift_series(np.stack(columns, axis=-1), delay / log_terms.dt, n_taps), log_terms.angle[:, axis]]

    slow_width = YAW_SLOW_WIDTH if axis == 2 else SLOW_WIDTH
    regressors, instruments, ang_vel_change = (
        _band_pass(x, log_terms.dt, fast_width, slow_width)[samples]
        for x in (terms(log_terms.rotors), terms(log_terms.instruments), log_terms.ang_vel_change[:, axis : axis + 1])
    )
    inverse = np.linalg.pinv(instruments.T @ regressors)
    x = inverse @ instruments.T @ ang_vel_change[:, 0]
    residual = ang_vel_change[:, 0] - regressors @ x
    variances = np.mean(residual**2) * np.diag(inverse @ (instruments.T @ instruments) @ inverse.T)
    return x, variances, residual[:, None] * (instruments @ inverse.T)


def shift_series(x: NDArray, samples: float, n_taps: int = 6) -> NDArray:
    """Return series delayed by a number of samples, by Lagrange's polynomials through ``n_taps`` samples. (n, k)

    A straight line between two samples would lower a sine of 20 Hz at 100 Hz by up to 19%; six lower it by 1.5%.
    """
    whole_samples = math.floor(samples)
    fraction, taps = samples - whole_samples, np.arange(n_taps) + 1 - n_taps // 2
    shifted, n = np.zeros_like(x), len(x)
    for k in taps:
        other_taps = taps[taps != k]
        weight = np.prod((fraction - other_taps) / (k - other_taps))
        shifted += weight * x[np.clip(np.arange(n) - whole_samples - k, 0, n - 1)]
    return shifted
