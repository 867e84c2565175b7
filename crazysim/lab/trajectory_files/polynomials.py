"""The Crazyflie's trajectory memory: the polynomials that its high-level commander flies.

Formats as packed by Bitcraze's cflib (``cflib/crazyflie/mem/trajectory_memory.py``: Poly4D, CompressedStart,
CompressedSegment) and read by the firmware (``src/modules/src/pptraj_compressed.c``).
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError
from crazysim.lab.trajectory_files import checks
from crazysim.lab.trajectory_files.pieces import require_no_jumps, split_pieces, trajectory_pieces
from crazysim.storage import read_bytes, write_file
from crazysim.trajectories.bezier import control_points, power_coefficients, significant_degree
from crazysim.trajectories.splines import trajectory_from_unit_pieces
from crazysim.trajectories.trajectory import Trajectory

POLY4D_FLOATS = 33
"""Number of floats in a Poly4D: eight coefficients for each of x, y, z and yaw, and the duration."""
DISTANCE_UNIT = 1e-3
"""Unit of compressed coordinates, m."""
ANGLE_UNIT = np.deg2rad(0.1)
"""Unit of compressed yaw, rad: a tenth of a degree."""
DURATION_UNIT = 1e-3
"""Unit of compressed durations, s."""
MAX_PIECE_DURATION = 65.0
"""Longest compressed piece, s: durations have 16 bits."""
STORED_DEGREES = (0, 1, 3, 7)
"""Degree of an axis for each two-bit code. It equals the number of stored control points: a piece does not store its
first control point, which is the last one of the previous piece."""
AXIS_UNITS = np.array([DISTANCE_UNIT, DISTANCE_UNIT, DISTANCE_UNIT, ANGLE_UNIT])
"""Units of compressed x, y, z, m, and yaw, rad. (4,)"""


def pack_poly4d(trajectory: Trajectory) -> bytes:
    """Pack a trajectory as uncompressed polynomials of the time in seconds, 33 floats per piece.

    Args:
        trajectory: Trajectory of one vehicle, of degree 7 at most.
    """
    return trajectory_rows(trajectory).astype("<f4")[:, [*range(1, POLY4D_FLOATS), 0]].tobytes()


def unpack_poly4d(content: bytes, location: str = "a trajectory memory") -> Trajectory:
    """Unpack the trajectory of uncompressed polynomials.

    Args:
        location: File, for messages.
    """
    return Trajectory.of_pieces(*read_poly4d(content, location))


def read_poly4d(content: bytes, location: str) -> tuple[NDArray, NDArray]:
    """Return the durations and coefficients of uncompressed polynomials, as ``check_rows`` does."""
    size = 4 * POLY4D_FLOATS
    if not content or len(content) % size or len(content) // size > checks.MAX_POINTS:
        checks.raise_error(f"1 to {checks.MAX_POINTS} pieces of {size} bytes", f"{len(content)} bytes", location)
    with np.errstate(invalid="ignore"):  # NaN is refused below
        rows = np.frombuffer(content, "<f4").reshape(-1, POLY4D_FLOATS).astype(float)
    return check_rows(rows[:, [POLY4D_FLOATS - 1, *range(POLY4D_FLOATS - 1)]], location)


def check_rows(rows: NDArray, location: str) -> tuple[NDArray, NDArray]:
    """Return the durations, s, (n_pieces,), and the coefficients, (n_pieces, 3 or 4, 8), of rows, after a check.

    Args:
        rows: Duration, s, and coefficients of x, y, z, m, and yaw, rad, for the time in seconds. (n_pieces, 33), or
            (n_pieces, 25) without yaw.
        location: File, for messages.
    """
    durations, c = rows[:, 0], rows[:, 1:].reshape(len(rows), -1, 8)
    if not np.all(np.isfinite(rows)):
        checks.raise_error("finite numbers", "others", f"{location}, piece {int(np.argmin(np.isfinite(rows).all(1)))}")
    if not np.all(durations >= checks.MIN_LENGTH * (1 - 1e-6)) or durations.sum() > checks.MAX_TIME:
        k = int(np.argmin(durations))
        checks.raise_error(
            f"durations of at least {checks.MIN_LENGTH:g} s and at most {checks.MAX_TIME:g} s in all",
            f"{durations[k]:g} s and {durations.sum():g} s",
            f"{location}, piece {k}",
        )
    magnitudes = np.abs(c) * durations[:, None, None] ** np.arange(8)
    if not np.all(magnitudes < checks.MAX_COORDINATE):
        k = int(np.argmax(magnitudes.max((1, 2))))
        checks.raise_error(
            f"coordinates up to {checks.MAX_COORDINATE:g}", f"{magnitudes[k].max():g}", f"{location}, piece {k}"
        )
    return durations, c


def _crazyflie_pieces(trajectory: Trajectory) -> tuple[NDArray, NDArray]:
    ends, c = trajectory_pieces(trajectory)
    if c.shape[2] > 8:
        raise ConfigError(
            f"expected polynomials of degree 7 at most, as the Crazyflie flies, got degree {c.shape[2] - 1}"
        )
    return ends, c


def trajectory_rows(trajectory: Trajectory) -> NDArray:
    """Return the duration of each piece, s, and its coefficients for the time in seconds. (n_pieces, 33)"""
    ends, c = _crazyflie_pieces(trajectory)
    durations = np.diff(ends, prepend=0.0)
    c = np.pad(c, ((0, 0), (0, 0), (0, 8 - c.shape[2]))) / durations[:, None, None] ** np.arange(8)
    return np.concatenate([durations[:, None], c.reshape(len(c), -1)], axis=1)


def pack_compressed(trajectory: Trajectory) -> bytes:
    """Pack a trajectory as compressed polynomials: control points in millimetres and tenths of degrees.

    Every axis of a piece has the lowest of the degrees 0, 1, 3 and 7 that is accurate to a tenth of a unit. The
    trajectory is also split every 65 s, because a piece cannot last longer.

    Args:
        trajectory: Trajectory of one vehicle, of degree 7 at most.
    """
    ends, c = _crazyflie_pieces(trajectory)
    require_no_jumps(ends, c)
    ends, c = split_pieces(ends, c, np.arange(MAX_PIECE_DURATION, ends[-1], MAX_PIECE_DURATION))
    c = c / AXIS_UNITS[:, None]
    end_units = np.round(ends / DURATION_UNIT).astype(int)
    durations = np.diff(end_units, prepend=0)
    if not np.all(durations > 0):
        raise ConfigError(f"expected pieces of at least 1 ms, got {int(durations.min())} ms. Merge shorter pieces.")
    content = bytearray(_pack_shorts(c[0, :, 0]))
    for duration, axes in zip(durations, c, strict=True):
        degrees = [min(d for d in STORED_DEGREES if d >= significant_degree(axis[None], 0.1)) for axis in axes]
        header = sum(STORED_DEGREES.index(degree) << 2 * k for k, degree in enumerate(degrees))
        content += struct.pack("<BH", header, duration)
        for axis, degree in zip(axes, degrees, strict=True):
            content += _pack_shorts(control_points(axis[None, : degree + 1], degree)[1:, 0])
    return bytes(content) + struct.pack("<BH", 0, 0)  # a piece of no duration ends the trajectory


def _pack_shorts(values: NDArray) -> bytes:
    rounded = np.round(values)
    if rounded.size and np.abs(rounded).max() > 32767:
        raise ConfigError(
            "expected coordinates within 32.767 m and 3276.7 degrees of zero, which 16 bits can hold, got others. "
            "Move the trajectory, or save it uncompressed."
        )
    return rounded.astype("<i2").tobytes()


def unpack_compressed(content: bytes, location: str = "a trajectory memory") -> Trajectory:
    """Unpack the trajectory of compressed polynomials.

    Args:
        content: Contents of the memory; bytes after a piece of zero duration are ignored.
        location: File, for messages.
    """
    durations, pieces, _ = read_compressed(content, location)
    if not len(pieces):
        checks.raise_error(f"pieces of up to {checks.MAX_TIME:g} s in all", "none", location)
    return trajectory_from_unit_pieces(durations, pieces)


def read_compressed(content: bytes, location: str) -> tuple[NDArray, NDArray, NDArray]:
    """Return the pieces of compressed polynomials, and the point at which they start, m and rad. (4,)

    The pieces are their durations, s, (n_pieces,), and coefficients for unit time, (n_pieces, 4, 8).
    """
    try:
        points = start = np.array(struct.unpack_from("<hhhh", content), float)
        offset, durations, pieces = 8, [], []
        while offset < len(content):
            header, duration = struct.unpack_from("<BH", content, offset)
            offset += 3
            if not duration:
                break
            piece, end_points = np.zeros((4, 8)), points.copy()
            for axis in range(4):
                degree = STORED_DEGREES[header >> 2 * axis & 3]
                later_points = struct.unpack_from(f"<{degree}h", content, offset)
                offset += 2 * degree
                curve = np.array([points[axis], *later_points], float)
                piece[axis, : degree + 1] = power_coefficients(curve[:, None])[0]
                end_points[axis] = curve[-1]
            points = end_points
            durations.append(duration)
            pieces.append(piece)
            if len(pieces) > checks.MAX_POINTS:
                checks.raise_error(f"at most {checks.MAX_POINTS} pieces", "more", location)
    except struct.error:
        checks.raise_error("complete pieces", f"{len(content)} bytes that end within one", location)
    ends = DURATION_UNIT * np.cumsum(durations)
    if pieces and ends[-1] > checks.MAX_TIME:
        checks.raise_error(f"pieces of up to {checks.MAX_TIME:g} s in all", "longer ones", location)
    coefficients = np.reshape(pieces, (-1, 4, 8)) * AXIS_UNITS[:, None]
    return np.diff(ends, prepend=0.0), coefficients, start * AXIS_UNITS


def save_memory(trajectory: Trajectory, path: str | Path, compressed: bool = False) -> None:
    """Write a trajectory in the format of the Crazyflie's trajectory memory; one round if it repeats.

    Args:
        trajectory: Trajectory of one vehicle.
        compressed: Whether to use the compressed format.

    Raises:
        ConfigError: If the folder does not exist, or the format cannot hold the trajectory.
    """
    write_file(path, pack_compressed(trajectory) if compressed else pack_poly4d(trajectory))


def load_memory(path: str | Path, compressed: bool = False) -> Trajectory:
    """Load the trajectory in a file from ``save_memory``, or in a copy of a Crazyflie's trajectory memory.

    Args:
        compressed: Whether the format is the compressed one, which the contents do not identify.

    Raises:
        ConfigError: If the file does not exist or is not of that format.
    """
    content = read_bytes(path, checks.MAX_FILE_BYTES)
    return (unpack_compressed if compressed else unpack_poly4d)(content, str(path))
