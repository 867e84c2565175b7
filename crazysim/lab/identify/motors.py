"""Motors: rotor speeds modelled from commands and voltage where none were measured, and the lag of measured speeds."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from crazysim.drones import Airframe
from crazysim.dynamics.rotor import rotor_acceleration
from crazysim.errors import require
from crazysim.lab.identify.fitted import lag_signal
from crazysim.lab.identify.logs import Log
from crazysim.lab.identify.repairs import MAX_REPAIRED_SHARE
from crazysim.lab.identify.rotation import MEDIAN_OVER_MEAN, deviation_of_sum, sum_pieces

VOLTAGE_WINDOW = 1.0
"""Width of the Hann window over the voltage, s: telemetry is slow and coarse."""
GROUND_MARGIN = 1.0
"""Duration that is left out after take-off and before landing, s."""
MIN_RATE, MAX_RATE = 2.0, 200.0
"""Rates between which the lag of motors is sought, 1/s."""
N_TAPS = 2
"""Number of samples of the command that act on the speed beside its lag."""
MAX_DELAY = 0.04
"""Largest delay between commands and measured speeds, s."""


def with_speeds(log: Log, airframe: Airframe) -> Log:
    """Return the log with rotor speeds, modelled where they were not measured.

    The voltage at a motor is its command times the battery's voltage. The airframe's ``battery.thrust_over_voltage``
    gives the thrust, its thrust curve the speed, and ``rotors.lag`` delays the speed. Motors and propellers differ by a
    few percent, which would cause a larger torque than most manoeuvres. The thrusts of each rotor are therefore scaled
    so that all rotors have the same mean thrust over the flight. Offsets of the centre of mass and constant torques
    cannot be fitted to such logs. Samples before take-off and after landing are left out.

    Args:
        log: Log, whose commands are shares of the battery's voltage, 0 to 1, if it has no speeds.
        airframe: Airframe; without ``battery.thrust_over_voltage`` the log is returned unchanged.
    """
    command, voltage = log.command, log.voltage
    if log.rotor_vel.shape[1] or command is None or voltage is None or command.shape[1] != airframe.n_rotors:
        return log
    if "battery.thrust_over_voltage" not in airframe.values:
        return log
    # Commands from 0 to 1.
    is_valid = (command >= 0) & (command <= 1)
    require(
        np.sum(~is_valid) <= MAX_REPAIRED_SHARE * is_valid.size,
        f"{log.name}: expected commands from 0 to 1, shares of the battery's voltage, got {command.min():.4g} to "
        f"{command.max():.4g}. Give share_per_command, such as 1.5259e-05 for 0 to 65535.",
    )
    command = np.stack([np.interp(log.t, log.t[g], c[g]) for c, g in zip(command.T, is_valid.T, strict=True)], axis=-1)
    # Thrust from the smoothed voltage at each motor.
    half_window = max(1, round(VOLTAGE_WINDOW / log.dt / 2))
    window = np.hanning(2 * half_window + 3)[1:-1]
    volts = np.convolve(np.pad(voltage, half_window, mode="edge"), window / window.sum(), "valid")[:, None] * command
    thrust = np.maximum(np.polynomial.polynomial.polyval(volts, airframe.value("battery.thrust_over_voltage")), 0.0)
    total_thrust = thrust.sum(axis=1)
    # Motors differ: each gets the same mean thrust.
    mean_thrusts = thrust[total_thrust > np.median(total_thrust) / 2].mean(axis=0)
    commanded = np.asarray(airframe.rotor_vel(thrust * mean_thrusts.mean() / mean_thrusts), np.float64)
    repairs = [*log.repairs, "modelled the rotor speeds from commands and voltage"]
    if not np.all(is_valid):
        repairs.append(f"interpolated {np.sum(~is_valid)} commands that were not from 0 to 1")
    speeds = _lagged_speeds(commanded, np.diff(log.t), np.atleast_2d(airframe.value("rotors.lag")))
    # Only samples in the air, away from the ground.
    flying_indices, margin = (
        np.flatnonzero(total_thrust > 0.75 * np.median(total_thrust)),
        round(GROUND_MARGIN / log.dt),
    )
    first_index = flying_indices[0] + margin
    airborne = slice(first_index, max(flying_indices[-1] - margin, first_index))
    repairs.append(
        f"left out {airborne.start} samples at the start and {len(log.t) - airborne.stop} at the end, near the ground"
    )
    data = {key: x[airborne] for key, x in vars(log).items() if isinstance(x, np.ndarray) and key != "gaps"}
    data |= {"command": command[airborne], "rotor_vel": speeds[airborne]}
    gaps = log.gaps[(log.gaps > airborne.start) & (log.gaps < airborne.stop)] - airborne.start
    return replace(log, **data, modelled=True, gaps=gaps, repairs=tuple(repairs))


def _lagged_speeds(commanded: NDArray, dt: NDArray, lag: NDArray) -> NDArray:
    def step(speed: jax.Array, x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        cmd, duration = x
        speed_error = cmd - speed
        rate = rotor_acceleration(cmd, speed, jnp.asarray(lag)) / jnp.where(speed_error == 0, 1.0, speed_error)
        new_speed = speed - speed_error * jnp.expm1(-rate * duration)
        return new_speed, new_speed

    first_speed = jnp.asarray(commanded[0])
    _, speeds = jax.jit(lambda *x: jax.lax.scan(step, first_speed, x))(jnp.asarray(commanded[:-1]), jnp.asarray(dt))
    return np.concatenate([commanded[:1], np.asarray(speeds, np.float64)])


def motor_lag(logs: Sequence[Log]) -> NDArray:
    """Fit the rate of a first-order lag between commands and measured speeds of each rotor, 1/s.

    A speed is a linear function of the lagged command and the lagged square of the command, delayed by the telemetry.
    Rate and delay minimise the squared residuals, so that noise of the speeds does not bias them.

    Args:
        logs: Logs with commands and measured speeds; logs without them, or with modelled speeds, are left out.

    Returns:
        Rates, NaN where no rate from 2 to 200 1/s is best. (n_logs with both, n_rotors)
    """
    return np.array([[fit.rate for fit in rotors] for rotors in _fit_logs(logs, N_TAPS)])


def mean_motor_lag(logs: Sequence[Log]) -> tuple[float, float] | None:
    """Return the median rate of all rotors and its standard deviation, 1/s, or None if most rotors have no rate.

    Commands that change between samples bias the rate, in either direction: the samples do not show how. A fit with
    another interpolation of the commands is off by another bias, so the deviation contains the difference.
    """
    fits, other_fits = (list(itertools.chain.from_iterable(_fit_logs(logs, n))) for n in (N_TAPS, N_TAPS + 1))
    pairs = [(a, b) for a, b in zip(fits, other_fits, strict=True) if np.isfinite(a.rate) and np.isfinite(b.rate)]
    if 2 * len(pairs) <= len(fits):
        return None
    rates, other_rates = (np.array([fit.rate for fit in column]) for column in zip(*pairs, strict=True))
    # Rotors of a flight share their manoeuvres: the influences of a piece of the flight on all of them are added.
    n_pieces = max(len(a.influences) for a, _ in pairs)
    influences = np.sum([np.pad(a.influences, (0, n_pieces - len(a.influences))) for a, _ in pairs], axis=0)
    chance = deviation_of_sum(influences[:, None])[0] / len(pairs)
    scatter = np.std(rates, ddof=1) / math.sqrt(len(rates)) if len(rates) > 1 else 0.0
    bias = float(np.median(other_rates - rates))
    return float(np.median(rates)), float(MEDIAN_OVER_MEAN * math.hypot(chance, scatter, bias))


class _RateFit(NamedTuple):
    """Rate of the lag of a rotor, 1/s, and the influences of pieces of its log on it. (n_pieces,)"""

    rate: float
    influences: NDArray


def _fit_logs(logs: Sequence[Log], n_taps: int) -> list[list[_RateFit]]:
    fits = []
    for log in logs:
        if log.modelled or log.command is None or not log.rotor_vel.shape[1]:
            continue
        if log.command.shape != log.rotor_vel.shape:
            continue
        t = np.arange(log.t[0], log.t[-1], log.dt)
        series = [[np.interp(t, log.t, c) for c in x.T] for x in (log.command, log.rotor_vel)]
        fits.append([_fit_rate(u, r, log.dt, n_taps) for u, r in zip(*series, strict=True)])
    return fits


def _fit_rate(command: NDArray, speed: NDArray, dt: float, n_taps: int) -> _RateFit:
    # The speed is a sum of ``n_taps`` lagged commands that are a sample later each, and of their squares. Two of them
    # are exact for any delay between samples of a command that is held; a single one would have to be a straight line
    # between samples.
    terms = np.c_[command, command**2] / max(np.max(np.abs(command)), 1e-30) ** [1, 2]
    n_delays, n = round(MAX_DELAY / dt), len(speed)
    inner = np.arange(round(0.5 / dt), n - n_delays)
    target = speed[inner]

    def regressors(response: NDArray, delay: int) -> NDArray:
        columns = [response[np.minimum(inner - delay - tap, n - 1)] for tap in range(n_taps)]
        return np.concatenate([*columns, np.ones((len(inner), 1))], axis=1)

    # Rates and delays on a grid, refined around the best.
    rates, delays = np.geomspace(MIN_RATE, MAX_RATE, 15), range(-n_delays, n_delays + 1)
    rate, delay = 0.0, 0
    for _ in range(6):
        responses, best_cost = lag_signal(terms[:, None], dt, rates[:, None]), np.inf
        for k, d in itertools.product(range(len(rates)), delays):
            x = regressors(responses[:, k], d)
            coefficients = np.linalg.lstsq(x.T @ x, x.T @ target, rcond=1e-14)[0]
            residual = target - x @ coefficients
            if (cost := float(residual @ residual)) < best_cost:
                best_cost, rate, delay = cost, float(rates[k]), d
        ratio = rates[1] / rates[0]
        rates, delays = np.geomspace(rate / ratio, rate * ratio, 7), range(delay - 1, delay + 2)
    if not 1.05 * MIN_RATE < rate < MAX_RATE / 1.05:
        return _RateFit(np.nan, np.zeros(0))
    # Influence of each sample, linearised about the best rate.
    lower, middle, upper = (
        regressors(x, delay)
        for x in np.moveaxis(lag_signal(terms[:, None], dt, rate * np.array([[0.99], [1.0], [1.01]])), 1, 0)
    )
    coefficients = np.linalg.lstsq(middle.T @ middle, middle.T @ target, rcond=1e-14)[0]
    slope = (upper - lower) @ coefficients / (0.02 * rate)
    residual = target - middle @ coefficients
    slope -= middle @ np.linalg.lstsq(middle.T @ middle, middle.T @ slope, rcond=1e-14)[0]
    influences = residual * slope / (slope @ slope)
    return _RateFit(rate, sum_pieces(influences, len(influences) * dt))
