"""Tables of contents: log variables and parameters of a simulated Crazyflie, by name and type."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.errors import require
from crazysim.lab.live.attitude import rotate
from crazysim.lab.live.swarm import Commander, DroneState, Swarm
from crazysim.lab.live.swarm.sensors import read_battery, read_ranges

LOG_TYPES = {
    "uint8_t": (1, "<B"), "uint16_t": (2, "<H"), "uint32_t": (3, "<I"), "int8_t": (4, "<b"), "int16_t": (5, "<h"),
    "int32_t": (6, "<i"), "float": (7, "<f"), "FP16": (8, "<e"),
}  # fmt: skip
"""Number and format of the types of log variables (``LogTocElement`` of cflib)."""
PARAM_TYPES = {
    "int8_t": (0, "<b"), "int16_t": (1, "<h"), "int32_t": (2, "<i"), "FP16": (5, "<e"), "float": (6, "<f"),
    "uint8_t": (8, "<B"), "uint16_t": (9, "<H"), "uint32_t": (10, "<I"),
}  # fmt: skip
"""Number and format of the types of parameters (``ParamTocElement`` of cflib)."""
READ_ONLY_BIT = 0x40
"""Bit of the type of a parameter that cannot be written."""
OUT_OF_RANGE_DISTANCE = 32767
"""Distance that is reported if no object is within range, mm (``mrGetMeasurementAndRestart`` in multiranger.c)."""
RANGE_VARIABLES = {"down": "zrange"}
"""Names of log variables in the group ``range`` that differ from the name of their direction."""

Reading = Callable[[DroneState, Commander], float]
"""Function that returns the value of a log variable from a drone's state and commander."""


class Variable(NamedTuple):
    """One log variable or parameter."""

    name: str
    """Group and name, ``group.name``."""
    ctype: str
    """Type in C."""
    read_only: bool = False
    """Whether it cannot be written."""


class Table:
    """Variables with consecutive numbers, as the protocol transfers them."""

    def __init__(self, variables: list[Variable], types: Mapping[str, tuple[int, str]]):
        self.variables, self.types = variables, types
        self.ids = {variable.name: k for k, variable in enumerate(variables)}
        for variable in variables:
            require(
                variable.name.count(".") == 1 and len(variable.name) <= 24 and variable.ctype in types,
                f"expected group.name of up to 24 letters and one of {list(types)}, got {variable}",
            )
        require(len(self.ids) >= len(variables), "expected different names of variables, got one twice")
        self.checksum = zlib.crc32(b"".join(self.describe(k) for k in range(len(variables))))

    def describe(self, k: int) -> bytes:
        """Return the description of a variable: type, group and name."""
        variable = self.variables[k]
        group, name = variable.name.split(".")
        type_number = self.types[variable.ctype][0] | (READ_ONLY_BIT if variable.read_only else 0)
        return bytes([type_number]) + group.encode() + b"\0" + name.encode() + b"\0"

    def format(self, k: int) -> str:
        """Return the format of a variable for ``struct``."""
        return self.types[self.variables[k].ctype][1]


def pack_number(struct_format: str, value: float) -> bytes:
    """Return a number as bytes, clipped to the range of its format.

    Integer formats round it, and store 0 for NaN and infinite numbers.
    """
    if struct_format in ("<f", "<e"):
        largest = 3.4e38 if struct_format == "<f" else 65504.0
        return struct.pack(struct_format, value if math.isnan(value) else min(max(value, -largest), largest))
    bits = 8 * struct.calcsize(struct_format)
    is_signed = struct_format[1].islower()
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if is_signed else (0, 2**bits - 1)
    return struct.pack(struct_format, min(max(round(value) if math.isfinite(value) else 0, low), high))


def _component_variables(group: str, names: str, field: str, scale: float = 1.0) -> dict[str, tuple[str, Reading]]:
    def component_reading(k: int) -> Reading:
        return lambda state, _c: scale * float(getattr(state, field)[k])

    return {f"{group}.{name}": ("float", component_reading(k)) for k, name in enumerate(names.split())}


def _angle_variables(group: str) -> dict[str, tuple[str, Reading]]:
    index_and_sign = {"roll": (0, 1), "pitch": (1, -1), "yaw": (2, 1)}

    def angle_reading(k: int, sign: int) -> Reading:
        return lambda state, _c: sign * math.degrees(float(state.rpy[k]))

    return {f"{group}.{name}": ("float", angle_reading(*pair)) for name, pair in index_and_sign.items()}


