"""Tables and keys of an airframe, and the check that a file or dict has no others."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

from crazysim.errors import ConfigError

GUIDE = "docs/guides/airframes.md"

Shapes = tuple[tuple[int | str, ...], ...]
_NUMBER: Shapes = ((),)
_VECTOR: Shapes = ((3,),)
_RESPONSE: dict[str, Shapes] = {
    "acc_coef": _NUMBER,
    "cmd_f_coef": _NUMBER,
    "rpy_coef": _VECTOR,
    "rpy_rates_coef": _VECTOR,
    "cmd_rpy_coef": _VECTOR,
}
_PID: dict[str, Shapes] = {"kp": _VECTOR, "ki": _VECTOR, "kd": _VECTOR}

TABLES: dict[str, dict[str, Shapes]] = {
    "rigid_body": {"mass": _NUMBER, "inertia": ((3,), (3, 3))},
    "rotors": {
        "position": (("n", 3),),
        "yaw_torque_sign": (("n",),),
        "thrust_min": _NUMBER,
        "thrust_max": _NUMBER,
        "inertia": ((), ("n",)),
        "thrust_curve": ((3,), ("n", 3)),
        "torque_curve": ((3,), ("n", 3)),
        "lag": ((4,), ("n", 4)),
    },
    "drag": {"coefficients": ((3,), (3, 3))},
    "fitted": {},
    "fitted.so_rpy": _RESPONSE,
    "fitted.so_rpy_rotor": _RESPONSE | {"thrust_dyn_coef": _NUMBER},
    "fitted.so_rpy_rotor_drag": _RESPONSE | {"thrust_dyn_coef": _NUMBER, "drag_coefficients": ((3,), (3, 3))},
    "battery": {"thrust_over_voltage": ((4,),)},
    "controller": {
        "thrust2torque": _NUMBER,
        "mass": _NUMBER,
        "mass_thrust": _NUMBER,
        "pwm_min": _NUMBER,
        "pwm_max": _NUMBER,
        "torque_pwm_max": _VECTOR,
    },
    "controller.state": {"kp": _VECTOR, "kd": _VECTOR, "ki": _VECTOR, "int_err_max": _VECTOR},
    "controller.attitude": {
        "kR": _VECTOR,
        "kw": _VECTOR,
        "ki_m": _VECTOR,
        "kd_omega": _VECTOR,
        "int_err_max": _VECTOR,
    },
    "geometric": {"kr": _NUMBER, "kv": _NUMBER, "kR": _NUMBER, "kw": _NUMBER},
    "mellinger": {
        "mass": _NUMBER,
        "mass_thrust": _NUMBER,
        "kp": _VECTOR,
        "kd": _VECTOR,
        "ki": _VECTOR,
        "integral_max": _VECTOR,
        "kR": _VECTOR,
        "kw": _VECTOR,
        "ki_m": _VECTOR,
        "kd_omega": _VECTOR,
        "integral_m_max": _VECTOR,
        "torque_max": _VECTOR,
    },
    "pid": {"tilt_max": ((2,),), "thrust_base": _NUMBER, "thrust_min": _NUMBER},
    "pid.position": _PID | {"output_max": _VECTOR, "cutoff": _NUMBER},
    "pid.velocity": _PID | {"output_max": _VECTOR, "cutoff": _NUMBER},
    "pid.attitude": _PID | {"integral_max": _VECTOR, "cutoff": _NUMBER},
    "pid.rate": _PID | {"integral_max": _VECTOR, "cutoff": _NUMBER},
    "shape": {
        "plate": _VECTOR,
        "battery": _VECTOR,
        "battery_height": _NUMBER,
        "arm_radius": _NUMBER,
        "motor_radius": _NUMBER,
        "motor_height": _NUMBER,
        "propeller_radius": _NUMBER,
        "propeller_height": _NUMBER,
        "led_radius": _NUMBER,
        "led_heights": ((2,),),
        "collision_sphere": ((4,),),
        "collision_box": ((6,),),
        "fpv_camera": _VECTOR,
        "track_camera": _VECTOR,
    },
}
"""All tables by dotted path, with the keys of each and the shapes allowed; ``"n"`` is the number of rotors."""

KEYS: dict[str, Shapes] = {f"{table}.{key}": shapes for table, keys in TABLES.items() for key, shapes in keys.items()}
"""Allowed shapes of all numbers, by dotted path."""

TOP_LEVEL = ("name", "base", "sources")
"""Keys outside of tables."""

ENTRY = ("value", "unit", "source")
"""Keys of a number that is written with its unit and source."""


def check_keys(airframe: str, tables: Mapping[str, Any], prefix: str = "") -> None:
    """Check that tables and keys, as a user wrote them, are documented ones.

    Args:
        airframe: Name and origin of the airframe, for messages.
        tables: The tables, with plain numbers or with units and sources.
        prefix: Dotted path of these tables, with a dot at the end; empty for all.

    Raises:
        ConfigError: If a table or key does not exist, with those that are probably meant.
    """
    for key, item in tables.items():
        path = f"{prefix}{key}"
        if path in TOP_LEVEL:
            continue
        if path in TABLES:
            if not isinstance(item, Mapping):
                raise ConfigError(f"{airframe}: expected a table [{path}], got {item!r}. {GUIDE} lists its keys.")
            check_keys(airframe, item, f"{path}.")
        elif path in KEYS:
            _check_entry(airframe, path, item)
        elif isinstance(item, Mapping) and "value" not in item:
            raise ConfigError(f"{airframe}: expected a table that exists, got [{path}]. {_nearest_table(path)}")
        else:
            known = [*KEYS, *TOP_LEVEL] if not prefix else list(KEYS)
            raise ConfigError(f"{airframe}: expected a key that exists, got {path!r}. {suggestion(path, known)}")


def suggestion(path: str, paths: Iterable[str]) -> str:
    """Return the paths that are probably meant: first the same key in another table, then those spelt alike."""
    paths = list(paths)
    table, _, key = path.rpartition(".")
    same_table = {p.rpartition(".")[2]: p for p in paths if p.rpartition(".")[0] == table}
    keys = {p.rpartition(".")[2]: p for p in paths}
    found = [p for p in paths if p.rpartition(".")[2] == key]
    found += [same_table[k] for k in difflib.get_close_matches(key, same_table)]
    found += difflib.get_close_matches(path, paths)
    found += [keys[k] for k in difflib.get_close_matches(key, keys)]
    return _did_you_mean(repr(p) for p in dict.fromkeys(found))


def _check_entry(airframe: str, path: str, item: Any) -> None:
    if not isinstance(item, Mapping):
        return
    unknown = [key for key in item if key not in ENTRY]
    if unknown or "value" not in item:
        raise ConfigError(
            f"{airframe}: expected {path} as a number, an array or {{ value, unit, source }}, got {dict(item)!r}. "
            f"{GUIDE} shows both forms."
        )


def _nearest_table(path: str) -> str:
    return _did_you_mean(f"[{table}]" for table in difflib.get_close_matches(path, TABLES))


def _did_you_mean(candidates: Iterable[str]) -> str:
    found = list(candidates)[:3]
    return f"Did you mean {' or '.join(found)}? {GUIDE} lists all keys." if found else f"{GUIDE} lists all keys."
