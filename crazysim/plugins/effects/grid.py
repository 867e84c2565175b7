"""Values at the nodes of regular grids, and their interpolation at any position."""

from __future__ import annotations

import math
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.errors import ConfigError
from crazysim.rotation import clip
from crazysim.storage import read_text
from crazysim.tables import ANY_NUMBER, MAX_NUMBER, POSITIVE, read_numbers

MAX_FUSED_VALUES = 400_000
"""Largest number of values of a table that a fused kernel reads; each value adds 8 µs to the compilation of the
step."""
UNFUSED_REASON = f"its table has more than {MAX_FUSED_VALUES:,} numbers"
"""Reason why a stage that reads a larger table is not fused."""
MAX_FILE_BYTES = 2**30
"""Largest size of a file with a grid, bytes."""
MAX_SPACING_ERROR = 1e-3
"""Largest relative difference between the distances of nodes along an axis of a regular grid."""


class Grid(NamedTuple):
    """Values at the nodes of a regular grid, along x, y and z."""

    values: ArrayLike
    """Values. (n_x, n_y, n_z) or (n_x, n_y, n_z, k)"""
    origin: ArrayLike = (0.0, 0.0, 0.0)
    """Position of the node with the smallest x, y and z, m. (3,)"""
    spacing: ArrayLike = 1.0
    """Distance between neighbouring nodes, m. () or (3,)"""

    def checked(self, name: str, k: int | None = None) -> Grid:
        """Return the grid as checked NumPy arrays, with one spacing per axis.

        Args:
            k: Length of the vector at each node; None for a grid of scalars.
        """
        values, origin, spacing = (
            read_numbers(f"{key} of {name}", getattr(self, key), POSITIVE if key == "spacing" else ANY_NUMBER)
            for key in ("values", "origin", "spacing")
        )
        core = () if k is None else (k,)
        if values.ndim != 3 + len(core) or values.shape[3:] != core or min(values.shape) < 1:
            node_values = "one number" if k is None else f"{k} numbers"
            shape = f"(n_x, n_y, n_z{', ' if core else ''}{', '.join(map(str, core))})"
            raise ConfigError(
                f"expected {name} as values of shape {shape}, got {values.shape}. Give each node of the "
                f"grid {node_values}."
            )
        if origin.shape != (3,) or spacing.shape not in ((), (3,)):
            raise ConfigError(
                f"expected {name} with an origin of shape (3,) and a spacing of shape () or (3,), m, got "
                f"{self.origin!r} and {self.spacing!r}. Use origin=(0, 0, 0) and spacing=0.5, for example."
            )
        return Grid(values, origin, np.broadcast_to(spacing, (3,)))


def interpolate(values: Array, position: Array) -> Array:
    """Interpolate between the nodes of a grid, linearly along each axis (trilinear with three axes). (..., *core)

    A position outside takes the value of the nearest position inside. The gradient with respect to the position is the
    gradient within the cell; outside the grid it is zero.

    Args:
        values: Values at the nodes. (n_1, ..., n_d, *core)
        position: Position in units of cells, 0 to n - 1 along each axis. (..., d)
    """
    n_axes = position.shape[-1]
    axis_weights, nodes = [], []
    for k in range(n_axes):
        last_node = values.shape[k] - 1
        coordinate = clip(position[..., k], 0.0, float(last_node))
        lower_node = jnp.clip(jnp.floor(coordinate), 0, max(last_node - 1, 0))
        fraction, lower_node = coordinate - lower_node, lower_node.astype(jnp.int32)
        nodes.append((lower_node, jnp.minimum(lower_node + 1, last_node)))
        axis_weights.append((1 - fraction, fraction))
    core = (1,) * (values.ndim - n_axes)
    total: Any = 0.0
    for corner in product((0, 1), repeat=n_axes):
        node = values.at[tuple(nodes[k][c] for k, c in enumerate(corner))]
        weight: Array | float = 1.0
        for k, c in enumerate(corner):
            weight = weight * axis_weights[k][c]
        corner_values = node.get(mode="promise_in_bounds", wrap_negative_indices=False)
        total = total + weight.reshape(weight.shape + core) * corner_values
    return total


