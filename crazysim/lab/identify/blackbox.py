"""Logs of Betaflight's blackbox, as CSV files of blackbox_decode or of the Blackbox Explorer."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, require
from crazysim.lab.identify.columns import without_huge_numbers
from crazysim.lab.identify.delimited import parse_number, split_rows
from crazysim.lab.identify.readers import decimate

MOTOR_POLES = 14
"""Magnetic poles of the motors where the file does not state ``motor_poles``: Betaflight's default."""
MAX_HEADER_LINES = 1000
"""Number of lines in which the column names are sought; the Blackbox Explorer writes settings before them."""


def find_header(path: Path) -> tuple[int, list[str], dict[str, str]] | None:
    """Return the index and cells of the line of column names, and the settings before it; None if there is none."""
    settings: dict[str, str] = {}
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in zip(range(MAX_HEADER_LINES), file, strict=False):
            cells = [x.strip().strip('"') for x in line.split(",")]
            if any(x.startswith("time") for x in cells) and any(x.startswith("gyroADC[") for x in cells):
                return number, cells, settings
            settings[cells[0]] = cells[-1]
    return None


def read_blackbox(path: Path, repairs: list[str]) -> dict[str, NDArray]:
    """Return the columns of a blackbox log by the names of crazysim's logs, at 250 Hz at most.

    The columns are ``wx``, ``wy``, ``wz`` about the body axes forward, left, up; ``rpm1`` to ``rpmN``, in Betaflight's
    order, if bidirectional DSHOT was on; ``command1`` to ``commandN``, the outputs to the motors; ``voltage``; and
    ``qx`` to ``qw`` if the log has ``imuQuaternion``. Blackbox logs have no position and no velocity.

    Units are as in the Blackbox Explorer (betaflight/blackbox-log-viewer, flightlog_fields_presenter.js): degrees/s
    for ``gyroADC``, or 0.1 degrees/s with ``blackbox_high_resolution``; 100 electrical rpm for ``eRPM``; 0.01 V for
    ``vbatLatest``; microseconds for the time. Units that blackbox_decode names in the header take precedence. Axes are
    as in Betaflight's src/main/flight/imu.c, where a positive rotation about body z gives a negative yaw.

    Args:
        repairs: List that descriptions of repairs are appended to.
    """
    header = find_header(path)
    if header is None:
        raise ConfigError(
            f"{path.name}: expected columns time and gyroADC[0] in the first {MAX_HEADER_LINES} lines, got none. "
            "Convert the log with blackbox_decode or the Blackbox Explorer."
        )
    start, names, settings = header
    # Columns and units in the header.
    units = {}
    for name in names:
        key, _, unit_text = name.partition(" (")
        units[key] = unit_text.rstrip(")")
    keys = list(units)
    require(
        len(keys) == len(names),
        f"{path.name}: expected columns of different names, got some twice. Export the log again.",
    )
    names_read = [
        key for key in keys if key in ("time", "vbatLatest") or key.startswith(("gyroADC", "motor[", "eRPM[", "imuQua"))
    ]
    n_rotors = sum(key.startswith("motor[") for key in keys)
    # Columns that a flight needs.
    required_names = ["time", *(f"gyroADC[{k}]" for k in range(3)), *(f"motor[{k}]" for k in range(n_rotors))]
    if "imuQuaternion[0]" in keys:
        required_names += ["imuQuaternion[1]", "imuQuaternion[2]"]
    missing = [key for key in required_names if key not in keys]
    if missing:
        raise ConfigError(
            f"{path.name}: expected columns {', '.join(missing)}, got {', '.join(keys)[:300]}. "
            "Log these fields in Betaflight."
        )
    # Rows of numbers.
    with path.open(encoding="utf-8", errors="replace") as file:
        lines = [*file][start + 1 :]
    text_rows = split_rows(path.name, lines, len(keys), start + 2, repairs, "Decode the log again.")
    indices = [keys.index(key) for key in names_read]
    rows = [[parse_number(row[k]) for k in indices] for row in text_rows]
    data = dict(zip(names_read, without_huge_numbers(np.array(rows)).T, strict=True))

    resolution_factor = 10.0 if parse_number(settings.get("blackbox_high_resolution", "0")) == 1 else 1.0
    gyro_unit = {"rad/s": 1.0, "deg/s": math.pi / 180}.get(units["gyroADC[0]"], math.pi / 180 / resolution_factor)
    poles = parse_number(settings.get("motor_poles", str(MOTOR_POLES)))
    require(
        2 <= poles < math.inf,
        f"{path.name}: expected motor_poles of at least 2, got {poles:g}. Correct it in the file.",
    )
    # Columns in the units of crazysim's logs.
    table = {"t": data["time"] * {"s": 1.0, "ms": 1e-3}.get(units["time"], 1e-6)}
    table |= {f"w{axis}": gyro_unit * data[f"gyroADC[{k}]"] for k, axis in enumerate("xyz")}
    table |= {f"command{k + 1}": data[f"motor[{k}]"] for k in range(n_rotors)}
    rotors = [k for k in range(n_rotors) if f"eRPM[{k}]" in data]
    table |= {f"rpm{k + 1}": 200 / poles * data[f"eRPM[{k}]"] for k in rotors}
    if "vbatLatest" in data:
        table["voltage"] = data["vbatLatest"] * (1.0 if units["vbatLatest"] == "V" else 0.01)
    if "imuQuaternion[0]" in data:
        vector = np.stack([data[f"imuQuaternion[{k}]"] for k in range(3)]) / 32767
        scalar = np.sqrt(np.clip(1 - np.sum(vector**2, axis=0), 0, 1))
        table |= dict(zip(("qx", "qy", "qz", "qw"), [*vector, scalar], strict=True))
    return decimate(table, repairs)
