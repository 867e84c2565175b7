"""Logs of flights: reading, checks, and repairs that are reported."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError
from crazysim.identify import motion as capture
from crazysim.identify.bags import is_bag, read_bag
from crazysim.identify.blackbox import header_of, read_blackbox
from crazysim.identify.readers import read_crazyflie, read_ulog

REPAIRABLE = 0.05
"""Largest share of samples that may be repaired; a log with more is an error."""
UNIT = 1e-3
"""Deviation of a quaternion's norm from 1 that counts as rounding."""


@dataclass(frozen=True)
class Columns:
    """Names of a log's columns; ``-`` before a name changes the sign.

    A log may lack columns of velocity and angular velocity, which are then differentiated; rotor speeds, commands and
    voltage.
    """

    pos: tuple[str, ...] = ("x", "y", "z")
    """Position, world frame, m."""
    quat: tuple[str, ...] = ("qx", "qy", "qz", "qw")
    """Attitude, body to world, xyzw."""
    vel: tuple[str, ...] = ("vx", "vy", "vz")
    """Velocity, world frame, m/s."""
    ang_vel: tuple[str, ...] = ("wx", "wy", "wz")
    """Angular velocity, body frame, rad/s."""
    rotor_vel: tuple[str, ...] = ("rpm1", "rpm2", "rpm3", "rpm4")
    """Rotor speeds in the order of the airframe's rotors."""
    command: tuple[str, ...] = ("command1", "command2", "command3", "command4")
    """Commands of the rotors in the order of the airframe's rotors, in any unit if their speeds were measured."""
    attitude_command: tuple[str, ...] = ("roll_command", "pitch_command", "yaw_command", "thrust_command")
    """Commanded roll, pitch and yaw, rad, and collective thrust, N."""
    voltage: tuple[str, ...] = ("voltage",)
    """Voltage of the battery, V."""
    time: str = "t"
    """Time, s."""
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


KNOWN = {
    "crazysim": Columns(),
    "idsia": Columns(
        pos=("x_mocap", "y_mocap", "z_mocap"),
        rotor_vel=("m1_erpm", "m2_erpm", "m3_erpm", "m4_erpm"),
        command=("m1_thrust", "m2_thrust", "m3_thrust", "m4_thrust"),
        voltage=("Vbat",),
        rpm_per_unit=1 / 6,
    ),
    "nanobench": Columns(
        pos=("px", "py", "pz"),
        ang_vel=("imu_gyro_x", "imu_gyro_y", "imu_gyro_z"),
        rotor_vel=(),
        command=("motor_motor_m1", "motor_motor_m2", "motor_motor_m3", "motor_motor_m4"),
        voltage=("pwr_pm_vbat",),
        share_per_command=1 / 65535,
    ),
}
"""Columns of known logs: the default names, IDSIA's benchmark (arXiv 2512.14450; motors of six pole pairs), and
NanoBench (arXiv 2603.09908; commands of the motors, 0 to 65535, but no rotor speeds)."""
OPTIONAL = ("vel", "ang_vel", "rotor_vel", "command", "attitude_command", "voltage")
"""Fields whose columns a log may lack."""


@dataclass(frozen=True, eq=False)
class Log:
    """One flight, with samples at equal intervals."""

    name: str
    """Name for messages."""
    t: NDArray
    """Time, s. (n,)"""
    pos: NDArray
    """Position, world frame, m. (n, 3)"""
    quat: NDArray
    """Attitude, body to world, unit, xyzw. (n, 4)"""
    vel: NDArray
    """Velocity, world frame, m/s. (n, 3)"""
    ang_vel: NDArray
    """Angular velocity, body frame, rad/s. (n, 3)"""
    rotor_vel: NDArray
    """Rotor speeds, rpm; of no rotor where the log has none. (n, n_rotors)"""
    command: NDArray | None = None
    """Commands of the rotors, in the unit of the log; None if it has none. (n, n_rotors)"""
    attitude_command: NDArray | None = None
    """Commanded roll, pitch and yaw, rad, and collective thrust, N; None if the log has none. (n, 4)"""
    voltage: NDArray | None = None
    """Voltage of the battery, V; None if the log has none. (n,)"""
    gaps: NDArray = field(default_factory=lambda: np.zeros(0, int))
    """Indices of samples that follow a gap. (n_gaps,)"""
    repairs: tuple[str, ...] = ()
    """Descriptions of the repairs."""
    modelled: bool = False
    """True for rotor speeds that were not measured: see ``with_speeds``."""

    @property
    def dt(self) -> float:
        """Interval between samples, s."""
        return float(np.median(np.diff(self.t)))


