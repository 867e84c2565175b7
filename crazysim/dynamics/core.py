"""Names of the dynamics models, and which airframes support them."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any

from crazysim.drones import Airframe, Drone, load_airframe
from crazysim.errors import ConfigError, UnknownNameError

GRAVITY = (0.0, 0.0, -9.81)
"""Gravitational acceleration, world frame, m/s^2: the value with which the airframes were identified."""


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


def supported_dynamics(drone: str | Path | Mapping[str, Any] | Airframe) -> tuple[Dynamics, ...]:
    """Return the models for which an airframe, or a source of one as in ``load_airframe``, has parameters."""
    airframe = load_airframe(drone)
    fitted = airframe.tables.get("fitted", {})
    full = "thrust_curve" in airframe.table("rotors")
    return tuple(d for d in Dynamics if (full if d == Dynamics.first_principles else d.value in fitted))


def supported_drones(dynamics: Dynamics | str) -> tuple[Drone, ...]:
    """Return the built-in airframes that have parameters for a model.

    Raises:
        UnknownNameError: If the model does not exist.
    """
    if dynamics not in tuple(Dynamics):
        raise UnknownNameError(f"expected dynamics as one of {', '.join(Dynamics)}, got {dynamics!r}")
    return tuple(drone for drone in Drone if dynamics in supported_dynamics(drone))


def require_support(airframe: Airframe, dynamics: Dynamics) -> None:
    """Check that an airframe has the parameters of a model.

    Raises:
        ConfigError: If it lacks them; the message lists the supported models.
    """
    supported = supported_dynamics(airframe)
    if dynamics not in supported:
        raise ConfigError(
            f"expected dynamics that drone {airframe.name!r} has parameters for ({', '.join(supported) or 'none'}), "
            f"got {dynamics.value!r}. Pass one of these as dynamics=, or add the missing numbers to the airframe."
        )
