"""Files of flight controllers as tables of columns at equal times."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError
from crazysim.identify.repairs import continuous

LONGEST_HOLD = 3.0
"""Intervals of a stream, after which its interpolated values count as a gap."""
QUAT = ("qx", "qy", "qz", "qw")
"""Names of the columns of an attitude, body to world."""
LARGEST_RATE = 250.0
"""Rate to which faster logs are averaged, Hz: above some 50 Hz nothing is identified."""


class Stream(NamedTuple):
    """Samples of one kind of message."""

    t: NDArray
    """Time, s. (n,)"""
    columns: dict[str, NDArray]
    """Values by name. (n,) each"""


def at_equal_times(
    name: str, streams: Mapping[str, Stream], repairs: list[str], quat: Sequence[str] = QUAT
) -> dict[str, NDArray]:
    """Return the columns of all streams, interpolated linearly at the times of the fastest; ``t`` begins at zero.

    Where a stream pauses for over three of its intervals the samples are left out, which leaves a gap.

    Args:
        name: Name of the file, for messages.
        streams: Streams by name.
        repairs: List that descriptions of repairs are appended to.
        quat: Names of the columns of the attitude, whose signs are made continuous first.

    Raises:
        ConfigError: If no two streams overlap, or a stream has fewer than two samples.
    """
    sorted_streams = {}
    for key, stream in streams.items():
        order = np.unique(stream.t, return_index=True)[1]
        order = order[np.isfinite(stream.t[order])]
        if len(order) < len(stream.t) or np.any(np.diff(stream.t) <= 0):
            repairs.append(f"sorted {key}, of which {len(stream.t) - len(order)} samples have no time of their own")
        if len(order) < 2:
            raise ConfigError(f"{name}: expected at least two samples of {key}, got {len(order)}. Log it more often.")
        columns = {c: x[order] for c, x in stream.columns.items()}
        if quat and all(c in columns for c in quat):
            turned = continuous(np.stack([columns[c] for c in quat], axis=-1))
            columns |= dict(zip(quat, turned.T, strict=True))
        sorted_streams[key] = Stream(stream.t[order], columns)
    steps = {key: float(np.median(np.diff(s.t))) for key, s in sorted_streams.items()}
    start, end = (f(s.t[k] for s in sorted_streams.values()) for f, k in ((max, 0), (min, -1)))
    dt = min(steps.values())
    if end - start < dt:
        raise ConfigError(f"{name}: expected messages at the same times, got none. Log all of them in one flight.")
    if end - start > 100 * dt * max(len(s.t) for s in sorted_streams.values()):
        raise ConfigError(f"{name}: expected one flight, got {end - start:.3g} s of pauses. Cut the log into flights.")
    t = start + dt * np.arange(int((end - start) / dt) + 1)
    table, keep = {}, np.ones(len(t), bool)
    for key, s in sorted_streams.items():
        table |= {c: np.interp(t, s.t, x) for c, x in s.columns.items()}
        before = np.clip(np.searchsorted(s.t, t, side="right") - 1, 0, len(s.t) - 2)
        keep &= s.t[before + 1] - s.t[before] <= LONGEST_HOLD * steps[key]
    return {"t": (t - start)[keep]} | {c: x[keep] for c, x in table.items()}


def decimated(table: dict[str, NDArray], repairs: list[str]) -> dict[str, NDArray]:
    """Return the table with means over as many samples as bring it to ``LARGEST_RATE`` or just below.

    Args:
        table: Columns by name, with the time ``t``, s.
        repairs: List that descriptions of repairs are appended to.
    """
    step = float(np.median(np.diff(table["t"]))) if len(table["t"]) > 1 else 0.0
    if not step > 0 or (size := int(np.ceil(1 / (LARGEST_RATE * step) - 1e-6))) < 2:
        return table
    n = len(table["t"]) // size * size
    repairs.append(f"averaged {size} samples each of a log at {1 / step:.0f} Hz")
    return {key: x[:n].reshape(-1, size).mean(axis=1) for key, x in table.items()}


def read_crazyflie(path: Path, repairs: list[str]) -> dict[str, NDArray]:
    """Return the columns of a log of the Crazyflie's micro-SD card, by the names of its log variables.

    The format is that of Bitcraze's crazyflie-firmware, tools/usdlog/cfusdlog.py at commit 34c90e75: versions 1 and 2.

    Args:
        path: File.
        repairs: List that descriptions of repairs are appended to.

    Raises:
        ConfigError: If the file is no such log.
    """
    data = path.read_bytes()
    if len(data) < 9 or data[0] != 0xBC:
        raise ConfigError(
            f"{path.name}: expected a log of a Crazyflie's micro-SD card, which begins with 0xBC, got another file. "
            "Tables need the ending .csv or .npz."
        )
    version, n_kinds = struct.unpack_from("<HH", data, 1)
    if version not in (1, 2):
        raise ConfigError(
            f"{path.name}: expected version 1 or 2 of the format, got {version}. Convert the log to CSV with the "
            "firmware's tools/usdlog."
        )
    end = len(data) - 4
    if crc32(data[:end]) != struct.unpack_from("<I", data, end)[0]:
        repairs.append("the checksum does not match: read up to the last whole record")
        end = len(data)
    try:
        kinds, at = _kinds(data, n_kinds)
    except (struct.error, ValueError) as error:
        raise ConfigError(
            f"{path.name}: expected names of log variables in the header, got {error}. Copy the file again."
        ) from error
    head = struct.Struct("<HI" if version == 1 else "<HQ")
    unit = 1e-3 if version == 1 else 1e-6
    rows: dict[int, list[tuple[float, ...]]] = {key: [] for key in kinds}
    while at + head.size <= end:
        kind, time = head.unpack_from(data, at)
        if kind not in kinds or at + head.size + kinds[kind][2].size > end:
            break
        rows[kind].append((time * unit, *kinds[kind][2].unpack_from(data, at + head.size)))
        at += head.size + kinds[kind][2].size
    if at < end and not repairs:
        repairs.append(f"left out {end - at} bytes at the end that are no record")
    streams = {}
    for key, (name, variables, _) in kinds.items():
        if rows[key]:
            table = np.array(rows[key], np.float64)
            streams[name] = Stream(table[:, 0], dict(zip(variables, table.T[1:], strict=True)))
    if not streams:
        raise ConfigError(f"{path.name}: expected records, got none. Start the log before the flight.")
    return at_equal_times(path.name, streams, repairs)


def _kinds(data: bytes, n_kinds: int) -> tuple[dict[int, tuple[str, list[str], struct.Struct]], int]:
    """Return name, variables and layout of each kind of record, and the place of the first record."""
    kinds, at = {}, 5

    def text(at: int) -> tuple[str, int]:
        stop = data.index(0, at)
        return data[at:stop].decode(), stop + 1

    for _ in range(n_kinds):
        (key,) = struct.unpack_from("<H", data, at)
        name, at = text(at + 2)
        (count,) = struct.unpack_from("<H", data, at)
        at += 2
        variables, layout = [], "<"
        for _ in range(count):
            entry, at = text(at)  # such as "gyro.x(f)"
            variables.append(entry[:-3])
            layout += entry[-2]
        kinds[key] = (name, variables, struct.Struct(layout))
    return kinds, at


def read_ulog(path: Path, repairs: list[str]) -> dict[str, NDArray]:
    """Return the columns of a PX4 ULog in the names of crazysim's logs.

    World axes are north, west, up, and body axes forward, left, up: PX4's, turned half about the first axis. Rotor
    speeds are those of ``esc_status``, in PX4's order.

    Args:
        path: File.
        repairs: List that descriptions of repairs are appended to.

    Raises:
        ConfigError: If the log lacks a message.
        ImportError: If pyulog is not installed.
    """
    try:
        from pyulog import ULog
    except ImportError as error:
        raise ImportError(
            "expected pyulog, which ULog files need, got none. Run pip install 'crazysim[logs]'."
        ) from error
    log = ULog(str(path))
    if log.dropouts:
        repairs.append(f"{len(log.dropouts)} dropouts of the logger")
    found = {d.name: d.data for d in log.data_list if d.multi_id == 0}
    needed = ("vehicle_local_position", "vehicle_attitude", "vehicle_angular_velocity", "esc_status")
    if missing := [key for key in needed if key not in found]:
        raise ConfigError(
            f"{path.name}: expected messages {', '.join(missing)}, got {', '.join(sorted(found))}. "
            "Add them to PX4's logged topics; esc_status needs ESCs with telemetry."
        )
    place, turn, rates, escs = (found[key] for key in needed)
    n_rotors = int(np.max(escs["esc_count"])) if "esc_count" in escs else 4
    columns = {
        "vehicle_local_position": {
            "x": place["x"], "y": -place["y"], "z": -place["z"],
            "vx": place["vx"], "vy": -place["vy"], "vz": -place["vz"],
        },
        # PX4's quaternions are wxyz.
        "vehicle_attitude": {"qw": turn["q[0]"], "qx": turn["q[1]"], "qy": -turn["q[2]"], "qz": -turn["q[3]"]},
        "vehicle_angular_velocity": {"wx": rates["xyz[0]"], "wy": -rates["xyz[1]"], "wz": -rates["xyz[2]"]},
        "esc_status": {f"rpm{k + 1}": np.abs(escs[f"esc[{k}].esc_rpm"]) for k in range(n_rotors)},
    }  # fmt: skip
    if "battery_status" in found:
        columns["battery_status"] = {"voltage": found["battery_status"]["voltage_v"]}
    streams = {key: Stream(found[key]["timestamp"] * 1e-6, x) for key, x in columns.items()}
    return at_equal_times(path.name, streams, repairs)
