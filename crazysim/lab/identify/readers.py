"""Resampling of message streams to common times, and logs of a Crazyflie's micro-SD card."""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, require
from crazysim.lab.identify.columns import Columns, unsigned_name, without_huge_numbers
from crazysim.lab.identify.repairs import PERIOD_RANGE, align_signs, unwrap_angles
from crazysim.lab.live.attitude import decompress_quat

MAX_HOLD = 3.0
"""Longest pause of a stream that is interpolated, in intervals of the stream; a longer pause is a gap."""
VARIABLE_PATTERN = re.compile(r"(.+)\(([bBhHiIfd?])\)", re.DOTALL)
"""Name and type of a variable of a micro-SD log, such as ``gyro.x(f)``."""
MAX_RATE = 250.0
"""Rate to which faster logs are averaged, Hz. Nothing is identified from motion above about 50 Hz."""


class Stream(NamedTuple):
    """Samples of one kind of message."""

    t: NDArray
    """Time, s. (n,)"""
    columns: dict[str, NDArray]
    """Values by name. (n,) each"""


def resample(
    name: str, streams: Mapping[str, Stream], repairs: list[str], columns: Columns | None = None
) -> dict[str, NDArray]:
    """Return the columns of all streams, interpolated linearly at the times of the fastest; ``t`` begins at zero.

    Samples in pauses of a stream longer than ``MAX_HOLD`` intervals are left out, which leaves a gap. Streams with
    longer intervals than ``PERIOD_RANGE`` allows are left out too, except the voltage.

    Args:
        repairs: List that descriptions of repairs are appended to.
        columns: Names of the columns; None for the default names. Attitudes are made continuous before they are
            interpolated.
    """
    columns = columns or Columns()
    quat, angles = ([unsigned_name(x) for x in names] for names in (columns.quat, columns.rpy))
    required_columns, slow_columns = (
        {*map(unsigned_name, columns.pos), *quat, *angles},
        set(map(unsigned_name, columns.voltage)),
    )
    # Sorted streams, without slow ones.
    sorted_streams = {}
    for key, stream in streams.items():
        order = np.unique(stream.t, return_index=True)[1]
        order = order[np.isfinite(stream.t[order])]
        if len(order) < len(stream.t) or np.any(np.diff(stream.t) <= 0):
            repairs.append(f"sorted {key} and left out {len(stream.t) - len(order)} samples with the time of another")
        require(
            len(order) >= 2, f"{name}: expected at least two samples of {key}, got {len(order)}. Log it more often."
        )
        values = {c: without_huge_numbers(x[order]) for c, x in stream.columns.items()}
        step = float(np.median(np.diff(stream.t[order])))
        if step > PERIOD_RANGE[1] and not set(values) <= slow_columns:
            requirement = f"{key} every {PERIOD_RANGE[1]:g} s or more often, got every {step:.2g} s"
            require(not required_columns & set(values), f"{name}: expected {requirement}. Log it faster.")
            repairs.append(f"left out a slow stream: expected {requirement}")
            continue
        # Attitudes and angles without jumps, which would be interpolated.
        if quat and all(c in values for c in quat):
            continuous_quat = align_signs(np.stack([values[c] for c in quat], axis=-1))
            values |= dict(zip(quat, continuous_quat.T, strict=True))
        full_turn = 2 * np.pi / abs(columns.rad_per_angle)
        values |= {c: unwrap_angles(values[c], full_turn) for c in angles if c in values}
        sorted_streams[key] = Stream(stream.t[order], values)
    if not sorted_streams:
        raise ConfigError(
            f"{name}: expected messages every {PERIOD_RANGE[1]:g} s or more often, got none. Log them faster."
        )
    # Times at which all streams have samples.
    steps = {key: float(np.median(np.diff(s.t))) for key, s in sorted_streams.items()}
    start, end = (f(s.t[k] for s in sorted_streams.values()) for f, k in ((max, 0), (min, -1)))
    dt = min(steps.values())
    require(end - start >= dt, f"{name}: expected messages at the same times, got none. Log all of them in one flight.")
    require(
        end - start <= 100 * dt * max(len(s.t) for s in sorted_streams.values()),
        f"{name}: expected one flight, got {end - start:.3g} s of pauses. Cut the log into flights.",
    )
    t = start + dt * np.arange(int((end - start) / dt) + 1)
    is_covered = np.ones(len(t), bool)
    for key, s in sorted_streams.items():
        previous_index = np.clip(np.searchsorted(s.t, t, side="right") - 1, 0, len(s.t) - 2)
        is_covered &= s.t[previous_index + 1] - s.t[previous_index] <= MAX_HOLD * steps[key]
    t = t[is_covered]
    resampled_columns = {c: np.interp(t, s.t, x) for s in sorted_streams.values() for c, x in s.columns.items()}
    return {"t": t - start} | resampled_columns