def _acceleration_reading(k: int) -> Reading:
    # As in ``kalmanCoreExternalizeState``.
    def reading(state: DroneState, _: Commander) -> float:
        return float(rotate(state.quat, state.acc)[k]) / GRAVITY_MAGNITUDE - (k == 2)

    return reading


def _goal_reading(row: int, k: int) -> Reading:
    return lambda _s, commander: float(commander.goal()[row, k])


LOG_VARIABLES: dict[str, tuple[str, Reading]] = {
    **_component_variables("stateEstimate", "x y z", "pos"),
    **_component_variables("stateEstimate", "vx vy vz", "vel"),
    **{f"stateEstimate.a{axis}": ("float", _acceleration_reading(k)) for k, axis in enumerate("xyz")},
    **_component_variables("stateEstimate", "qx qy qz qw", "quat"),
    **_angle_variables("stateEstimate"),
    **_angle_variables("stabilizer"),
    **_component_variables("kalman", "stateX stateY stateZ", "pos"),
    **{f"kalman.varP{axis}": ("float", lambda _s, _c: 1e-6) for axis in "XYZ"},
    **_component_variables("gyro", "x y z", "ang_vel", 180 / math.pi),
    **_component_variables("acc", "x y z", "acc", 1 / GRAVITY_MAGNITUDE),
    **{f"ctrltarget.{axis}": ("float", _goal_reading(0, k)) for k, axis in enumerate("xyz")},
    **{f"ctrltarget.v{axis}": ("float", _goal_reading(1, k)) for k, axis in enumerate("xyz")},
    "ctrltarget.yaw": ("float", lambda _s, commander: math.degrees(commander.goal()[0, 3])),
    "radio.rssi": ("uint8_t", lambda _s, _c: 0),
    "colorLedBot.deckTemp": ("uint8_t", lambda _s, _c: 25),
    "colorLedBot.throttlePct": ("uint8_t", lambda _s, _c: 0),
    "sys.canfly": ("uint8_t", lambda _s, commander: commander.armed and not commander.locked),
    "sys.isFlying": ("uint8_t", lambda _s, commander: commander.motors_on),
    "sys.isTumbled": ("uint8_t", lambda state, _c: np.cos(state.rpy[0]) * np.cos(state.rpy[1]) < 0),
    "supervisor.info": ("uint16_t", lambda _s, commander: supervisor_bits(commander)),
}
"""Log variables that every simulated drone has, with their types and readings."""


def create_log_table(swarm: Swarm, drone: int) -> dict[str, tuple[str, Reading]]:
    """Return the log variables of a drone, including its battery and its range finder."""
    sim = swarm.sim

    def distance_reading(name: str) -> Reading:
        def distance_mm(_state: DroneState, _commander: Commander) -> float:
            value = 1000 * read_ranges(sim, drone)[name]
            return value if math.isfinite(value) else OUT_OF_RANGE_DISTANCE

        return distance_mm

    ranges = {
        f"range.{RANGE_VARIABLES.get(name, name)}": ("uint16_t", distance_reading(name))
        for name in read_ranges(sim, drone)
    }
    battery: dict[str, tuple[str, Reading]] = {
        "pm.vbat": ("float", lambda _s, _c: read_battery(sim, drone).voltage),
        "pm.state": ("uint8_t", lambda _s, _c: read_battery(sim, drone).state),
        "pm.batteryLevel": ("uint8_t", lambda _s, _c: 100 * read_battery(sim, drone).charge),
    }
    return LOG_VARIABLES | battery | ranges


def supervisor_bits(commander: Commander) -> int:
    """Return the state of the supervisor: bits as in ``Supervisor.STATES`` of cflib."""
    is_unlocked, is_flying = not commander.locked, commander.motors_on
    flags = {
        "can be armed": is_unlocked,
        "is armed": commander.armed,
        "is auto armed": True,
        "can fly": commander.armed and is_unlocked,
        "is flying": is_flying,
        "is tumbled": False,
        "is locked": commander.locked,
        "is crashed": False,
        "high-level control is active": is_flying,
        "high-level trajectory is finished": commander.finished,
        "high-level control is disabled": False,
    }
    return sum(int(flag) << k for k, flag in enumerate(flags.values()))
