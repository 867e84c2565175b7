"""Parameters of an airframe for dynamics models, as dicts under Crazyflow's names."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

from crazysim.drones import AirframeSource, load_airframe
from crazysim.dynamics import first_principles, fitted
from crazysim.dynamics.models import Dynamics, require_support
from crazysim.errors import ConfigError, UnknownNameError, require


def load_params(
    dynamics: Dynamics | str, drone: AirframeSource, xp: ModuleType | None = None, device: Any = None
) -> dict:
    """Load the parameters of a drone for a dynamics model, in SI units, but rotor speeds in rpm.

    ``thrust_min`` and ``thrust_max`` are limits of one rotor.

    Args:
        drone: Airframe, or anything that ``load_airframe`` accepts.
        xp: Array module of the values, such as ``jax.numpy``; None for NumPy.
        device: Device of the values; None for the module's default.
    """
    require(
        dynamics in tuple(Dynamics),
        f"expected one of {', '.join(Dynamics)} as dynamics, got {dynamics!r}",
        UnknownNameError,
    )
    model, airframe = Dynamics(dynamics), load_airframe(drone)
    require_support(airframe, model)
    limits = {key: airframe.value(f"rotors.{key}", ()) for key in ("thrust_min", "thrust_max")}
    if model == Dynamics.first_principles:
        numbers = first_principles.Params.numbers(airframe)
    else:
        numbers = fitted.Params.numbers(airframe) | fitted.fitted_numbers(airframe, model)
    params = {name: x for name, x in (numbers | limits).items() if not name.startswith("rotor_vel_")}
    return convert_arrays(params, xp, device)


def load_fn_params(
    fn: Callable[..., Any], drone: AirframeSource, xp: ModuleType | None = None, device: Any = None
) -> dict:
    """Load the parameters that ``first_principles.dynamics`` uses.

    Args:
        fn: ``first_principles.dynamics``.
        drone: Airframe, or anything that ``load_airframe`` accepts.
        xp: Array module of the values; None for NumPy.
        device: Device of the values; None for the module's default.
    """
    if fn is not first_principles.dynamics:
        hint = ", which is shared by all fitted models" if fn is fitted.dynamics else ""
        raise ConfigError(f"expected first_principles.dynamics, got {fn!r}{hint}. Use load_params(dynamics, drone).")
    params = load_params(Dynamics.first_principles, drone, xp, device).items()
    return {name: value for name, value in params if name not in ("thrust_min", "thrust_max")}


def rotor_vel_limits(dynamics: Dynamics | str, drone: AirframeSource) -> tuple[float, float]:
    """Return the smallest and largest value of ``states.rotor_vel`` of rotors that are on.

    These are speeds of the first rotor, rpm, or for fitted models collective thrusts, N.
    """
    params, airframe = load_params(dynamics, drone), load_airframe(drone)
    thrusts = airframe.n_rotors * np.array([params["thrust_min"], params["thrust_max"]])
    low, high = airframe.rotor_vel_limits[:, 0] if dynamics == Dynamics.first_principles else thrusts
    return float(low), float(high)


def convert_arrays(params: dict[str, Any], xp: ModuleType | None, device: Any) -> dict[str, Any]:
    as_array = (np if xp is None else xp).asarray
    options = {} if device is None else {"device": device}
    return {
        k: convert_arrays(v, xp, device) if isinstance(v, dict) else as_array(v, **options) for k, v in params.items()
    }
