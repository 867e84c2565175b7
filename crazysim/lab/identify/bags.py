"""ROS bags as tables of columns that share their times."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from crazysim import rotation
from crazysim.dynamics.rotor import RPM_TO_RAD_S
from crazysim.errors import ConfigError, optional_import, require
from crazysim.lab.identify.columns import Columns, without_huge_numbers
from crazysim.lab.identify.readers import Stream, resample
from crazysim.storage import check_file, read_text

XYZ, XYZW = "xyz", "xyzw"
POSE_FIELDS = {
    "nav_msgs/msg/Odometry": ("pose/pose/position", "pose/pose/orientation"),
    "geometry_msgs/msg/PoseStamped": ("pose/position", "pose/orientation"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("pose/pose/position", "pose/pose/orientation"),
    "geometry_msgs/msg/TransformStamped": ("transform/translation", "transform/rotation"),
    "geometry_msgs/msg/Pose": ("position", "orientation"),
}
"""Fields of position and attitude by message type, most informative first."""
ROTOR_FIELDS = {"actuator_msgs/msg/Actuators": "velocity", "mav_msgs/msg/Actuators": "angular_velocities"}
"""Fields of rotor speeds, rad/s, by message type."""

MAX_METADATA_BYTES = 2**24
"""Largest ``metadata.yaml``, bytes."""


class _BagFile(io.BufferedReader):
    """File whose ``read`` allocates at most the remaining bytes, even if a damaged record states a larger size."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or size < 0:
            return super().read()
        return super().read(min(size, max(os.fstat(self.fileno()).st_size - self.tell(), 0)))


class _BagPath(type(Path())):
    """Path whose files are opened as ``_BagFile``, and whose text has at most ``MAX_METADATA_BYTES`` bytes."""

    def open(self, *args: Any, **kwargs: Any) -> Any:
        del args, kwargs
        check_file(self)
        return _BagFile(io.FileIO(self))

    def read_text(self, *args: Any, **kwargs: Any) -> str:
        # ``metadata.yaml`` is UTF-8 in every locale.
        del args, kwargs
        return read_text(self, MAX_METADATA_BYTES)


def is_bag(path: Path) -> bool:
    return path.suffix in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").is_file()


def read_bag(path: Path, repairs: list[str], requested_columns: Columns | None = None) -> dict[str, NDArray]:
    """Return the columns of a bag of ROS 1 or 2, interpolated at the times of the fastest topic.

    A name such as ``/drone/odom/pose/pose/position/x`` or ``/motors/data[0]`` is a topic and a field of its messages.
    Without such names, topics are chosen by message type, and the columns are named as in crazysim's logs:

    - Position and attitude come from the topic of the first type in ``POSE_FIELDS`` that the bag has. Odometry also
      gives velocity and angular velocity. Both are in the body frame (nav_msgs/Odometry); the velocity is rotated to
      the world frame.
    - The angular velocity of an Imu replaces the angular velocity of Odometry.
    - Rotor speeds come from Actuators, rad/s (actuator_msgs, mav_msgs), and are converted to rpm.

    Several topics of the chosen type are an error. Units are SI (REP 103). Times come from the headers, or else from
    the bag.

    Args:
        path: File ``.bag``, ``.mcap`` or ``.db3``, or folder with ``metadata.yaml``.
        repairs: List that descriptions of repairs are appended to.
        requested_columns: Names of the columns; None for the default names.

    Raises:
        ImportError: If rosbags is not installed.
    """
    with optional_import("ROS bags need", "rosbags", "logs"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    names = [] if requested_columns is None else [x for x in requested_columns.names if "/" in x]
    folder = path.parent if path.suffix in (".mcap", ".db3") and (path.parent / "metadata.yaml").is_file() else path
    with AnyReader([_BagPath(folder)], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
        topics = {c.topic: c.msgtype for c in bag.connections}
        if names:
            columns = {name: _split_column(path.name, name, topics) for name in names}
        else:
            columns = _default_columns(path.name, topics)
        streams: dict[str, Stream] = {}
        for topic in {topic for topic, _ in columns.values()}:
            fields = {name: field for name, (column_topic, field) in columns.items() if column_topic == topic}
            streams[topic] = _read_stream(path.name, bag, topic, topics[topic], fields)
    if not names:
        streams = {topic: _with_world_velocity(stream) for topic, stream in streams.items()}
    return resample(path.name, streams, repairs, requested_columns if names else None)


def _split_column(name: str, column: str, topics: dict[str, str]) -> tuple[str, str]:
    matches = [topic for topic in topics if column.startswith(f"{topic}/")]
    if not matches:
        topic_list = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items()))
        raise ConfigError(
            f"{name}: expected a topic and a field, such as /odom/pose/pose/position/x, got {column!r}. "
            f"The bag has {topic_list}."
        )
    topic = max(matches, key=len)
    return topic, column[len(topic) + 1 :]


