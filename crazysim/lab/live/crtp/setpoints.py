"""Contents of CRTP packets with commands: streamed setpoints, high-level commands, trajectories in memory."""

from __future__ import annotations

import math
import struct

import numpy as np

from crazysim.errors import ConfigError, require
from crazysim.lab.live.attitude import decompress_quat
from crazysim.lab.live.host_trajectory import HostTrajectory
from crazysim.lab.live.swarm.commander import Commander
from crazysim.lab.trajectory_files.polynomials import read_compressed, read_poly4d

PIECE_SIZE = 132
"""Size of an uncompressed piece, bytes: 8 coefficients each of x, y, z and yaw, and the duration."""
MEMORY = "the trajectory memory"
"""Location of trajectories in messages."""


def handle_generic(commander: Commander, data: bytes) -> None:
    """Carry out the command in a packet to the generic commander: a type, then numbers (crtp_commander_generic.c).

    Raises:
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
        commander.full_state(pos, vel, acc, decompress_quat(np.array([packed]))[0], np.array([wx, wy, wz]) / 1000)
    elif kind == 7:
        x, y, z, yaw = struct.unpack("<ffff", content)
        commander.position([x, y, z], math.radians(yaw))
    else:
        raise ConfigError(f"expected a setpoint of type 0, 1, 5, 6, 7, 8, 10 or 11, got {kind}")


def handle_high_level(commander: Commander, data: bytes, memory: bytes) -> None:
    """Carry out the command in a packet to the high-level commander: a type, then numbers.

    The layout is defined in crtp_commander_high_level.c.

    Raises:
        struct.error: If the data have a wrong length.
    """
    kind, content = data[0], data[1:]
    # Commands without a group of drones.
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
    # Commands to one group.
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
    end = offset + PIECE_SIZE * n_pieces
    require(
        n_pieces and end <= len(memory),
        f"expected 1 or more pieces within {len(memory)} bytes, got {n_pieces} from {offset} on",
    )
    return HostTrajectory.of_pieces(*read_poly4d(memory[offset:end], MEMORY))


def _bezier_trajectory(memory: bytes, offset: int) -> HostTrajectory:
    durations, pieces, start = read_compressed(memory[offset:], MEMORY)
    if not len(pieces):  # the firmware stays at the start
        durations, pieces = np.array([0.001]), np.pad(start[None, :, None], ((0, 0), (0, 0), (0, 7)))
    return HostTrajectory(np.cumsum(durations), pieces, False)
