"""Contents of CRTP packets with commands: streamed setpoints, high-level commands, trajectories in memory."""

from __future__ import annotations

import math
import struct

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, require
from crazysim.lab.live.host_trajectory import HostTrajectory
from crazysim.lab.live.swarm.commander import Commander
from crazysim.trajectories.bezier import power_coefficients

PIECE_SIZE = 132
"""Size of an uncompressed piece, bytes: 8 coefficients each of x, y, z and yaw, and the duration."""
N_CONTROL_POINTS = (0, 1, 3, 7)
"""Number of control points after the first, for each type of compressed coordinate (``CompressedSegment`` of cflib)."""


def handle_generic(commander: Commander, data: bytes) -> None:
    """Carry out the command in a packet to the generic commander: a type, then numbers (crtp_commander_generic.c).

    Raises:
        ConfigError: If the commander refuses the command, or the type is not supported.
        struct.error: If the data have a wrong length.
    """
    kind, content = data[0], data[1:]
    if kind == 0:
        commander.stop()
    elif kind in (1, 8):
        x, y, z, yaw_rate = struct.unpack("<ffff", content)
        commander.velocity([x, y, z], math.radians(-yaw_rate if kind == 1 else yaw_rate))
    elif kind in (5, 10):
        x, y, yaw_rate, height = struct.unpack("<ffff", content)
        commander.hover(x, y, math.radians(-yaw_rate if kind == 5 else yaw_rate), height)
    elif kind == 6:
        *numbers, packed, wx, wy, wz = struct.unpack("<9hI3h", content)
        pos, vel, acc = np.reshape(numbers, (3, 3)) / 1000
        # The firmware reads mrad/s, although the docstring of cflib 0.1.34 states degrees/s.
        commander.full_state(pos, vel, acc, unpack_quat(packed), np.array([wx, wy, wz]) / 1000)
    elif kind == 7:
        x, y, z, yaw = struct.unpack("<ffff", content)
        commander.position([x, y, z], math.radians(yaw))
    else:
        raise ConfigError(f"expected a setpoint of type 0, 1, 5, 6, 7, 8, 10 or 11, got {kind}")


def unpack_quat(packed: int) -> NDArray:
    """Return a quaternion, xyzw, from 32 bits: the index of its largest component, then 10 bits for each other. (4,)"""
    largest, quat = packed >> 30, np.zeros(4)
    for i in (i for i in (3, 2, 1, 0) if i != largest):
        magnitude = (packed & 0x1FF) / 0x1FF / math.sqrt(2)
        quat[i] = -magnitude if packed >> 9 & 1 else magnitude
        packed >>= 10
    quat[largest] = math.sqrt(max(1 - float((quat**2).sum()), 0.0))
    return quat


def handle_high_level(commander: Commander, data: bytes, memory: bytes) -> None:
    """Carry out the command in a packet to the high-level commander: a type, then numbers.

    The layout is defined in crtp_commander_high_level.c.

    Raises:
        ConfigError: If the commander refuses the command, or the type is not supported.
        struct.error: If the data have a wrong length.
    """
    kind, content = data[0], data[1:]
    if kind == 0:
        (commander.group,) = struct.unpack("<B", content)
        return
    if kind == 6:
        trajectory_id, location, encoding, offset, n_pieces = struct.unpack("<BBBIB", content)
        require(
            location == 1 and encoding in (0, 1),
            f"expected a trajectory in memory of type 0 or 1, got location {location}, type {encoding}",
        )
        trajectory = (
            _bezier_trajectory(memory, offset) if encoding else _polynomial_trajectory(memory, offset, n_pieces)
        )
        commander.upload(trajectory_id, trajectory, compressed=bool(encoding))
        return
    if not commander.in_group(content[0]):
        return
    content = content[1:]
    if kind in (1, 2):
        height, duration = struct.unpack("<ff", content)
        (commander.take_off if kind == 1 else commander.land)(height, duration, 0.0)
    elif kind in (7, 8):
        height, yaw, use_current_yaw, duration = struct.unpack("<ff?f", content)
        (commander.take_off if kind == 7 else commander.land)(height, duration, None if use_current_yaw else yaw)
    elif kind == 3:
        commander.stop()
    elif kind == 4:
        relative, x, y, z, yaw, duration = struct.unpack("<?fffff", content)
        commander.go_to([x, y, z], yaw, duration, relative)
    elif kind == 12:
        relative, linear, x, y, z, yaw, duration = struct.unpack("<??fffff", content)
        commander.go_to([x, y, z], yaw, duration, relative, linear)
    elif kind == 5:
        relative, is_reversed, trajectory_id, timescale = struct.unpack("<??Bf", content)
        commander.start_trajectory(trajectory_id, timescale, relative, is_reversed)
    elif kind == 13:
        relative, relative_yaw, is_reversed, trajectory_id, timescale = struct.unpack("<???Bf", content)
        commander.start_trajectory(trajectory_id, timescale, relative, is_reversed, relative_yaw)
    else:
        raise ConfigError(f"expected a high-level command of type 0 to 8, 12 or 13, got {kind}")