def decimate(table: dict[str, NDArray], repairs: list[str]) -> dict[str, NDArray]:
    """Return the table with groups of samples averaged, so that its rate is at most ``MAX_RATE``.

    Args:
        table: Columns by name, with the time ``t``, s.
        repairs: List that descriptions of repairs are appended to.
    """
    step = float(np.median(np.diff(table["t"]))) if len(table["t"]) > 1 else 0.0
    if not step > 0 or (size := int(np.ceil(1 / (MAX_RATE * step) - 1e-6))) < 2:
        return table
    n = len(table["t"]) // size * size
    repairs.append(f"averaged {size} samples each of a log at {1 / step:.0f} Hz")
    return {key: without_huge_numbers(x[:n]).reshape(-1, size).mean(axis=1) for key, x in table.items()}


def read_crazyflie(path: Path, repairs: list[str], columns: Columns | None = None) -> dict[str, NDArray]:
    """Return the columns of a log of the Crazyflie's micro-SD card, by the names of its log variables.

    The format is defined by tools/usdlog/cfusdlog.py of Bitcraze's crazyflie-firmware at commit 34c90e75: versions 1
    and 2. Compressed attitudes, such as ``stateEstimateZ.quat``, become four columns, such as ``stateEstimateZ.qx`` to
    ``qw`` (src/modules/interface/quatcompress.h). Variables that several events share are prefixed with the event.

    Args:
        repairs: List that descriptions of repairs are appended to.
        columns: Names of the columns. Events without these columns are left out, unless no event has any of them.

    Raises:
        ConfigError: If the file is not a log of this format.
    """
    content = path.read_bytes()
    require(
        len(content) >= 9 and content[0] == 0xBC,
        f"{path.name}: expected a log of a Crazyflie's micro-SD card, which begins with 0xBC, got another file. "
        "Tables need the ending .csv or .npz, PX4's logs .ulg, ROS bags .bag, .mcap or .db3.",
    )
    version, n_events = struct.unpack_from("<HH", content, 1)
    require(
        version in (1, 2),
        f"{path.name}: expected version 1 or 2 of the format, got {version}. Convert the log to CSV with the "
        "firmware's tools/usdlog.",
    )
    # A log that was cut off has no checksum.
    end = len(content) - 4
    if crc32(content[:end]) != struct.unpack_from("<I", content, end)[0]:
        repairs.append("the checksum does not match: read up to the last whole record")
        end = len(content)
    try:
        events, offset = _read_events(content, n_events)
    except (struct.error, ValueError) as error:
        raise ConfigError(
            f"{path.name}: expected names of log variables in the header, got {error}. Copy the file again."
        ) from error
    record_header = struct.Struct("<HI" if version == 1 else "<HQ")
    seconds_per_tick = 1e-3 if version == 1 else 1e-6
    # Records up to the first damaged one.
    rows: dict[int, list[tuple[float, ...]]] = {key: [] for key in events}
    while offset + record_header.size <= end:
        event, time = record_header.unpack_from(content, offset)
        if event not in events or offset + record_header.size + events[event][2].size > end:
            break
        rows[event].append(
            (time * seconds_per_tick, *events[event][2].unpack_from(content, offset + record_header.size))
        )
        offset += record_header.size + events[event][2].size
    if offset < end and not repairs:
        repairs.append(f"left out {end - offset} bytes at the end that are not a record")
    # One stream for each event.
    n_streams = Counter(variable for key, (_, variables, _) in events.items() if rows[key] for variable in variables)
    streams = {}
    for key, (name, variables, _) in events.items():
        if rows[key]:
            table = np.array(rows[key], np.float64)
            names = [x if n_streams[x] == 1 else f"{name}.{x}" for x in variables]
            values = dict(zip(names, table.T[1:], strict=True))
            for x in [x for x in names if x.endswith(".quat") and _are_uint32(values[x])]:
                attitude = decompress_quat(values[x].astype(np.uint32))
                values |= {f"{x[:-4]}q{axis}": c for axis, c in zip("xyzw", attitude.T, strict=True)}
            streams[name] = Stream(table[:, 0], values)
    require(streams, f"{path.name}: expected records, got none. Start the log before the flight.")
    if columns is not None:
        streams = {key: x for key, x in streams.items() if set(columns.names) & set(x.columns)} or streams
    return resample(path.name, streams, repairs, columns)


def _are_uint32(x: NDArray) -> bool:
    return bool(np.all((x >= 0) & (x < 2**32) & (np.floor(x) == x)))


def _read_events(content: bytes, n_events: int) -> tuple[dict[int, tuple[str, list[str], struct.Struct]], int]:
    events, offset = {}, 5

    def read_string(offset: int) -> tuple[str, int]:
        stop = content.index(0, offset)
        return content[offset:stop].decode(), stop + 1

    for _ in range(n_events):
        (key,) = struct.unpack_from("<H", content, offset)
        name, offset = read_string(offset + 2)
        (count,) = struct.unpack_from("<H", content, offset)
        offset += 2
        variables, layout = [], "<"
        for _ in range(count):
            entry, offset = read_string(offset)
            if (match := VARIABLE_PATTERN.fullmatch(entry)) is None:
                raise struct.error(f"{entry[:60]!r} in place of one such as 'gyro.x(f)'")
            variables.append(match[1])
            layout += match[2]
        events[key] = (name, variables, struct.Struct(layout))
    return events, offset
