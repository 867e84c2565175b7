"""Dynamics models: their names, which airframes support them, and parameters that follow from an airframe."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping
from enum import StrEnum
from typing import Any, Self, dataclass_transform

import numpy as np
from jax import Array

from crazysim.drones import Airframe, AirframeSource, Drone, load_airframe
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.engine.pytree import PyTree, as_parameter, leaf, static
from crazysim.errors import ConfigError, UnknownNameError, require

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


def part(source: type[AirframeParams] | Callable[[Airframe], PyTree]) -> Any:
    """Declare a record within ``AirframeParams``, by its class or by the function that makes it for an airframe."""
    return dataclasses.field(metadata={"airframe": source})


@dataclass_transform(frozen_default=True, field_specifiers=(leaf, static, part, dataclasses.field))
class AirframeParams(PyTree):
    """Base class of parameters that follow from an airframe, each shared or one per drone.

    A leaf declares where its number comes from: ``kp: Array = leaf("parameter", 1, (3,), airframe="mellinger.kp")``,
    or a function of the airframe. ``part`` declares a record of such leaves.
    """

    @classmethod
    def numbers(cls, airframe: Airframe, but: Collection[str] = ()) -> dict[str, Any]:
        """Return numbers, in float64, and parts that an airframe gives to all declared fields ``but`` some."""
        metadata = {field.name: field.metadata for field in dataclasses.fields(cls) if field.name not in but}
        return {name: _read(airframe, x) for name, x in metadata.items() if x.get("airframe") is not None}

    @classmethod
    def create(cls, airframe: Airframe, **values: Any) -> Self:
        """Return the shared parameters of an airframe.

        Args:
            values: Values of fields without a declaration, or in place of it.
        """
        metadata = {field.name: field.metadata for field in dataclasses.fields(cls)}
        numbers = cls.numbers(airframe, but=values) | values
        return cls(**{name: _as_leaf(x, metadata[name]) for name, x in numbers.items()})


class BodyParams(AirframeParams):
    """Mass, gravity and inertia of a drone, or those that its controller assumes."""

    mass: Array = leaf("parameter", 1, (1,), airframe="rigid_body.mass")
    """Mass, kg. (1,)"""
    gravity_vec: Array = leaf("parameter", 1, airframe=lambda _: GRAVITY)
    """Gravitational acceleration, world frame, m/s^2. (3,)"""
    J: Array = leaf("parameter", 2, airframe=lambda airframe: airframe.inertia)
    """Inertia about the centre of mass, body frame, kg m^2. (3, 3)"""


def _read(airframe: Airframe, metadata: Mapping[str, Any]) -> Any:
    source, core = metadata["airframe"], metadata.get("core")
    if isinstance(source, str):
        return airframe.value(source, () if core == (1,) else core)
    return (source.create if isinstance(source, type) else source)(airframe)


def _as_leaf(x: Any, metadata: Mapping[str, Any]) -> Any:
    if x is None or isinstance(x, PyTree):
        return x
    has_shape = metadata["core"] is not None
    return as_parameter(np.broadcast_to(x, metadata["core"]) if has_shape else np.array(x, ndmin=metadata["core_ndim"]))


def supported_dynamics(drone: AirframeSource) -> tuple[Dynamics, ...]:
    """Return the models for which an airframe, or anything that ``load_airframe`` accepts, has parameters."""
    airframe = load_airframe(drone)
    fits = airframe.tables.get("fitted", {})
    has_curves = "thrust_curve" in airframe.table("rotors")
    return tuple(d for d in Dynamics if (has_curves if d == Dynamics.first_principles else d.value in fits))


def supported_drones(dynamics: Dynamics | str) -> tuple[Drone, ...]:
    """Return the built-in airframes that have parameters for a model."""
    require(
        dynamics in tuple(Dynamics),
        f"expected dynamics as one of {', '.join(Dynamics)}, got {dynamics!r}",
        UnknownNameError,
    )
    return tuple(drone for drone in Drone if dynamics in supported_dynamics(drone))


def require_support(airframe: Airframe, dynamics: Dynamics) -> None:
    """Check that an airframe has the parameters of a model."""
    supported = supported_dynamics(airframe)
    require(
        dynamics in supported,
        f"expected dynamics that drone {airframe.name!r} has parameters for ({', '.join(supported) or 'none'}), "
        f"got {str(dynamics)!r}. Pass one of these as dynamics=, or add the missing numbers to the airframe.",
    )


def require_freq(airframe: Airframe, dynamics: Dynamics, freq: int) -> None:
    """Check that lags and damping of an airframe are slow enough for the rate of physics steps."""
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