def read_log(
    path: str | Path | Mapping[str, NDArray],
    columns: Columns | str | None = None,
    motion: str | Path | Mapping[str, NDArray] | None = None,
) -> Log:
    """Return the log of a file or of a dict of columns, checked and repaired.

    A file is a table, ``.csv`` or ``.npz``; a Betaflight blackbox log that was converted to ``.csv``; a PX4 ULog,
    ``.ulg``; a ROS bag, ``.bag``, ``.mcap``, ``.db3`` or a folder; or, with any other ending, a log of a Crazyflie's
    micro-SD card, whose columns are its log variables.

    Args:
        path: File, or columns by name.
        columns: Names of the columns, or a key of ``KNOWN``; by default the first of ``KNOWN`` that the log has.
        motion: Motion capture of the same flight, whose columns are added to those of the log. Its clock may be another
            one: it is moved to where the angular velocities agree.

    Raises:
        ConfigError: If columns are missing, or the samples cannot be repaired.
    """
    repairs: list[str] = []
    if isinstance(columns, str):
        if columns not in KNOWN:
            raise ConfigError(
                f"expected columns as one of {', '.join(KNOWN)} or a Columns, got {columns!r}. "
                "Name the columns in a Columns."
            )
        columns = KNOWN[columns]
    name, table = _table(path, repairs, columns)
    if motion is not None:
        names = columns or KNOWN["crazysim"]
        ang_vel = _stacked(name, table, names.ang_vel) * names.rad_per_unit
        _, other = _table(motion, repairs, columns)
        table = capture.joined(name, table, other, names.time, ang_vel, names.quat, repairs)
    if columns is None:
        columns = next((c for c in reversed(KNOWN.values()) if not _missing(table, c)), KNOWN["crazysim"])
    missing = _missing(table, columns)
    if missing:
        raise ConfigError(
            f"{name}: expected columns {', '.join(missing)}, got {', '.join(sorted(table))}. Name them in a Columns "
            "(--columns), or give the motion capture of the flight (--motion)."
        )
    t = np.asarray(table[columns.time], np.float64)
    data = {}
    for key in ("pos", "quat", *OPTIONAL):
        names = getattr(columns, key)
        if names and _plain(names[0]) in table:
            data[key] = _stacked(name, table, names)
    for key, factor in (
        ("rotor_vel", columns.rpm_per_unit),
        ("ang_vel", columns.rad_per_unit),
        ("command", columns.share_per_command),
    ):
        if key in data:
            data[key] = data[key] * factor
    if "attitude_command" in data:
        data["attitude_command"] *= [*[columns.rad_per_command] * 3, columns.newton_per_command]
    t, data = _increasing(name, t, data, repairs)
    data = {key: _finite(name, key, x, repairs) for key, x in data.items()}
    data["quat"] = _unit(name, data["quat"], repairs)
    if "rotor_vel" in data:
        data["rotor_vel"] = _without_spikes(name, data["rotor_vel"], repairs)
    else:
        data["rotor_vel"] = np.zeros((len(t), 0))
    if "voltage" in data:
        data["voltage"] = data["voltage"][:, 0]
    if "vel" not in data:
        data["vel"] = capture.velocity_of(t, data["pos"])
        repairs.append("differentiated the position, for want of a velocity")
    if "ang_vel" in data:
        _check_rates(name, t, data["quat"], data["ang_vel"])
    else:
        data["ang_vel"] = capture.ang_vel_of(t, data["quat"])
        repairs.append("differentiated the attitude, for want of an angular velocity")
    gaps = 1 + np.flatnonzero(np.diff(t) > 1.5 * np.median(np.diff(t)))
    if len(gaps):
        repairs.append(f"{len(gaps)} gaps, the longest {np.max(np.diff(t)):.3g} s; no prediction crosses them")
    return Log(name, t, **data, gaps=gaps, repairs=tuple(repairs), modelled=False)


