"""Logs of flights: reading, checks, and repairs that are reported."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazysim.arguments import check_arguments
from crazysim.errors import ConfigError, require
from crazysim.lab.identify import motion as motion_module
from crazysim.lab.identify.checks import check_motion
from crazysim.lab.identify.columns import (
    KNOWN_COLUMNS,
    OPTIONAL_FIELDS,
    Columns,
    missing_columns,
    stack_columns,
    unsigned_name,
    with_rotor_count,
)
from crazysim.lab.identify.repairs import (
    MIN_SAMPLES,
    airborne_samples,
    find_gaps,
    increasing_samples,
    interpolate_missing,
    remove_spikes,
)
from crazysim.lab.identify.tables import read_table


@dataclass(frozen=True, eq=False)
class Log:
    """One flight, with samples at equal intervals except at ``gaps``."""

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
    """Rotor speeds, rpm; ``n_rotors`` is 0 if the log has none. (n, n_rotors)"""
    command: NDArray | None = None
    """Commands of the rotors, logged values times ``share_per_command``; None if the log has none. (n, n_rotors)"""
    attitude_command: NDArray | None = None
    """Commanded roll, pitch and yaw, rad, and collective thrust, N; None if the log has none. (n, 4)"""
    voltage: NDArray | None = None
    """Voltage of the battery, V; None if the log has none. (n,)"""
    gaps: NDArray = field(default_factory=lambda: np.zeros(0, int))
    """Indices of samples that follow a gap. (n_gaps,)"""
    repairs: tuple[str, ...] = ()
    """Descriptions of the repairs."""
    modelled: bool = False
    """Whether the rotor speeds were modelled by ``with_speeds``, not measured."""

    @property
    def dt(self) -> float:
        """Interval between samples, s."""
        return float(np.median(np.diff(self.t)))


@check_arguments
def read_log(
    path: str | Path | Mapping[str, NDArray],
    columns: Columns | str | None = None,
    motion: str | Path | Mapping[str, NDArray] | None = None,
    between: tuple[float, float] = (0.0, math.inf),
) -> Log:
    """Read the log of a file or of a dict of columns, checked and repaired.

    A file is a table, ``.csv`` or ``.npz``; a Betaflight blackbox log that was converted to ``.csv``; a PX4 ULog,
    ``.ulg``; a ROS bag, ``.bag``, ``.mcap``, ``.db3`` or a folder; or, with any other ending, a log of a Crazyflie's
    micro-SD card, whose columns are its log variables.

    Args:
        path: File, or columns by name.
        columns: Names of the columns, or a key of ``KNOWN_COLUMNS``; by default the last of these keys whose
            columns the log has.
        motion: Motion capture of the same flight, whose columns are added to the log. If its clock differs from the
            clock of the log, its times are shifted so that the angular velocities agree.
        between: Start and end of the part that is read, s after the first sample.
    """
    repairs: list[str] = []
    if isinstance(columns, str):
        require(
            columns in KNOWN_COLUMNS,
            f"expected columns as one of {', '.join(KNOWN_COLUMNS)} or a Columns, got {columns!r}. "
            "Name the columns in a Columns.",
        )
        columns = KNOWN_COLUMNS[columns]
    # Columns of the log and of motion capture.
    name, table = read_table(path, repairs, columns)
    if motion is not None:
        _, motion_table = read_table(motion, repairs, columns)
        table = motion_module.join_motion_capture(
            name, table, motion_table, columns or KNOWN_COLUMNS["crazysim"], repairs
        )
    if columns is None:
        columns = next(
            (c for c in reversed(KNOWN_COLUMNS.values()) if not missing_columns(table, c)), KNOWN_COLUMNS["crazysim"]
        )
    columns = with_rotor_count(table, columns)
    if missing := missing_columns(table, columns):
        slow_streams = "".join(f", and {x}" for x in repairs if x.startswith("left out a slow stream"))
        raise ConfigError(
            f"{name}: expected columns {', '.join(missing)}, got {', '.join(sorted(table))}{slow_streams}. "
            "Name them, as in --columns time=seconds pos=px,py,pz or a Columns, or give the motion capture of the "
            "flight (--motion)."
        )
    # Columns in SI units.
    factors = {
        "pos": columns.metres_per_unit,
        "vel": columns.speed_per_unit,
        "rotor_vel": columns.rpm_per_unit,
        "ang_vel": columns.rad_per_unit,
        "command": columns.share_per_command,
    }
    data = {}
    for key in ("pos", "quat", *OPTIONAL_FIELDS):
        names = getattr(columns, key)
        if names and unsigned_name(names[0]) in table:
            # The time is included, so that columns of another length are an error.
            data[key] = stack_columns(name, table, (columns.time, *names))[:, 1:] * factors.get(key, 1.0)
    if "attitude_command" in data:
        data["attitude_command"] *= [*[columns.rad_per_command] * 3, columns.newton_per_command]
    # Samples of the interval, without missing values.
    t = stack_columns(name, table, [columns.time])[:, 0]
    is_kept = increasing_samples(name, t, repairs)
    elapsed = t - t[is_kept][0]
    is_kept &= (elapsed >= between[0]) & (elapsed <= between[1])
    if np.sum(is_kept) < MIN_SAMPLES:
        raise ConfigError(
            f"{name}: expected at least {MIN_SAMPLES} samples between {between[0]:g} and {between[1]:g} s, got "
            f"{np.sum(is_kept)} of a log of {elapsed[np.isfinite(elapsed)].max():.3g} s. Give other times."
        )
    t, data = interpolate_missing(name, t[is_kept], {key: x[is_kept] for key, x in data.items()}, repairs)
    # Only samples in the air.
    thrust = np.sum(data["rotor_vel"] ** 2, axis=1) if "rotor_vel" in data else None
    if thrust is None and "attitude_command" in data:
        thrust = data["attitude_command"][:, 3]
    if thrust is not None:
        is_kept = airborne_samples(name, t, thrust, repairs)
        t, data = t[is_kept], {key: x[is_kept] for key, x in data.items()}
    if "rotor_vel" in data:
        data["rotor_vel"] = remove_spikes(name, data["rotor_vel"], repairs)
    else:
        data["rotor_vel"] = np.zeros((len(t), 0))
    # Velocities that the log lacks.
    derived_keys = tuple(key for key in ("vel", "ang_vel") if key not in data)
    if "vel" in derived_keys:
        data["vel"] = motion_module.fit_velocity(t, data["pos"])
        repairs.append("differentiated the position, since the log has no velocity")
    if "ang_vel" in derived_keys:
        data["ang_vel"] = motion_module.fit_ang_vel(t, data["quat"])
        repairs.append("differentiated the attitude, since the log has no angular velocity")
    is_kept = check_motion(name, t, data, (*derived_keys, *(["quat"] if columns.rpy else [])), repairs)
    t, data = t[is_kept], {key: x[is_kept] for key, x in data.items()}
    if "voltage" in data:
        data["voltage"] = data["voltage"][:, 0]
    gaps = find_gaps(name, t, repairs)
    return Log(name, t, **data, gaps=gaps, repairs=tuple(repairs), modelled=False)
