"""Tables and keys of an airframe, with the shape and the range of each number."""

from __future__ import annotations

from crazysim.tables import (
    COORDINATE,
    LENGTH,
    MASS,
    NEGATIVE,
    NOT_NEGATIVE,
    POSITIVE,
    Key,
    Layout,
    Range,
    Shapes,
)

GUIDE = "docs/guides/airframe-keys.md"
"""Page that lists the keys, for messages."""

_NUMBER: Shapes = ((),)
_VECTOR: Shapes = ((3,),)
_MATRIX: Shapes = ((3,), (3, 3))
_SIGN = Range("1 or -1 for each rotor", -1.0, 1.0)
_GAIN, _GAINS = Key(_NUMBER, NOT_NEGATIVE), Key(_VECTOR, NOT_NEGATIVE)
_POSITIVE = Key(_NUMBER, POSITIVE)
_MIN_COORDINATES = 3 * (COORDINATE.low,)
_SIZE, _SIZES = Key(_NUMBER, LENGTH), Key(_VECTOR, LENGTH)
_FITTED_KEYS = {
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
        "position": Key((("n", 3),), COORDINATE),
        "yaw_torque_sign": Key((("n",),), _SIGN),
        "thrust_min": Key(_NUMBER, NOT_NEGATIVE),
        "thrust_max": _POSITIVE,
        "inertia": Key(((), ("n",)), NOT_NEGATIVE),
        "thrust_curve": Key(((3,), ("n", 3))),
        "torque_curve": Key(((3,), ("n", 3))),
        "lag": Key(((4,), ("n", 4)), NOT_NEGATIVE),
    },
    "drag": {"coefficients": Key(_MATRIX)},
    "residual": {
        "linear": Key(((6, 14),)),
        "hidden": Key((("any", 14),)),
        "output": Key(((6, "any"),)),
    },
    "fitted": {},
    "fitted.so_rpy": _FITTED_KEYS,
    "fitted.so_rpy_rotor": _FITTED_KEYS | {"thrust_dyn_coef": _POSITIVE},
    "fitted.so_rpy_rotor_drag": _FITTED_KEYS | {"thrust_dyn_coef": _POSITIVE, "drag_coefficients": Key(_MATRIX)},
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
        "battery_height": Key(_NUMBER, COORDINATE),
        "arm_radius": _SIZE,
        "motor_radius": _SIZE,
        "motor_height": _SIZE,
        "propeller_radius": _SIZE,
        "propeller_height": Key(_NUMBER, COORDINATE),
        "led_radius": _SIZE,
        "led_heights": Key(((2,),), COORDINATE),
        "collision_sphere": Key(
            ((4,),), Range("three coordinates and a positive radius, m", (*_MIN_COORDINATES, LENGTH.low), 1e3)
        ),
        "collision_box": Key(
            ((6,),),
            Range("three coordinates and three positive half sizes, m", (*_MIN_COORDINATES, *3 * (LENGTH.low,)), 1e3),
        ),
        "fpv_camera": Key(_VECTOR, COORDINATE),
        "track_camera": Key(_VECTOR, COORDINATE),
    },
}
"""All tables by dotted path, with the keys of each; ``Shapes`` defines ``"n"`` and ``"any"``."""

LAYOUT = Layout(
    {f"{table}.{key}": entry for table, keys in TABLES.items() for key, entry in keys.items()},
    ("name", "base", "sources"),
    GUIDE,
)
"""Keys of airframes."""
