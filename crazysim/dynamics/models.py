"""Names of the dynamics models, and which airframes support them."""

from __future__ import annotations

import math
from enum import StrEnum

import numpy as np

from crazysim.drones import Airframe, AirframeSource, Drone, load_airframe
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.errors import ConfigError, UnknownNameError

MAX_LAG_STEP = 1.5
"""Largest ratio of the time step to the time constant of a lag. Euler steps diverge at a ratio of 2; at 1.5, a lag
overshoots by half its error."""
GRAVITY = (0.0, 0.0, -GRAVITY_MAGNITUDE)
"""Gravitational acceleration, world frame, m/s^2."""


class Dynamics(StrEnum):
    """Dynamics model."""

    first_principles = "first_principles"
    """Rotors with lag, thrust and torque curves, gyroscopic and reaction torque, drag, full inertia."""
    so_rpy = "so_rpy"
    """Second-order response of roll, pitch and yaw, fitted to flights; thrust without lag."""
    so_rpy_rotor = "so_rpy_rotor"
    """``so_rpy`` with a first-order lag of the collective thrust."""
    so_rpy_rotor_drag = "so_rpy_rotor_drag"
    """``so_rpy_rotor`` with linear drag in the body frame."""
    default = first_principles


def supported_dynamics(drone: AirframeSource) -> tuple[Dynamics, ...]:
    """Return the models for which an airframe, or anything that ``load_airframe`` accepts, has parameters."""
    airframe = load_airframe(drone)
    fits = airframe.tables.get("fitted", {})
    has_curves = "thrust_curve" in airframe.table("rotors")
    return tuple(d for d in Dynamics if (has_curves if d == Dynamics.first_principles else d.value in fits))


def supported_drones(dynamics: Dynamics | str) -> tuple[Drone, ...]:
    """Return the built-in airframes that have parameters for a model."""
    if dynamics not in tuple(Dynamics):
        raise UnknownNameError(f"expected dynamics as one of {', '.join(Dynamics)}, got {dynamics!r}")
    return tuple(drone for drone in Drone if dynamics in supported_dynamics(drone))


def require_support(airframe: Airframe, dynamics: Dynamics) -> None:
    """Check that an airframe has the parameters of a model."""
    supported = supported_dynamics(airframe)
    if dynamics not in supported:
        raise ConfigError(
            f"expected dynamics that drone {airframe.name!r} has parameters for ({', '.join(supported) or 'none'}), "
            f"got {dynamics.value!r}. Pass one of these as dynamics=, or add the missing numbers to the airframe."
        )


def require_freq(airframe: Airframe, dynamics: Dynamics, freq: int) -> None:
    """Check that lags and damping of an airframe are slow enough for the rate of physics steps.

    Raises:
        ConfigError: If a rate is above ``MAX_LAG_STEP * freq``; the message states the lowest ``freq`` that suffices
            for the first such rate.
    """
    numbers, mass = airframe.values, airframe.value("rigid_body.mass")
    rates_by_path: dict[str, np.ndarray] = {}
    if dynamics == Dynamics.first_principles:
        drag_path = "drag.coefficients"
        if "rotors.lag" in numbers:
            lag, max_rotor_vel = np.atleast_2d(numbers["rotors.lag"]), airframe.rotor_vel_limits[1]
            rates_by_path["rotors.lag"] = lag[:, 0::2] + 2 * lag[:, 1::2] * max_rotor_vel[:, None]
    else:
        fit_prefix = f"fitted.{dynamics.value}."
        drag_path = f"{fit_prefix}drag_coefficients"
        rates_by_path = {
            path: numbers[path]
            for path in (f"{fit_prefix}rpy_rates_coef", f"{fit_prefix}thrust_dyn_coef")
            if path in numbers
        }
        if f"{fit_prefix}rpy_coef" in numbers and f"{fit_prefix}rpy_rates_coef" in numbers:
            rates_by_path[f"{fit_prefix}rpy_coef"] = (
                numbers[f"{fit_prefix}rpy_coef"] / numbers[f"{fit_prefix}rpy_rates_coef"]
            )
    if drag_path in numbers:
        rates_by_path[drag_path] = numbers[drag_path] / mass
    for path, rates in rates_by_path.items():
        max_rate = float(np.max(np.abs(rates)))
        if max_rate > MAX_LAG_STEP * freq:
            raise ConfigError(
                f"expected {path} of airframe {airframe.name!r} to be slow for steps of 1/{freq} s, got a rate of "
                f"{max_rate:.4g} 1/s. Use freq={math.ceil(max_rate / MAX_LAG_STEP)} or more, or a smaller number."
            )
