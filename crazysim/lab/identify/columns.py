"""Names and units of the columns of a log."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, require

NAME_COUNTS = {"pos": (3,), "quat": (4,), "rpy": (0, 3), "vel": (0, 3), "ang_vel": (0, 3), "attitude_command": (0, 4)}
"""Allowed numbers of column names of a field; 0 where the field may be absent."""
NAME_ORDERS = {
    "quat": "x, y, z, w, in this order",
    "rpy": "roll, pitch and yaw",
    "attitude_command": "roll, pitch, yaw and thrust",
}
"""Order of the column names of a field, for messages; x, y, z for other fields."""


@dataclass(frozen=True)
class Columns:
    """Names of a log's columns; ``-`` before a name changes the sign.

    Velocity, angular velocity, rotor speeds, commands and voltage are optional. A missing velocity or angular velocity
    is computed by differentiation.
    """

    pos: tuple[str, ...] = ("x", "y", "z")
    """Position, world frame, m."""
    quat: tuple[str, ...] = ("qx", "qy", "qz", "qw")
    """Attitude, body to world, xyzw."""
    rpy: tuple[str, ...] = ()
    """Roll, pitch and yaw, rad, in place of ``quat``: ``Rz(yaw) Ry(pitch) Rx(roll)`` turns body to world."""
    vel: tuple[str, ...] = ("vx", "vy", "vz")
    """Velocity, world frame, m/s."""
    ang_vel: tuple[str, ...] = ("wx", "wy", "wz")
    """Angular velocity, body frame, rad/s."""
    rotor_vel: tuple[str, ...] = ("rpm1", "rpm2", "rpm3", "rpm4")
    """Rotor speeds, rpm, in the order of the airframe's rotors."""
    command: tuple[str, ...] = ("command1", "command2", "command3", "command4")
    """Commands of the rotors in the order of the airframe's rotors, in any unit if rotor speeds were measured."""
    attitude_command: tuple[str, ...] = ("roll_command", "pitch_command", "yaw_command", "thrust_command")
    """Commanded roll, pitch and yaw, rad, and collective thrust, N."""
    voltage: tuple[str, ...] = ("voltage",)
    """Voltage of the battery, V."""
    time: str = "t"
    """Time, s."""
    seconds_per_unit: float = 1.0
    """Factor from the logged times to s. It applies to tables only; other files state their unit."""
    metres_per_unit: float = 1.0
    """Factor from the logged positions to m."""
    speed_per_unit: float = 1.0
    """Factor from the logged velocities to m/s."""
    rad_per_angle: float = 1.0
    """Factor from ``rpy`` to rad."""
    rad_per_unit: float = 1.0
    """Factor from the logged angular velocities to rad/s."""
    rpm_per_unit: float = 1.0
    """Factor from the logged rotor speeds to rpm."""
    rad_per_command: float = 1.0
    """Factor from the commanded angles to rad."""
    newton_per_command: float = 1.0
    """Factor from the commanded collective thrust to N."""
    share_per_command: float = 1.0
    """Factor from the commands of the rotors to shares of the battery's voltage."""

    def __post_init__(self) -> None:
        for key, counts in NAME_COUNTS.items():
            names = getattr(self, key)
            if isinstance(names, str) or len(names) not in counts:
                got, order = repr(names) if isinstance(names, str) else len(names), NAME_ORDERS.get(key, "x, y, z")
                raise ConfigError(f"expected {counts[-1]} names of columns as {key}, got {got}. Give {order}.")
        for key, x in vars(self).items():
            require(
                "_per_" not in key or (isinstance(x, Real) and math.isfinite(x) and x != 0),
                f"expected a finite number that is not zero as {key}, got {x!r}",
            )

    @property
    def names(self) -> list[str]:
        """Names of all columns but the time, without signs."""
        attitude = self.rpy or self.quat
        return [
            unsigned_name(x)
            for x in (*self.pos, *attitude, *(x for key in OPTIONAL_FIELDS for x in getattr(self, key)))
        ]


