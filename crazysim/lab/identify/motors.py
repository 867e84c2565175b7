"""Motors: rotor speeds modelled from commands and voltage where none were measured, and the lag of measured speeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from crazysim.drones import Airframe
from crazysim.dynamics.rotor import rotor_acceleration
from crazysim.dynamics.utils.identification import lag_signal
from crazysim.errors import ConfigError
from crazysim.lab.identify.logs import Log
from crazysim.lab.identify.repairs import MAX_REPAIRED_SHARE

VOLTAGE_WINDOW = 1.0
"""Width of the Hann window over the voltage, s: telemetry is slow and coarse."""
GROUND_MARGIN = 1.0
"""Duration that is left out after take-off and before landing, s."""
MIN_RATE, MAX_RATE = 2.0, 200.0
"""Rates between which the lag of motors is sought, 1/s."""
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
    is_valid = (command >= 0) & (command <= 1)
    if np.sum(~is_valid) > MAX_REPAIRED_SHARE * is_valid.size:
        raise ConfigError(
            f"{log.name}: expected commands from 0 to 1, shares of the battery's voltage, got {command.min():.4g} to "
            f"{command.max():.4g}. Give share_per_command, such as 1.5259e-05 for 0 to 65535."
        )
    command = np.stack([np.interp(log.t, log.t[g], c[g]) for c, g in zip(command.T, is_valid.T, strict=True)], axis=-1)
    half_window = max(1, round(VOLTAGE_WINDOW / log.dt / 2))
    window = np.hanning(2 * half_window + 3)[1:-1]
    volts = np.convolve(np.pad(voltage, half_window, mode="edge"), window / window.sum(), "valid")[:, None] * command
    thrust = np.maximum(np.polynomial.polynomial.polyval(volts, airframe.value("battery.thrust_over_voltage")), 0.0)
    total_thrust = thrust.sum(axis=1)
    mean_thrusts = thrust[total_thrust > np.median(total_thrust) / 2].mean(axis=0)
    commanded = np.asarray(airframe.rotor_vel(thrust * mean_thrusts.mean() / mean_thrusts), np.float64)
    repairs = [*log.repairs, "modelled the rotor speeds from commands and voltage"]
    if not np.all(is_valid):
        repairs.append(f"interpolated {np.sum(~is_valid)} commands that were not from 0 to 1")
    speeds = _lagged_speeds(commanded, np.diff(log.t), np.atleast_2d(airframe.value("rotors.lag")))
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
    """Return the rotor speeds that lag behind commands held between samples, rpm. (n, n_rotors)"""

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
    """Return the rate of a first-order lag between commands and measured speeds of each rotor, 1/s.

    A speed is a linear function of the lagged command and the lagged square of the command, delayed by the telemetry.
    Rate and delay minimise the squared residuals, so that noise of the speeds does not bias them.

    Args:
        logs: Logs with commands and measured speeds; logs without them, or with modelled speeds, are left out.

    Returns:
        Rates, NaN where no rate from 2 to 200 1/s is best. (n_logs with both, n_rotors)
    """
    lags = []
    for log in logs:
        if log.modelled or log.command is None or not log.rotor_vel.shape[1]:
            continue
        if log.command.shape != log.rotor_vel.shape:
            continue
        t = np.arange(log.t[0], log.t[-1], log.dt)
        series = [[np.interp(t, log.t, c) for c in x.T] for x in (log.command, log.rotor_vel)]
        lags.append([_fit_rate(u, r, log.dt) for u, r in zip(*series, strict=True)])
    return np.array(lags)


def _fit_rate(command: NDArray, speed: NDArray, dt: float) -> float:
    """Return the rate of one rotor, 1/s, from a grid of rates and delays that is refined about its best point."""
    terms = np.c_[command, command**2] / max(np.max(np.abs(command)), 1e-30) ** [1, 2]
    rates, delays = np.geomspace(MIN_RATE, MAX_RATE, 15), np.linspace(-MAX_DELAY, MAX_DELAY, 9)
    index, inner_samples = np.arange(len(speed), dtype=float), slice(round(0.5 / dt), None)
    rate = delay = 0.0
    for _ in range(5):
        responses = lag_signal(terms[:, None], dt, rates[:, None])
        best_cost = np.inf
        for d in delays:
            for k, r in enumerate(rates):
                # Shift the response, not the speed: interpolation would reduce the noise of the speed.
                shifted_responses = [np.interp(index - d / dt, index, c)[inner_samples] for c in responses[:, k].T]
                x = np.c_[shifted_responses[0], shifted_responses[1], np.ones(len(shifted_responses[0]))]
                residual = speed[inner_samples] - x @ np.linalg.lstsq(x, speed[inner_samples], rcond=None)[0]
                if (cost := float(residual @ residual)) < best_cost:
                    best_cost, rate, delay = cost, float(r), float(d)
        ratio, width = rates[1] / rates[0], delays[1] - delays[0]
        rates, delays = np.geomspace(rate / ratio, rate * ratio, 9), np.linspace(delay - width, delay + width, 7)
    return rate if 1.05 * MIN_RATE < rate < MAX_RATE / 1.05 else np.nan