def _table(
    path: str | Path | Mapping[str, NDArray], repairs: list[str], columns: Columns | None
) -> tuple[str, Mapping[str, NDArray]]:
    if isinstance(path, Mapping):
        return "log", path
    path = Path(path)
    if is_bag(path) and path.exists():
        every = [] if columns is None else [x for key in ("pos", "quat", *OPTIONAL) for x in getattr(columns, key)]
        topics = [_plain(x) for x in every if _plain(x).startswith("/")]
        return path.stem, read_bag(path, repairs, topics, () if columns is None else columns.quat)
    if not path.is_file():
        raise ConfigError(f"expected an existing file, or the folder of a ROS bag, got {str(path)!r}")
    if path.suffix == ".ulg":
        return path.stem, read_ulog(path, repairs)
    if path.suffix not in (".npz", ".csv"):
        return path.stem, read_crazyflie(path, repairs)
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as file:
            return path.stem, {key: file[key] for key in file.files}
    if header_of(path) is not None:
        return path.stem, read_blackbox(path, repairs)
    with path.open(encoding="utf-8") as file:
        header = [x.strip() for x in file.readline().split(",")]
        rows = np.genfromtxt(file, delimiter=",", dtype=np.float64, ndmin=2)
    if rows.shape[1:] != (len(header),):
        raise ConfigError(
            f"{path.name}: expected {len(header)} numbers in each row, as in the header, got {rows.shape}. "
            "The first line names the columns, and commas part them."
        )
    return path.stem, dict(zip(header, rows.T, strict=True))


def _plain(name: str) -> str:
    """Return the name of a column without its sign."""
    return name.removeprefix("-")


def _stacked(name: str, table: Mapping[str, NDArray], names: Sequence[str]) -> NDArray:
    """Return columns side by side, with their signs. (n, len(names))"""
    if missing := [_plain(x) for x in names if _plain(x) not in table]:
        raise ConfigError(
            f"{name}: expected columns {', '.join(missing)}, got {', '.join(sorted(table))}. Name them in a Columns."
        )
    signs = [-1.0 if x.startswith("-") else 1.0 for x in names]
    return np.stack([s * np.asarray(table[_plain(x)], np.float64) for s, x in zip(signs, names, strict=True)], axis=-1)


def _missing(table: Mapping[str, NDArray], columns: Columns) -> list[str]:
    """Return the columns that a log lacks; those of default names are optional as a whole."""
    names = [columns.time, *columns.pos, *columns.quat]
    for key in OPTIONAL:
        given = getattr(columns, key)
        if given != getattr(KNOWN["crazysim"], key) or any(_plain(x) in table for x in given):
            names += given
    return [_plain(x) for x in names if _plain(x) not in table]


def _increasing(
    name: str, t: NDArray, data: dict[str, NDArray], repairs: list[str]
) -> tuple[NDArray, dict[str, NDArray]]:
    """Return the samples whose time is later than that of all before them."""
    latest = np.maximum.accumulate(np.concatenate([[-np.inf], np.where(np.isfinite(t), t, -np.inf)]))[:-1]
    keep = np.isfinite(t) & (t > latest)
    lost = int(np.sum(~keep))
    if len(t) < 20 or lost > REPAIRABLE * len(t):
        raise ConfigError(
            f"{name}: expected at least 20 samples whose time increases, got {len(t)} of which {lost} do not. "
            "Cut the log into flights."
        )
    if lost:
        repairs.append(f"dropped {lost} samples whose time does not increase")
    return t[keep], {key: x[keep] for key, x in data.items()}


