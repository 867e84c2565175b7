"""Parameters of an airframe for dynamics models and for Crazyflow's controllers, as dicts under Crazyflow's names."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

from crazysim.drones import AirframeSource, load_airframe
from crazysim.dynamics import first_principles, fitted
from crazysim.dynamics.models import GRAVITY, Dynamics, require_support
from crazysim.errors import ConfigError, UnknownNameError

CASCADE_NAME = "mellinger"
"""Crazyflow's name for its cascade of controllers, which is ``"crazyflow"`` here; not the controller ``Mellinger``."""
_CORE_KEYS = ("mass", "mass_thrust", "pwm_min", "pwm_max", "torque_pwm_max", "thrust2torque")
"""Keys of ``[controller]`` for Crazyflow's table ``core``, which all functions of the cascade receive."""
_ROTOR_NAMES = {
    "thrust_curve": "rpm2thrust",
    "torque_curve": "rpm2torque",
    "thrust_min": "thrust_min",
    "thrust_max": "thrust_max",
}
"""Crazyflow's names of keys of ``[rotors]``."""
_STATE_KEYS = ("kp", "kd", "ki", "int_err_max")
"""Keys of ``[controller.state]``."""
_ATTITUDE_KEYS = ("kR", "kw", "ki_m", "kd_omega", "int_err_max")
"""Keys of ``[controller.attitude]``."""
CRAZYFLOW_TABLES: tuple[tuple[str, str, dict[str, str]], ...] = (
    ("core", "controller", {key: key for key in _CORE_KEYS}),
    ("core", "rotors", _ROTOR_NAMES),
    ("state2attitude", "controller.state", {key: key for key in _STATE_KEYS}),
    ("attitude2force_torque", "controller.attitude", {key: key for key in _ATTITUDE_KEYS}),
    ("body_rate2force_torque", "controller.attitude", {key: key for key in _ATTITUDE_KEYS}),
)
"""Name of Crazyflow's table, name of the airframe's table with its values, and Crazyflow's name of each of its keys."""


def load_params(
    dynamics: Dynamics | str, drone: AirframeSource, xp: ModuleType | None = None, device: Any = None
) -> dict:
    """Return the parameters of a drone for a dynamics model, in SI units, but rotor speeds in rpm.

    ``thrust_min`` and ``thrust_max`` are limits of one rotor.

    Args:
        dynamics: Dynamics model.
        drone: Airframe, or anything that ``load_airframe`` accepts.
        xp: Array module of the values, such as ``jax.numpy``; None for NumPy.
        device: Device of the values; None for the module's default.

    Raises:
        ConfigError: If the drone has no parameters for the model.
    """
    if dynamics not in tuple(Dynamics):
        raise UnknownNameError(f"expected one of {', '.join(Dynamics)} as dynamics, got {dynamics!r}")
    model, airframe = Dynamics(dynamics), load_airframe(drone)
    require_support(airframe, model)
    params: dict[str, Any] = {
        "gravity_vec": GRAVITY,
        "mass": airframe.value("rigid_body.mass", ()),
        "J": airframe.inertia,
        "J_inv": np.linalg.inv(airframe.inertia),
        "thrust_min": airframe.value("rotors.thrust_min", ()),
        "thrust_max": airframe.value("rotors.thrust_max", ()),
    }
    if model == Dynamics.first_principles:
        params |= {
            "L": airframe.arm,
            "prop_inertia": airframe.value("rotors.inertia"),
            "rpm2thrust": airframe.value("rotors.thrust_curve"),
            "rpm2torque": airframe.value("rotors.torque_curve"),
            "rotor_dyn_coef": airframe.value("rotors.lag"),
            "mixing_matrix": airframe.mixing_matrix,
            "drag_matrix": airframe.matrix("drag.coefficients"),
        }
    else:
        fit = {key: airframe.value(f"fitted.{model.value}.{key}") for key in airframe.table(f"fitted.{model.value}")}
        if "drag_coefficients" in fit:
            del fit["drag_coefficients"]
            fit["drag_matrix"] = airframe.matrix(f"fitted.{model.value}.drag_coefficients")
        params |= fit
    return convert_arrays(params, xp, device)