def _default_columns(name: str, topics: dict[str, str]) -> dict[str, tuple[str, str]]:
    def find_topic(kinds: Sequence[str]) -> tuple[str, str] | None:
        for kind in kinds:
            matches = sorted(topic for topic, topic_kind in topics.items() if topic_kind == kind)
            if len(matches) > 1:
                raise ConfigError(
                    f"{name}: expected one topic of {kind}, got {', '.join(matches)}. "
                    f"Name the columns, such as pos={matches[0]}/..."
                )
            if matches:
                return matches[0], kind
        return None

    topic_list = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items()))
    columns = {}
    pose, imu, rotors = (
        find_topic(list(POSE_FIELDS)),
        find_topic(["sensor_msgs/msg/Imu"]),
        find_topic(list(ROTOR_FIELDS)),
    )
    if pose is None:
        raise ConfigError(
            f"{name}: expected a topic of {', '.join(POSE_FIELDS)}, got {topic_list}. Name the columns, such as "
            "pos=/topic/x,/topic/y,/topic/z."
        )
    topic, kind = pose
    position, attitude = POSE_FIELDS[kind]
    columns |= {axis: (topic, f"{position}/{axis}") for axis in XYZ}
    columns |= {f"q{axis}": (topic, f"{attitude}/{axis}") for axis in XYZW}
    if kind == "nav_msgs/msg/Odometry":
        columns |= {f"v{axis}": (topic, f"twist/twist/linear/{axis}") for axis in XYZ}
        columns |= {f"w{axis}": (topic, f"twist/twist/angular/{axis}") for axis in XYZ}
    if imu is not None:
        columns |= {f"w{axis}": (imu[0], f"angular_velocity/{axis}") for axis in XYZ}
    if rotors is not None:
        columns["rpm"] = (rotors[0], ROTOR_FIELDS[rotors[1]])
    return columns


def _read_stream(name: str, bag: Any, topic: str, kind: str, fields: dict[str, str]) -> Stream:
    field_readers = {column: _field_reader(field) for column, field in fields.items()}
    times, rows = [], []
    for connection, stamp, packed_message in bag.messages([c for c in bag.connections if c.topic == topic]):
        message = bag.deserialize(packed_message, connection.msgtype)
        header = getattr(message, "header", None)
        seconds = 0.0 if header is None else header.stamp.sec + 1e-9 * header.stamp.nanosec
        times.append(seconds or 1e-9 * stamp)
        try:
            rows.append([field_readers[column](message) for column in fields])
        except (AttributeError, IndexError, TypeError) as error:
            raise ConfigError(
                f"{name}: expected fields {', '.join(fields.values())} of {topic} ({kind}), got {error}. "
                f"ros2 interface show {kind} lists its fields."
            ) from error
    require(rows, f"{name}: expected messages of {topic}, got none. Record it while the drone flies.")
    columns: dict[str, NDArray] = {}
    for column, values in zip(fields, zip(*rows, strict=True), strict=True):
        x = without_huge_numbers(np.array(values, np.float64))
        if column == "rpm":
            columns |= {f"rpm{k + 1}": np.abs(c) / RPM_TO_RAD_S for k, c in enumerate(x.T)}
        elif x.ndim == 1:
            columns[column] = x
        else:
            raise ConfigError(f"{name}: expected a number in {topic}/{fields[column]}, got {x.shape[1]}. Add [0].")
    return Stream(np.array(times), columns)


def _field_reader(field: str) -> Callable[[Any], Any]:
    parts = re.findall(r"[^/\[\]]+", field)

    def read_field(message: Any) -> Any:
        for part in parts:
            message = message[int(part)] if part.isdigit() else attrgetter(part)(message)
        return message

    return read_field


def _with_world_velocity(stream: Stream) -> Stream:
    c = stream.columns
    if "vx" not in c:
        return stream
    q, v = np.stack([c[f"q{k}"] for k in XYZW], -1), np.stack([c[f"v{k}"] for k in XYZ], -1)
    world_vel = np.asarray(rotation.rotate(jnp.asarray(q), jnp.asarray(v)), np.float64)
    return Stream(stream.t, c | dict(zip(("vx", "vy", "vz"), world_vel.T, strict=True)))
