"""Parameters of Crazyflow's cascade, as dicts under Crazyflow's names and import path."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

from crazysim.drones import AirframeSource, load_airframe
from crazysim.drones.keys import TABLES
from crazysim.dynamics.models import GRAVITY
from crazysim.dynamics.parameters import convert_arrays
from crazysim.errors import UnknownNameError, require

CASCADE_NAME = "mellinger"
"""Crazyflow's name for its cascade of controllers, which is ``"crazyflow"`` here; not the controller ``Mellinger``."""
ROTOR_NAMES = {
    "thrust_curve": "rpm2thrust",
    "torque_curve": "rpm2torque",
    "thrust_min": "thrust_min",
    "thrust_max": "thrust_max",
}
"""Crazyflow's names of keys of ``[rotors]``."""
CRAZYFLOW_TABLES = {
    "core": "controller",
    "state2attitude": "controller.state",
    "attitude2force_torque": "controller.attitude",
    "body_rate2force_torque": "controller.attitude",
}
"""Table of an airframe by the name of Crazyflow's table; ``core`` is for all functions of the cascade."""


def load_params(
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
    require(controller == CASCADE_NAME, f"expected controller {CASCADE_NAME!r}, got {controller!r}", UnknownNameError)
    airframe = load_airframe(drone)
    tables: dict[str, dict[str, Any]] = {
        name: {key: x for key, x in airframe.table(table).items() if key in TABLES[table]}
        for name, table in CRAZYFLOW_TABLES.items()
    }
    rotors = {ROTOR_NAMES[key]: x for key, x in airframe.table("rotors").items() if key in ROTOR_NAMES}
    tables["core"] |= {"gravity_vec": GRAVITY, "L": airframe.arm, "mixing_matrix": airframe.mixing_matrix} | rotors
    return convert_arrays(tables, xp, device)


def load_fn_params(
    fn: Callable[..., Any], drone: AirframeSource, xp: ModuleType | None = None, device: Any = None
) -> dict:
    """Return the parameters of one function of the cascade: ``core``, and its own table if it has one.

    Args:
        fn: Function of ``crazysim.control``, such as ``state2attitude``.
        drone: Airframe, or anything that ``load_airframe`` accepts.
        xp: Array module of the values; None for NumPy.
        device: Device of the values; None for the module's default.
    """
    params = load_params(CASCADE_NAME, drone, xp, device)
    return params["core"] | params.get(fn.__name__, {})
