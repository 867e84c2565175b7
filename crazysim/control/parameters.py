"""Parameters of the firmware's controllers as dicts, under the names of Crazyflow."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

from crazysim.drones import AirframeSource, load_airframe
from crazysim.dynamics.models import GRAVITY
from crazysim.dynamics.parameters import as_arrays
from crazysim.errors import UnknownNameError

CONTROLLER = "mellinger"
"""Name of the cascade."""
_CONSTANTS = ("mass", "mass_thrust", "pwm_min", "pwm_max", "torque_pwm_max", "thrust2torque")
_ROTORS = {
    "thrust_curve": "rpm2thrust",
    "torque_curve": "rpm2torque",
    "thrust_min": "thrust_min",
    "thrust_max": "thrust_max",
}
_STATE = ("kp", "kd", "ki", "int_err_max")
_ATTITUDE = ("kR", "kw", "ki_m", "kd_omega", "int_err_max")
SOURCES: tuple[tuple[str, str, dict[str, str]], ...] = (
    ("core", "controller", {key: key for key in _CONSTANTS}),
    ("core", "rotors", _ROTORS),
    ("state2attitude", "controller.state", {key: key for key in _STATE}),
    ("attitude2force_torque", "controller.attitude", {key: key for key in _ATTITUDE}),
    ("body_rate2force_torque", "controller.attitude", {key: key for key in _ATTITUDE}),
)
"""Tables of Crazyflow, the airframe's tables that they come from, and Crazyflow's name for each key."""


def load_params(
    controller: str, drone: AirframeSource, xp: ModuleType | None = None, device: Any = None
) -> dict[str, dict]:
    """Return the parameters of a drone for a controller: ``core``, and one table for each function.

    Parameters that the airframe lacks are left out.

    Args:
        controller: ``"mellinger"``.
        drone: Airframe, or anything that ``load_airframe`` accepts.
        xp: Array module of the values, such as ``jax.numpy``; None for NumPy.
        device: Device of the values; None for the module's default.

    Raises:
        UnknownNameError: If the controller or the drone does not exist.
    """
    if controller != CONTROLLER:
        raise UnknownNameError(f"expected controller {CONTROLLER!r}, got {controller!r}")
    airframe = load_airframe(drone)
    core = {"gravity_vec": GRAVITY, "L": airframe.arm, "mixing_matrix": airframe.mixing_matrix}
    tables: dict[str, dict[str, Any]] = {"core": core}
    for name, table, keys in SOURCES:
        known = airframe.table(table)
        tables.setdefault(name, {}).update(
            {new: airframe.value(f"{table}.{k}") for k, new in keys.items() if k in known}
        )
    return as_arrays(tables, xp, device)


def load_fn_params(
    fn: Callable[..., Any], drone: AirframeSource, xp: ModuleType | None = None, device: Any = None
) -> dict:
    """Return the parameters of one function of the cascade: those of ``core``, and its own.

    Args:
        fn: Function of ``crazysim.control``, such as ``state2attitude``.
        drone: Airframe, or anything that ``load_airframe`` accepts.
        xp: Array module of the values; None for NumPy.
        device: Device of the values; None for the module's default.
    """
    params = load_params(CONTROLLER, drone, xp, device)
    return params["core"] | params.get(fn.__name__, {})
