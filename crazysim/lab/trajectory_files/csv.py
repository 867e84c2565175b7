"""Trajectories as CSV: Crazyswarm's polynomials, and positions with time stamps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.errors import require, short_repr
from crazysim.lab.trajectory_files import checks
from crazysim.lab.trajectory_files.polynomials import check_rows, trajectory_rows
from crazysim.storage import read_text, write_file
from crazysim.tables import MAX_NUMBER, read_floats
from crazysim.trajectories.interpolation import unit_coefficients
from crazysim.trajectories.splines import require_finite, trajectory_from_unit_pieces
from crazysim.trajectories.trajectory import MAX_SIZE, Trajectory

POLYNOMIAL_HEADER = ",".join(["duration", *(f"{axis}^{k}" for axis in ("x", "y", "z", "yaw") for k in range(8))])
"""Header of Crazyswarm's files, as ``uav_trajectories`` writes them."""


def load_csv(path: str | Path) -> Trajectory:
    """Load the trajectory in a CSV file. The number of columns determines the format.

    - 33 or 25: Crazyswarm's polynomials. A row is a piece: its duration, s, and eight coefficients for each of x, y and
      z, m. With 33 columns, eight coefficients of the yaw, rad, follow. The coefficients, constant term first, are for
      the time since the start of the piece, s.
    - 4 or 5: samples. A row is a time, s, and x, y and z, m. With 5 columns, the yaw, rad, follows. The trajectory
      starts at the first row. It is cubic between the samples, with velocities from central differences, and at rest at
      both ends.

    Lines that are empty, begin with ``#``, or contain a header of names are ignored.

    Raises:
        ConfigError: If the file does not exist, or a row is invalid.
    """
    rows = parse_table(read_text(path, checks.MAX_FILE_BYTES).splitlines(), str(path))
    return Trajectory.of_pieces(*check_rows(rows, str(path))) if rows.shape[1] > 5 else _fit_samples(rows, str(path))


def parse_table(lines: list[str], location: str) -> NDArray:
    """Return the numbers in the lines. (n_rows, n_columns)"""
    rows: list[list[float]] = []
    for i, line in enumerate(lines, start=1):
        cells = [cell.strip() for cell in line.strip().rstrip(",").split(",")]
        if cells == [""] or cells[0].startswith("#"):
            continue
        if len(rows) >= checks.MAX_POINTS:
            checks.raise_error(f"at most {checks.MAX_POINTS} rows", "more", f"{location}, line {i}")
        try:
            row = [float(cell) for cell in cells]
        except ValueError:
            if not rows and any(cell[:1].isalpha() for cell in cells):
                continue  # the header
            checks.raise_error("numbers", short_repr(line), f"{location}, line {i}")
        if len(row) not in (4, 5, 25, 33) or (rows and len(row) != len(rows[0])):
            expected = f"{len(rows[0])} columns, as before" if rows else "4, 5, 25 or 33 columns"
            checks.raise_error(expected, str(len(row)), f"{location}, line {i}")
        rows.append(row)
    if not rows:
        checks.raise_error("at least one row of numbers", "none", location)
    return np.array(rows)


def _fit_samples(rows: NDArray, location: str) -> Trajectory:
    if not np.all(np.isfinite(rows)) or np.abs(rows[:, 1:]).max() > checks.MAX_COORDINATE:
        checks.raise_error(f"finite numbers up to {checks.MAX_COORDINATE:g}", "others", location)
    if len(rows) < 2:
        checks.raise_error("at least two samples", "one", location)
    times = rows[:, 0] - rows[0, 0]
    checks.require_ascending(times, checks.MIN_LENGTH, location)
    if times[-1] > checks.MAX_TIME:
        checks.raise_error(f"at most {checks.MAX_TIME:g} s", f"{times[-1]:g} s", location)
    nodes = np.zeros((len(rows), 2, 4))  # values and first derivatives
    nodes[:, 0, : rows.shape[1] - 1] = rows[:, 1:]
    nodes[:, 0, 3] = np.unwrap(nodes[:, 0, 3])
    nodes[1:-1, 1] = (nodes[2:, 0] - nodes[:-2, 0]) / (times[2:] - times[:-2])[:, None]
    return trajectory_from_unit_pieces(np.diff(times), unit_coefficients(nodes, np.diff(times)))


def save_csv(trajectory: Trajectory, path: str | Path) -> None:
    """Write a trajectory as Crazyswarm's polynomials. One round of a repeating trajectory is written.

    Args:
        trajectory: Trajectory of one vehicle, of degree 7 at most.
        path: File to write.

    Raises:
        ConfigError: If its degree is higher, or the folder does not exist.
    """
    lines = [POLYNOMIAL_HEADER, *(",".join(f"{x:.9g}" for x in row) for row in trajectory_rows(trajectory))]
    write_file(path, "".join(f"{line}\n" for line in lines).encode())


def save_samples(path: str | Path, times: ArrayLike, pos: ArrayLike, yaw: ArrayLike | None = None) -> None:
    """Write positions with time stamps, for example of a flight, as a file that ``load_csv`` reads.

    Args:
        times: Times, s. (n,)
        pos: Positions, world frame, m. (n, 3)
        yaw: Yaw, rad; None to omit its column. (n,)

    Raises:
        ConfigError: If the folder does not exist.
    """
    columns = [read_floats("times", times), read_floats("pos", pos)]
    header = "t,x,y,z"
    if yaw is not None:
        columns.append(read_floats("yaw", yaw))
        header += ",yaw"
    n = columns[0].size
    shapes = [column.shape for column in columns]
    require(
        shapes == [(n,), (n, 3), (n,)][: len(shapes)],
        f"expected times (n,), positions (n, 3) and yaw (n,), got shapes {shapes}. Pass one row per time.",
    )
    for name, column, limit in zip(("times", "pos", "yaw"), columns, (MAX_NUMBER, MAX_SIZE, MAX_SIZE), strict=False):
        require_finite(column, name, limit)
    columns = [column.reshape(n, -1) for column in columns]
    lines = [header, *(",".join(f"{x:.9g}" for x in row) for row in np.concatenate(columns, axis=1))]
    write_file(path, "".join(f"{line}\n" for line in lines).encode())
