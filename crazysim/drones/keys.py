"""Tables and keys of an airframe, and the check that a file or dict has no others."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

from crazysim.errors import ConfigError, shown
from crazysim.tables import (
    LENGTH,
    MASS,
    NEGATIVE,
    NOT_NEGATIVE,
    PLACE,
    POSITIVE,
    Key,
    Range,
    Shapes,
)

GUIDE = "docs/guides/airframes.md"

_NUMBER: Shapes = ((),)
_VECTOR: Shapes = ((3,),)
_MATRIX: Shapes = ((3,), (3, 3))
_SIGN = Range("1 or -1 for each rotor", -1.0, 1.0)
_GAIN, _GAINS = Key(_NUMBER, NOT_NEGATIVE), Key(_VECTOR, NOT_NEGATIVE)
_POSITIVE = Key(_NUMBER, POSITIVE)
_FAR = 3 * (PLACE.low,)
_SIZE, _SIZES = Key(_NUMBER, LENGTH), Key(_VECTOR, LENGTH)
_RESPONSE = {
    "acc_coef": Key(_NUMBER),
    "cmd_f_coef": _POSITIVE,
    "rpy_coef": Key(_VECTOR, NEGATIVE),
    "rpy_rates_coef": Key(_VECTOR, NEGATIVE),
    "cmd_rpy_coef": Key(_VECTOR, POSITIVE),
}
_PID = dict.fromkeys(("kp", "ki", "kd"), _GAINS)

TABLES: dict[str, dict[str, Key]] = {
    "rigid_body": {"mass": Key(_NUMBER, MASS), "inertia": Key(_MATRIX)},
    "rotors": {
        "position": Key((("n", 3),), PLACE),
        "yaw_torque_sign": Key((("n",),), _SIGN),
        "thrust_min": Key(_NUMBER, NOT_NEGATIVE),
        "thrust_max": _POSITIVE,
        "inertia": Key(((), ("n",)), NOT_NEGATIVE),
        "thrust_curve": Key(((3,), ("n", 3))),
        "torque_curve": Key(((3,), ("n", 3))),
        "lag": Key(((4,), ("n", 4)), NOT_NEGATIVE),
    },
    "drag": {"coefficients": Key(_MATRIX)},
    "fitted": {},
    "fitted.so_rpy": _RESPONSE,
    "fitted.so_rpy_rotor": _RESPONSE | {"thrust_dyn_coef": _POSITIVE},
    "fitted.so_rpy_rotor_drag": _RESPONSE | {"thrust_dyn_coef": _POSITIVE, "drag_coefficients": Key(_MATRIX)},
    "battery": {
        "thrust_over_voltage": Key(((4,),)),
        "cells": Key(_NUMBER, Range("a whole number from 1 to 100", 1, 100)),
        "capacity": _POSITIVE,
        "resistance": _POSITIVE,
        "mass": Key(_NUMBER, MASS),
    },
    "controller": {
        "thrust2torque": _POSITIVE,
        "mass": Key(_NUMBER, MASS),
        "mass_thrust": _POSITIVE,
        "pwm_min": _GAIN,
        "pwm_max": _POSITIVE,
        "torque_pwm_max": _GAINS,
    },
    "controller.state": dict.fromkeys(("kp", "kd", "ki", "int_err_max"), _GAINS),
    "controller.attitude": dict.fromkeys(("kR", "kw", "ki_m", "kd_omega", "int_err_max"), _GAINS),
    "geometric": dict.fromkeys(("kr", "kv", "kR", "kw"), _GAIN),
    "mellinger": {
        "mass": Key(_NUMBER, MASS),
        "mass_thrust": _POSITIVE,
        **dict.fromkeys(("kp", "kd", "ki", "integral_max"), _GAINS),
        **dict.fromkeys(("kR", "kw", "ki_m", "kd_omega", "integral_m_max", "torque_max"), _GAINS),
    },
    "pid": {"tilt_max": Key(((2,),), NOT_NEGATIVE), "thrust_base": _GAIN, "thrust_min": _GAIN},
    "pid.position": _PID | {"output_max": _GAINS, "cutoff": _POSITIVE},
    "pid.velocity": _PID | {"output_max": _GAINS, "cutoff": _POSITIVE},
    "pid.attitude": _PID | {"integral_max": _GAINS, "cutoff": _POSITIVE},
    "pid.rate": _PID | {"integral_max": _GAINS, "cutoff": _POSITIVE},
    "shape": {
        "plate": _SIZES,
        "battery": _SIZES,
        "battery_height": Key(_NUMBER, PLACE),
        "arm_radius": _SIZE,
        "motor_radius": _SIZE,
        "motor_height": _SIZE,
        "propeller_radius": _SIZE,
        "propeller_height": Key(_NUMBER, PLACE),
        "led_radius": _SIZE,
        "led_heights": Key(((2,),), PLACE),
        "collision_sphere": Key(((4,),), Range("three coordinates and a positive radius, m", (*_FAR, LENGTH.low), 1e3)),
        "collision_box": Key(
            ((6,),), Range("three coordinates and three positive half sizes, m", (*_FAR, *3 * (LENGTH.low,)), 1e3)
        ),
        "fpv_camera": Key(_VECTOR, PLACE),
        "track_camera": Key(_VECTOR, PLACE),
    },
}
"""All tables by dotted path, with the keys of each."""

KEYS: dict[str, Key] = {f"{table}.{key}": entry for table, keys in TABLES.items() for key, entry in keys.items()}
"""Shapes and ranges of all numbers, by dotted path."""

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
                raise ConfigError(f"{airframe}: expected a table [{path}], got {shown(item)}. {GUIDE} lists its keys.")
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
            f"{airframe}: expected {path} as a number, an array or {{ value, unit, source }}, got {shown(dict(item))}. "
            f"{GUIDE} shows both forms."
        )


def _nearest_table(path: str) -> str:
    return _did_you_mean(f"[{table}]" for table in difflib.get_close_matches(path, TABLES))


def _did_you_mean(candidates: Iterable[str]) -> str:
    found = list(candidates)[:3]
    return f"Did you mean {' or '.join(found)}? {GUIDE} lists all keys." if found else f"{GUIDE} lists all keys."
