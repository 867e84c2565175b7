"""Tables of the air below a drone: pressure or velocity on a grid in the drone's frame, for several rotor speeds."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from crazysim.errors import ConfigError
from crazysim.storage import read_text
from crazysim.tables import POSITIVE, read_numbers

VOXEL_EDGE = 0.01
"""Edge of a voxel of AIMotionLab's tables, m."""
LAB_VOXELS = 81
"""Voxels along x and y of AIMotionLab's later tables (as in AIMotionLab-Virtual, July 2026)."""


class JetTable(NamedTuple):
    """Air around a hovering drone for several rotor speeds, on a regular grid that moves and turns with the drone."""

    speeds: ArrayLike
    """Means of the rotors' speeds, rad/s, ascending. (k,)"""
    pressure: Any = None
    """Pressures, Pa; None without pressures. (k, n_x, n_y, n_z)"""
    velocity: Any = None
    """Velocities of the air, body frame, m/s; None without velocities. (k, n_x, n_y, n_z, 3)"""
    origin: ArrayLike = (0.0, 0.0, 0.0)
    """Position of the first node, relative to the drone's centre of mass, body frame, m. (3,)"""
    spacing: ArrayLike = VOXEL_EDGE
    """Distance between neighbouring nodes, m. () or (3,)"""

    @property
    def shape(self) -> tuple[int, ...]:
        """Numbers of rotor speeds and of nodes along x, y and z. (4,)"""
        return np.shape(self.velocity if self.pressure is None else self.pressure)[:4]

    def checked(self) -> JetTable:
        """Return the table as checked NumPy arrays, with one spacing per axis."""
        speeds = read_numbers("speeds", self.speeds, POSITIVE)
        if speeds.ndim != 1 or np.any(np.diff(speeds) <= 0):
            raise ConfigError(f"expected positive rotor speeds in ascending order, rad/s, got {self.speeds!r}")
        if self.pressure is None and self.velocity is None:
            raise ConfigError(
                "expected a table of pressure or velocity, got neither. Use pressure=, velocity= or both."
            )
        arrays: dict[str, np.ndarray] = {}
        for name, vector_shape in (("pressure", ()), ("velocity", (3,))):
            value = getattr(self, name)
            if value is None:
                continue
            value = read_numbers(name, value)
            if value.ndim != 4 + len(vector_shape) or len(value) != len(speeds) or value.shape[4:] != vector_shape:
                shape = f"({len(speeds)}, n_x, n_y, n_z{', 3' if vector_shape else ''})"
                raise ConfigError(f"expected {name} of shape {shape} for {len(speeds)} speeds, got {value.shape}")
            arrays[name] = value
        if len({x.shape[:4] for x in arrays.values()}) > 1:
            raise ConfigError(
                f"expected pressure and velocity on the same grid, got {arrays['pressure'].shape} and "
                f"{arrays['velocity'].shape}. Use two RotorJet with a name each for two grids."
            )
        origin, spacing = read_numbers("origin", self.origin), read_numbers("spacing", self.spacing, POSITIVE)
        if origin.shape != (3,) or spacing.shape not in ((), (3,)):
            raise ConfigError(
                f"expected an origin of shape (3,) and a spacing of shape () or (3,), m, got "
                f"{self.origin!r} and {self.spacing!r}. Use spacing=0.01 for cubes of a centimetre, for example."
            )
        return JetTable(speeds, arrays.get("pressure"), arrays.get("velocity"), origin, np.broadcast_to(spacing, (3,)))


MAX_TABLE_BYTES = 2**28
"""Largest file of a table, bytes."""


def load_jet_table(
    folder: str | Path,
    shape: tuple[int, int, int] | None = None,
    spacing: float = VOXEL_EDGE,
    origin: ArrayLike | None = None,
) -> JetTable:
    """Load the table in a folder of text files as AIMotionLab writes them.

    Each file ``*_NNNN.txt`` is the air at NNNN rad/s, the mean of the rotors' speeds: one row per node, z fastest, then
    y, then x, with one number for a pressure, Pa, or three for a velocity, m/s. A folder may have files of both kinds.

    Args:
        shape: Nodes along x, y and z; None for a cube if the number of rows is a cube number, and otherwise 81 x 81 x
            n.
        spacing: Distance between nodes, m.
        origin: Position of the first node relative to the drone's centre of mass, m (3,); None for a box centred below
            the drone, as in the lab.

    Raises:
        ConfigError: If the folder has no such files, or their sizes do not match.
    """
    files = sorted(Path(folder).glob("*.txt"))
    path_speeds = [(path, int(match[1])) for path in files if (match := re.fullmatch(r".*_(\d+)", path.stem))]
    if not path_speeds:
        raise ConfigError(
            f"expected files named NAME_SPEED.txt with the rotor speed in rad/s, such as pressure_1500.txt, in "
            f"{str(folder)!r}, got {', '.join(path.name for path in files) or 'none'}"
        )
    # By the number of columns: 1 for pressures, 3 for velocities.
    rows_by_speed: dict[int, dict[int, np.ndarray]] = {1: {}, 3: {}}
    for path, speed in path_speeds:
        try:
            rows = np.loadtxt(read_text(path, MAX_TABLE_BYTES).splitlines(), ndmin=2)
        except ValueError as error:
            raise ConfigError(f"expected a table of numbers in {str(path)!r}, got: {error}") from error
        if rows.shape[1] not in rows_by_speed:
            raise ConfigError(f"expected one or three columns in {str(path)!r}, got {rows.shape[1]}")
        if speed in rows_by_speed[rows.shape[1]]:
            raise ConfigError(f"expected one table for each speed, got a second for {speed} rad/s, {str(path)!r}")
        rows_by_speed[rows.shape[1]][speed] = rows
    pressure, velocity = rows_by_speed[1], rows_by_speed[3]
    speeds = sorted(pressure or velocity)
    if pressure and velocity and sorted(velocity) != speeds:
        raise ConfigError(f"expected velocities at the speeds of the pressures, {speeds}, got {sorted(velocity)}")
    n_rows = {len(rows) for tables in (pressure, velocity) for rows in tables.values()}
    if len(n_rows) > 1:
        raise ConfigError(f"expected the same number of rows in all files of {str(folder)!r}, got {sorted(n_rows)}")
    table_shape = _table_shape(n_rows.pop(), shape)
    corner = (
        np.array([-table_shape[0] / 2, -table_shape[1] / 2, -table_shape[2]]) * spacing
        if origin is None
        else np.asarray(origin)
    )
    return JetTable(
        speeds=np.array(speeds, np.float64),
        pressure=np.stack([pressure[s].reshape(table_shape) for s in speeds]) if pressure else None,
        velocity=np.stack([velocity[s].reshape(*table_shape, 3) for s in speeds]) if velocity else None,
        origin=tuple(map(float, corner)),
        spacing=spacing,
    ).checked()


def _table_shape(n_rows: int, shape: tuple[int, int, int] | None) -> tuple[int, int, int]:
    side = round(n_rows ** (1 / 3))
    if shape is None:
        shape = (side, side, side) if side**3 == n_rows else (LAB_VOXELS, LAB_VOXELS, n_rows // LAB_VOXELS**2)
    if len(shape) != 3 or int(np.prod(shape)) != n_rows:
        raise ConfigError(f"expected {' x '.join(map(str, shape))} rows, got {n_rows}. Use shape=(n_x, n_y, n_z).")
    return tuple(map(int, shape))  # type: ignore[return-value]