def is_inside(shape: tuple[int, ...], position: Array) -> Array:
    """Return True for positions within a grid. (...)

    Args:
        shape: Numbers of nodes along the axes. (d,)
        position: Position in units of cells. (..., d)
    """
    last_node = jnp.asarray(np.array(shape) - 1, position.dtype)
    return jnp.all((position >= 0) & (position <= last_node), axis=-1)


def load_wind_grid(path: str | Path) -> Grid:
    """Load a grid of velocities from a CSV file, as ParaView exports the points of a flow on a regular grid.

    The columns ``Points:0``, ``Points:1``, ``Points:2`` are positions, m, and ``U:0``, ``U:1``, ``U:2`` velocities,
    m/s, with one row for each node, in any order. Other columns are ignored.

    Raises:
        ConfigError: If the file cannot be read, a column is missing, or the points are not the nodes of a regular grid.
    """
    # Columns of the file.
    header, *rows = read_text(path, MAX_FILE_BYTES).splitlines() or [""]
    names = [name.strip().strip('"') for name in header.split(",")]
    columns = [f"{kind}:{k}" for kind in ("Points", "U") for k in range(3)]
    missing = [name for name in columns if name not in names]
    if missing:
        raise ConfigError(
            f"expected columns {', '.join(columns)} in {str(path)!r}, got none named {missing[0]!r}. Export points "
            f"and the vector U from ParaView, or rename the columns."
        )
    if not any(map(str.strip, rows)):
        raise ConfigError(f"expected one row for each node of a grid in {str(path)!r}, got the names of columns only")
    # Finite numbers in every row.
    try:
        table = np.loadtxt(rows, delimiter=",", usecols=[names.index(name) for name in columns], ndmin=2)
    except ValueError as error:
        raise ConfigError(
            f"expected numbers in the columns of {str(path)!r}, got: {error}. Correct or remove that row."
        ) from error
    if not np.all(np.abs(table) <= MAX_NUMBER):
        raise ConfigError(
            f"expected finite numbers in {str(path)!r}, got NaN, infinity or a number above {MAX_NUMBER:g}. "
            f"Fill the gaps."
        )
    # Nodes of a regular grid.
    axes, indices = zip(*(_find_nodes(table[:, k]) for k in range(3)), strict=True)
    shape = tuple(map(len, axes))
    is_full = len(table) == math.prod(shape)  # checked before an array of that size is allocated
    values = np.full((*shape, 3), np.nan) if is_full else np.array(np.nan)
    if is_full:
        values[indices] = table[:, 3:]
    if np.isnan(values).any():
        raise ConfigError(
            f"expected one row for each of the {' x '.join(map(str, shape))} nodes of a regular grid in {str(path)!r}, "
            f"got {len(table)} rows. Resample the flow to an image in ParaView before the export."
        )
    # Equal distances along each axis.
    spacing = []
    for axis in axes:
        steps = np.diff(axis) if len(axis) > 1 else np.ones(1)
        if np.ptp(steps) > MAX_SPACING_ERROR * steps.mean():
            raise ConfigError(
                f"expected nodes at equal distances in {str(path)!r}, got {steps.min()} to {steps.max()} m. Resample "
                f"the flow to an image in ParaView before the export."
            )
        spacing.append(float(steps.mean()))
    return Grid(values, tuple(float(axis[0]) for axis in axes), tuple(spacing))


def _find_nodes(coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    ascending = np.sort(coordinates)
    extent = max(ascending[-1] - ascending[0], 1e-9)
    axis = ascending[np.concatenate([[True], np.diff(ascending) > 1e-6 * extent])]
    middles = (axis[1:] + axis[:-1]) / 2
    return axis, np.searchsorted(middles, coordinates)