def _polynomial_trajectory(memory: bytes, offset: int, n_pieces: int) -> HostTrajectory:
    """Return the trajectory of polynomials in memory."""
    require(
        n_pieces and offset + PIECE_SIZE * n_pieces <= len(memory),
        f"expected 1 or more pieces within {len(memory)} bytes, got {n_pieces} from {offset} on",
    )
    with np.errstate(invalid="ignore"):  # NaN is refused below
        numbers = np.frombuffer(memory, "<f4", 33 * n_pieces, offset).astype(float).reshape(n_pieces, 33)
    durations, c = numbers[:, 32], numbers[:, :32].reshape(n_pieces, 4, 8)
    _check_durations(durations)
    with np.errstate(over="ignore", invalid="ignore"):
        return _create_trajectory(durations, c * durations[:, None, None] ** np.arange(8))


def _bezier_trajectory(memory: bytes, offset: int) -> HostTrajectory:
    """Return the trajectory of Bezier curves in memory: a start, then segments of control points.

    A segment of duration 0 ends the trajectory; the number of pieces in its definition is ignored
    (pptraj_compressed.c). Positions are in mm, yaw in tenths of degrees, durations in ms.
    """
    units = np.array([0.001, 0.001, 0.001, math.radians(0.1)])
    durations, pieces = [], []
    try:
        last_point, address = np.array(struct.unpack_from("<4h", memory, offset)) * units, offset + 8
        while (header := struct.unpack_from("<BH", memory, address))[1] > 0:
            coordinate_types, duration_ms = header
            address += 3
            rows = []
            for axis in range(4):
                n_points = N_CONTROL_POINTS[coordinate_types >> (2 * axis) & 3]
                points = [
                    last_point[axis],
                    *np.array(struct.unpack_from(f"<{n_points}h", memory, address)) * units[axis],
                ]
                address += 2 * n_points
                c = power_coefficients(np.array(points)[:, None])[0]
                rows.append(np.pad(c, (0, 8 - len(c))))
                last_point[axis] = points[-1]
            durations.append(duration_ms / 1000)
            pieces.append(rows)
    except struct.error:
        raise ConfigError(
            f"expected a compressed trajectory that a segment of duration 0 ends within {len(memory)} bytes, got none"
        ) from None
    if not pieces:  # the firmware stays at the start
        durations, pieces = [0.001], [[[x] + [0.0] * 7 for x in last_point]]
    return _create_trajectory(np.array(durations), np.array(pieces))


def _check_durations(durations: NDArray) -> None:
    if not len(durations) or not np.isfinite(durations).all() or not (durations > 1e-4).all() or durations.sum() > 1e5:
        raise ConfigError(f"expected pieces of positive durations, got {durations.tolist()} s")


def _create_trajectory(durations: NDArray, coefficients: NDArray) -> HostTrajectory:
    """Return a trajectory of pieces after checking their coefficients."""
    if not np.isfinite(coefficients).all() or np.abs(coefficients).max() > 1e6:
        raise ConfigError("expected a trajectory of finite coefficients, got others")
    return HostTrajectory(np.cumsum(durations), coefficients, False)