def load_fn_params(
    fn: Callable[..., Any], drone: AirframeSource, xp: ModuleType | None = None, device: Any = None
) -> dict:
    """Return the parameters from ``load_params`` that ``first_principles.dynamics`` uses.

    Args:
        fn: ``first_principles.dynamics``.
        drone: Airframe, or anything that ``load_airframe`` accepts.
        xp: Array module of the values; None for NumPy.
        device: Device of the values; None for the module's default.
    """
    if fn is not first_principles.dynamics:
        hint = ", which is shared by all fitted models" if fn is fitted.dynamics else ""
        raise ConfigError(f"expected first_principles.dynamics, got {fn!r}{hint}. Use load_params(dynamics, drone).")
    params = load_params(Dynamics.first_principles, drone, xp, device)
    return {name: value for name, value in params.items() if name not in ("thrust_min", "thrust_max")}


def load_controller_params(
    controller: str, drone: AirframeSource, xp: ModuleType | None = None, device: Any = None
) -> dict[str, dict]:
    """Return the parameters of a drone for a controller: ``core``, and one table for each function.

    Parameters that the airframe lacks are left out.

    Args:
        controller: ``"mellinger"``, Crazyflow's cascade; other names are refused.
        drone: Airframe, or anything that ``load_airframe`` accepts.
        xp: Array module of the values, such as ``jax.numpy``; None for NumPy.
        device: Device of the values; None for the module's default.
    """
    if controller != CASCADE_NAME:
        raise UnknownNameError(f"expected controller {CASCADE_NAME!r}, got {controller!r}")
    airframe = load_airframe(drone)
    core = {"gravity_vec": GRAVITY, "L": airframe.arm, "mixing_matrix": airframe.mixing_matrix}
    tables: dict[str, dict[str, Any]] = {"core": core}
    for name, table, keys in CRAZYFLOW_TABLES:
        airframe_table = airframe.table(table)
        tables.setdefault(name, {}).update(
            {new: airframe.value(f"{table}.{k}") for k, new in keys.items() if k in airframe_table}
        )
    return convert_arrays(tables, xp, device)


def load_controller_fn_params(
    fn: Callable[..., Any], drone: AirframeSource, xp: ModuleType | None = None, device: Any = None
) -> dict:
    """Return the parameters of one function of the cascade: ``core``, and its own table if it has one.

    Args:
        fn: Function of ``crazysim.control``, such as ``state2attitude``.
        drone: Airframe, or anything that ``load_airframe`` accepts.
        xp: Array module of the values; None for NumPy.
        device: Device of the values; None for the module's default.
    """
    params = load_controller_params(CASCADE_NAME, drone, xp, device)
    return params["core"] | params.get(fn.__name__, {})


def rotor_vel_limits(dynamics: Dynamics | str, drone: AirframeSource) -> tuple[float, float]:
    """Return the smallest and largest value of ``states.rotor_vel`` of rotors that are on.

    These are speeds of the first rotor, rpm, or for fitted models collective thrusts, N.
    """
    params = load_params(dynamics, drone)
    thrusts = np.array([params["thrust_min"], params["thrust_max"]])
    if dynamics != Dynamics.first_principles:
        low, high = load_airframe(drone).n_rotors * thrusts
    else:
        low, high = load_airframe(drone).rotor_vel_limits[:, 0]
    return float(low), float(high)


def convert_arrays(params: dict[str, Any], xp: ModuleType | None, device: Any) -> dict[str, Any]:
    """Return a dict, or a dict of dicts, with its values as arrays of a module."""
    as_array = (np if xp is None else xp).asarray
    options = {} if device is None else {"device": device}
    return {
        k: convert_arrays(v, xp, device) if isinstance(v, dict) else as_array(v, **options) for k, v in params.items()
    }
