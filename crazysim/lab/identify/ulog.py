"""Logs of PX4, in its ULog format.

The format is described at https://docs.px4.io/main/en/dev_log/ulog_file_format.html. Appended data, which PX4 writes
after a crash, follow the other data without a mark.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Collection, Mapping
from pathlib import Path

import jax
import numpy as np
from numpy.typing import NDArray

from crazysim import rotation
from crazysim.errors import ConfigError, DamagedFileError, require
from crazysim.lab.identify.columns import without_huge_numbers
from crazysim.lab.identify.readers import Stream, resample
from crazysim.lab.identify.repairs import unwrap_angles

TOPICS = (
    "vehicle_local_position", "vehicle_attitude", "vehicle_angular_velocity", "esc_status", "actuator_motors",
    "actuator_outputs", "vehicle_attitude_setpoint", "battery_status",
)  # fmt: skip
"""Topics that are read; the first two are needed."""
MAGIC = b"ULog\x01\x12\x35"
"""First bytes of a file."""
SYNC_BYTES = bytes((0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12))
"""Content of a message ``S``, after which reading of a damaged file resumes."""
HEADER_SIZE = 16
"""Bytes before the first message."""
MESSAGE_LETTERS = b"ABCDFILMOPQRS"
"""Letters that state the kinds of messages."""
SCALAR_TYPES = {
    "int8_t": "<i1", "uint8_t": "<u1", "int16_t": "<i2", "uint16_t": "<u2", "int32_t": "<i4", "uint32_t": "<u4",
    "int64_t": "<i8", "uint64_t": "<u8", "float": "<f4", "double": "<f8", "bool": "<i1", "char": "<i1",
}  # fmt: skip
"""NumPy's name of each type of a field."""
MAX_MESSAGE_BYTES = 2**16 - 1
"""Largest message, bytes; its length has 16 bits."""
MAX_DEPTH = 8
"""Largest depth of nested formats; PX4 has two."""
FIELD_PATTERN = re.compile(r"([\w/-]+)(?:\[(\d{1,5})\])? (\w+)", re.ASCII)
"""Type, number of elements and name of a field, such as ``float[4] q``."""


def read_ulog(path: Path, repairs: list[str]) -> dict[str, NDArray]:
    """Return the columns of a PX4 ULog by the names of crazysim's logs.

    World axes are north, west, up, and body axes forward, left, up: PX4's axes rotated by 180 degrees about the first.
    Rotor speeds come from ``esc_status`` and commands from ``actuator_motors``, or else from ``actuator_outputs``, in
    PX4's order. Commanded attitudes come from ``vehicle_attitude_setpoint``, with its thrust from 0 to 1. Logs
    before PX4 1.10 have the angular velocity in ``vehicle_attitude``.

    Args:
        repairs: List that descriptions of repairs are appended to.

    Raises:
        ConfigError: If the log lacks position or attitude, or is damaged.
    """
    topics = _read_topics(path, TOPICS, repairs)
    if missing := [key for key in TOPICS[:2] if key not in topics]:
        others = ", ".join(topics) or "none"
        raise ConfigError(
            f"{path.name}: expected messages {' and '.join(missing)}, got {others}. Add them to PX4's logged topics."
        )
    local_position, attitude = topics["vehicle_local_position"], topics["vehicle_attitude"]
    # PX4's quaternions are wxyz.
    columns = {
        "vehicle_local_position": {
            "x": local_position["x"], "y": -local_position["y"], "z": -local_position["z"],
            "vx": local_position["vx"], "vy": -local_position["vy"], "vz": -local_position["vz"],
        },
        "vehicle_attitude": {
            "qw": attitude["q[0]"], "qx": attitude["q[1]"], "qy": -attitude["q[2]"], "qz": -attitude["q[3]"],
        },
    }  # fmt: skip
    if "vehicle_angular_velocity" in topics:
        rates = [topics["vehicle_angular_velocity"][f"xyz[{k}]"] for k in range(3)]
        columns["vehicle_angular_velocity"] = {"wx": rates[0], "wy": -rates[1], "wz": -rates[2]}
    elif "rollspeed" in attitude:
        columns["vehicle_attitude"] |= {
            "wx": attitude["rollspeed"],
            "wy": -attitude["pitchspeed"],
            "wz": -attitude["yawspeed"],
        }
    escs = topics.get("esc_status", {})
    n_rotors = int(np.max(escs["esc_count"])) if escs else 0
    if n_rotors:
        speeds = [np.abs(escs[f"esc[{k}].esc_rpm"]) for k in range(n_rotors)]
        columns["esc_status"] = {f"rpm{k + 1}": x for k, x in enumerate(speeds)}
    if "actuator_motors" in topics:
        outputs = [topics["actuator_motors"][f"control[{k}]"] for k in range(12)]
        used_outputs = [x for x in outputs if np.any(np.isfinite(x))]
        columns["actuator_motors"] = {f"command{k + 1}": x for k, x in enumerate(used_outputs)}
    elif "actuator_outputs" in topics and n_rotors:
        outputs = [topics["actuator_outputs"][f"output[{k}]"] for k in range(n_rotors)]
        columns["actuator_outputs"] = {f"command{k + 1}": x for k, x in enumerate(outputs)}
    setpoint = topics.get("vehicle_attitude_setpoint", {})
    if "q_d[0]" in setpoint and "thrust_body[2]" in setpoint:
        commanded_quat = np.stack([setpoint[f"q_d[{k}]"] for k in (1, 2, 3, 0)], axis=-1) * [1, -1, -1, 1]
        angles = np.asarray(jax.jit(rotation.to_rpy)(commanded_quat), np.float64)
        names = ("roll_command", "pitch_command", "yaw_command", "thrust_command")
        values = [*map(unwrap_angles, angles.T), -setpoint["thrust_body[2]"]]
        columns["vehicle_attitude_setpoint"] = dict(zip(names, values, strict=True))
    if "battery_status" in topics:
        columns["battery_status"] = {"voltage": topics["battery_status"]["voltage_v"]}
    streams = {key: Stream(topics[key]["timestamp"] * 1e-6, x) for key, x in columns.items()}
    return resample(path.name, streams, repairs)