IDSIA = Columns(
    pos=("x_mocap", "y_mocap", "z_mocap"),
    rotor_vel=("m1_erpm", "m2_erpm", "m3_erpm", "m4_erpm"),
    command=("m1_thrust", "m2_thrust", "m3_thrust", "m4_thrust"),
    voltage=("Vbat",),
    rpm_per_unit=1 / 6,
)
"""Columns of IDSIA's benchmark (arXiv 2512.14450), with motors of six pole pairs."""
KNOWN_COLUMNS = {
    "crazysim": Columns(),
    "idsia": IDSIA,
    "idsia_csv": replace(IDSIA, pos=("x_poses", "y_poses", "z_poses")),
    "nanobench": Columns(
        pos=("px", "py", "pz"),
        ang_vel=("imu_gyro_x", "imu_gyro_y", "imu_gyro_z"),
        rotor_vel=(),
        command=("motor_motor_m1", "motor_motor_m2", "motor_motor_m3", "motor_motor_m4"),
        voltage=("pwr_pm_vbat",),
        share_per_command=1 / 65535,
    ),
}
"""Columns of known logs: the default names; IDSIA's benchmark, also with the names in its repository's ``.csv`` files;
and NanoBench (arXiv 2603.09908; commands of the motors, 0 to 65535, but no rotor speeds)."""
MAX_NUMBER = 1e20
"""Largest magnitude of a number in a log; times in ns since 1970 are 2e18."""
OPTIONAL_FIELDS = ("vel", "ang_vel", "rotor_vel", "command", "attitude_command", "voltage")
"""Fields whose columns a log may lack."""


def unsigned_name(name: str) -> str:
    return name.removeprefix("-")


def stack_columns(name: str, table: Mapping[str, NDArray], names: Sequence[str], factor: float = 1.0) -> NDArray:
    """Return columns side by side, with their signs, times a factor. (n, len(names))"""
    if missing := [unsigned_name(x) for x in names if unsigned_name(x) not in table]:
        raise ConfigError(
            f"{name}: expected columns {', '.join(missing)}, got {', '.join(sorted(table))}. Name them in a Columns."
        )
    columns = [_as_numbers(name, unsigned_name(x), table[unsigned_name(x)]) for x in names]
    lengths = {unsigned_name(x): len(c) for x, c in zip(names, columns, strict=True)}
    if len(set(lengths.values())) > 1:
        raise ConfigError(
            f"{name}: expected columns of equal length, got "
            f"{', '.join(f'{x} of {n}' for x, n in lengths.items())} samples. Sample all of them at the same times."
        )
    signs = [factor * (-1.0 if x.startswith("-") else 1.0) for x in names]
    return np.stack([s * c for s, c in zip(signs, columns, strict=True)], axis=-1)


def _as_numbers(name: str, key: str, values: NDArray) -> NDArray:
    x = np.asarray(values)
    if x.dtype.kind not in "fiub" or x.ndim != 1:
        got = f"{x.ravel()[0]!s:.40} in its first row" if x.ndim == 1 and x.size else f"shape {x.shape} of {x.dtype}"
        raise ConfigError(
            f"{name}: expected one number a sample in column {key}, got {got}. "
            "Convert it to numbers, or name another column."
        )
    return without_huge_numbers(x)


def without_huge_numbers(x: NDArray) -> NDArray:
    """Return numbers as float64, with NaN for numbers above ``MAX_NUMBER``, as their products could overflow."""
    with np.errstate(invalid="ignore"):  # bytes of a damaged log may be a signalling NaN
        x = x.astype(np.float64)
    return np.where(np.abs(x) <= MAX_NUMBER, x, np.nan)


def missing_columns(table: Mapping[str, NDArray], columns: Columns) -> list[str]:
    """Return the columns that a log lacks; a field with default names may be absent as a whole."""
    names = [columns.time, *columns.pos, *(columns.rpy or columns.quat)]
    for key in OPTIONAL_FIELDS:
        column_names = getattr(columns, key)
        if column_names != getattr(KNOWN_COLUMNS["crazysim"], key) or any(
            unsigned_name(x) in table for x in column_names
        ):
            names += column_names
    return [unsigned_name(x) for x in names if unsigned_name(x) not in table]


def with_rotor_count(table: Mapping[str, NDArray], columns: Columns) -> Columns:
    """Return the columns with default rotor names extended to the rotors of a log, such as ``rpm1`` to ``rpm6``.

    Logs with fewer than four rotors are left to ``missing_columns``.
    """
    extended_names = {}
    for key in ("rotor_vel", "command"):
        names = getattr(columns, key)
        if names == getattr(KNOWN_COLUMNS["crazysim"], key):
            stem, n = names[0][:-1], len(names)
            while f"{stem}{n + 1}" in table:
                n += 1
            extended_names[key] = tuple(f"{stem}{k + 1}" for k in range(n))
    return replace(columns, **extended_names)