def _interpolated(x: NDArray, good: NDArray) -> NDArray:
    index = np.arange(len(x))
    return np.stack([np.interp(index, index[g], c[g]) for c, g in zip(x.T, good.T, strict=True)], axis=-1)


def _finite(name: str, key: str, x: NDArray, repairs: list[str]) -> NDArray:
    good = np.isfinite(x)
    bad = int(np.max(np.sum(~good, axis=0)))
    if bad > REPAIRABLE * len(x):
        raise ConfigError(
            f"{name}: expected finite {key}, got {bad} samples of {len(x)} that are not. "
            "Cut the log to where it is whole."
        )
    if bad:
        repairs.append(f"interpolated {bad} samples of {key} that were not finite")
    return _interpolated(x, good) if bad else x


def _without_spikes(name: str, x: NDArray, repairs: list[str]) -> NDArray:
    good = (x >= 0) & (x <= 3 * np.median(x, axis=0))
    bad = int(np.sum(~good))
    if bad > REPAIRABLE * x.size:
        raise ConfigError(
            f"{name}: expected rotor speeds from 0 to three times their median, got {bad} others. "
            "Cut the log to the flight, and check that the columns are speeds."
        )
    if bad:
        repairs.append(f"interpolated {bad} rotor speeds that were negative or more than three times the median")
    return _interpolated(x, good) if bad else x


def _unit(name: str, quat: NDArray, repairs: list[str]) -> NDArray:
    """Return unit quaternions; a constant that was added to each component is found by fitting a unit sphere."""
    norm = np.linalg.norm(quat, axis=-1)
    if np.all(np.abs(norm - 1) < UNIT):
        return quat / norm[:, None]
    if not np.all(np.abs(norm - 1) < 0.2):
        raise ConfigError(
            f"{name}: expected unit quaternions, got norms from {norm.min():.3g} to {norm.max():.3g}. "
            "Name four components, x, y, z and w in this order, as quat."
        )
    solution, *_ = np.linalg.lstsq(np.c_[2 * quat, np.ones(len(quat))], norm**2, rcond=None)
    moved = quat - solution[:4]
    moved_norm = np.linalg.norm(moved, axis=-1)
    if np.all(np.abs(moved_norm - 1) < UNIT):
        offset = ", ".join(f"{x:.4f}" for x in solution[:4])
        repairs.append(f"subtracted ({offset}) from the quaternions, which makes them unit")
        return moved / moved_norm[:, None]
    repairs.append(f"normalised quaternions of norms from {norm.min():.4f} to {norm.max():.4f}")
    return quat / norm[:, None]


def _check_rates(name: str, t: NDArray, quat: NDArray, ang_vel: NDArray) -> None:
    """Check that attitude and angular velocity agree in unit, frame, order and sign."""
    size = 9
    kernel = np.ones(size) / size

    def smooth(x: NDArray) -> NDArray:
        return np.stack([np.convolve(c, kernel, "valid") for c in x.T], axis=-1)

    turned, measured = smooth(capture.body_rates(t, quat)), smooth((ang_vel[1:] + ang_vel[:-1]) / 2)
    if np.sqrt(np.mean(turned**2)) < 0.02:
        return
    slope = float(np.sum(turned * measured) / np.sum(turned**2))
    if not 0.5 < slope < 2:
        hint = " They seem to be in degrees per second." if 30 < slope < 100 else ""
        raise ConfigError(
            f"{name}: expected angular velocities that turn the attitude, got {slope:.3g} times as much.{hint} "
            "Check unit and frame, and that quaternions are xyzw, body to world."
        )