class Topic(dict[str, NDArray]):
    """Fields of a topic by name. A missing field is an error that names the file."""

    def __init__(self, location: str, fields: Mapping[str, NDArray]):
        super().__init__(fields)
        self.location = location

    def __missing__(self, name: str) -> NDArray:
        raise ConfigError(
            f"{self.location}: expected a field {name}, got {', '.join(self)[:200]}. Take a log of PX4 1.9 or newer."
        )


def _read_topics(path: Path, topics: Collection[str], repairs: list[str]) -> dict[str, Topic]:
    # Where a file is damaged, the messages up to the next synchronisation message are left out.
    content = path.read_bytes()
    require(
        len(content) >= HEADER_SIZE and content.startswith(MAGIC),
        f"{path.name}: expected a ULog, which begins with 'ULog', got another file. Copy the file again.",
        DamagedFileError,
    )
    message_header, formats, ids, payloads = struct.Struct("<HB"), {}, {}, {}
    offset, n_skipped_bytes, n_dropouts = HEADER_SIZE, 0, 0
    # Messages; after damaged bytes, from the next synchronisation on.
    while offset + message_header.size <= len(content):
        size, kind = message_header.unpack_from(content, offset)
        start, end = offset + message_header.size, offset + message_header.size + size
        if kind not in MESSAGE_LETTERS or end > len(content):
            sync = content.find(SYNC_BYTES, offset + 1)
            n_skipped_bytes += (len(content) if sync < 0 else sync) - offset
            if sync < 0:
                break
            offset = sync + len(SYNC_BYTES)
            continue
        offset = end
        if kind == ord("D") and size > 2:
            key = content[start] | content[start + 1] << 8
            if key in payloads:
                payloads[key].append(content[start + 2 : end])
        elif kind == ord("F"):
            name, _, fields = content[start:end].decode(errors="replace").partition(":")
            formats[name] = fields
        elif kind == ord("A") and size > 3:
            instance, key = struct.unpack_from("<BH", content, start)
            name = content[start + 3 : end].decode(errors="replace")
            if instance == 0 and name in topics and name not in ids:
                ids[name], payloads[key] = key, []
        elif kind == ord("O"):
            n_dropouts += 1
    if n_skipped_bytes:
        repairs.append(f"left out {n_skipped_bytes} damaged bytes")
    if n_dropouts:
        repairs.append(f"{n_dropouts} dropouts of the logger")
    # Rows of each topic.
    tables: dict[str, Topic] = {}
    for name, key in ids.items():
        layout = np.dtype(_read_layout(path.name, formats, name))
        whole_records = [part[: layout.itemsize] for part in payloads[key] if len(part) >= layout.itemsize]
        if len(whole_records) < len(payloads[key]):
            repairs.append(f"left out {len(payloads[key]) - len(whole_records)} messages {name}, which are too short")
        if whole_records:
            table = np.frombuffer(b"".join(whole_records), layout)
            columns = {field: without_huge_numbers(table[field]) for field in layout.names or ()}
            tables[name] = Topic(f"{path.name}: {name}", columns)
    return tables


def _read_layout(
    file: str, formats: Mapping[str, str], name: str, prefix: str = "", depth: int = 0
) -> list[tuple[str, str]]:
    # Padding at the end, which PX4 does not log, is left out.
    quoted, remedy = repr(name[:60]), "Copy the file again."
    if name not in formats or depth > MAX_DEPTH:
        got = f"over {MAX_DEPTH} within each other" if name in formats else "none"
        raise DamagedFileError(f"{file}: expected a format of {quoted}, got {got}. {remedy}")
    fields = []
    for text in filter(None, formats[name].split(";")):
        match = FIELD_PATTERN.fullmatch(text)
        if match is None:
            raise DamagedFileError(f"{file}: expected a field such as 'float[4] q', got {text[:60]!r}. {remedy}")
        kind, count, field = match.groups()
        for index in [""] if count is None else [f"[{k}]" for k in range(int(count))]:
            path = f"{prefix}{field}{index}"
            field_layout = (
                [(path, SCALAR_TYPES[kind])]
                if kind in SCALAR_TYPES
                else _read_layout(file, formats, kind, f"{path}.", depth + 1)
            )
            fields += field_layout
            require(
                field_layout and len(fields) <= MAX_MESSAGE_BYTES,
                f"{file}: expected a format of 1 to {MAX_MESSAGE_BYTES} bytes, got another of {quoted}. {remedy}",
                DamagedFileError,
            )
    while not depth and fields and fields[-1][0].startswith("_padding"):
        fields.pop()
    require(
        len({field for field, _ in fields}) == len(fields),
        f"{file}: expected fields of different names in {quoted}, got some twice. {remedy}",
        DamagedFileError,
    )
    return fields
