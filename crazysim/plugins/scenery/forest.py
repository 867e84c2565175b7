"""Forests: trees in cells of a jittered grid."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import SimData
from crazysim.core.random import STRIDE
from crazysim.core.settings import setting
from crazysim.errors import ConfigError
from crazysim.geometry.points import POINT_DISTANCE
from crazysim.geometry.rays import SizedShapes
from crazysim.plugins.scenery.scenery import HIDDEN_DEPTH, Model, Scenery, SceneryData

SIZE_BITS = 3
"""Bits of the number of a radius: there are 8, so that a contact report computes trees of one radius side by side."""


class Trees(NamedTuple):
    """Trees of some cells."""

    x: Array
    """Position of the axis, m. (...)"""
    y: Array
    """Position of the axis, m. (...)"""
    radius: Array
    """Radius, m. (...)"""
    stands: Array
    """True where the cell has a tree. (...)"""


class Forest(Scenery):
    """Upright trunks, one in each square cell of ``1 / density``, with another place in it in every world and episode.

    Columns of cells, along y, are shifted against each other by a random length, so that there are no straight aisles
    along x. A tree keeps a distance of ``gap / 2`` from the edges of its cell: from every point beside the trees there
    is a path of width ``gap`` to every other. Which tree has which of 8 radii is the same in all worlds.

    ``difficulty`` is the share of the trees that stand.
    """

    density: float = setting(default=1 / 16, positive=True)
    """Trees per square metre, 1/m^2."""
    radii: ArrayLike = setting(default=(0.1, 0.3), positive=True, shapes=((2,),))
    """Smallest and largest radius, m. (2,)"""
    size: ArrayLike = setting(default=(32.0, 20.0), positive=True, shapes=((2,),))
    """Length along x and width along y, m, rounded up to whole cells. (2,)"""
    center: ArrayLike = setting(default=(0.0, 0.0), shapes=((2,),))
    """Middle of the forest, x and y, m. (2,)"""
    height: float = setting(default=5.0, positive=True)
    """Height of the trees, m."""
    gap: float = setting(default=0.6, low=0.0)
    """Smallest distance between two trees of a column of cells and between columns, m."""
    name: str = "forest"

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = np.asarray(self.radii, np.float64)
        if low > high:
            raise ConfigError(f"expected radii as smallest and largest, got {self.radii!r}")
        if 2 * high + self.gap > self.cell:
            raise ConfigError(
                f"expected trees that fit into their cells of {self.cell:.3g} m with half the gap on each side, got a "
                f"diameter of {2 * high:g} m and a gap of {self.gap:g} m. Use a lower density, or a smaller gap."
            )

    @property
    def cell(self) -> float:
        """Width of a cell, m."""
        return 1 / math.sqrt(self.density)

    @property
    def n_cells(self) -> tuple[int, int]:
        """Number of cells along x and along y."""
        n_x, n_y = np.ceil(np.asarray(self.size, np.float64) / self.cell - 1e-6).astype(int).tolist()
        return n_x, n_y

    @functools.cached_property
    def order(self) -> np.ndarray:
        """Cell of each tree: trees of one radius are neighbours. (n_trees,)"""
        return np.argsort(self._size_index(np.arange(math.prod(self.n_cells))), kind="stable")

    def models(self) -> Sequence[Model]:
        cells, models = self.order, []
        column, row = np.divmod(cells, self.n_cells[1])
        middle = np.stack([*self._middle(column, row), np.zeros(len(cells))], axis=-1)
        size_index = self._size_index(cells)
        for index in np.unique(size_index):
            radius = float(self._radius(index))
            models.append(Model("cylinder", {"radius": radius, "height": self.height}, middle[size_index == index]))
        return models

    def poses(self, data: SimData) -> tuple[Array, Array]:
        trees = self.trees(self.read(data), *np.divmod(self.order, self.n_cells[1]))
        z = jnp.where(trees.stands, 0.0, -HIDDEN_DEPTH)
        pos = jnp.stack([trees.x, trees.y, z], axis=-1)
        return pos, jnp.broadcast_to(jnp.asarray([0.0, 0.0, 0.0, 1.0], pos.dtype), (*pos.shape[:-1], 4))

    def trees(self, record: SceneryData, column: Any, row: Any) -> Trees:
        """Return the trees of cells, absent for cells outside of the forest.

        Args:
            record: Record of all worlds, of one world or of one drone.
            column: Index of each cell along x, integer; it broadcasts with the axes of worlds. (...)
            row: Index along y. (...)
        """
        n_x, n_y = self.n_cells
        cell = column * n_y + row
        x, y = self._middle(column, row)
        u, v, w = (record.uniform(3 * cell + k) for k in range(3))
        radius = self._radius(self._size_index(cell)).astype(u.dtype)
        reach = self.cell - self.gap - 2 * radius
        x, y = x + (u - 0.5) * reach, y + (v - 0.5) * reach + self._shift(record, column)
        is_inside = (column >= 0) & (column < n_x) & (row >= 0) & (row < n_y)
        return Trees(x, y, radius, is_inside & (w < record.difficulty) & self.is_free(x, y, radius))

    def clearance(self, data: SimData, pos: Array) -> Array:
        """Return the distance from points to the surface of the nearest tree, m, negative inside. (...)

        Distances are computed up to the width of a cell; where the nearest tree is farther away, that is the result.
        Only the nine cells around a point are read, so the cost does not depend on the size of the forest.

        Args:
            data: All worlds, one world, or one drone.
            pos: Points, world frame, m: (n_worlds, n, 3), without n_worlds in one world, or (3,) for one drone.
        """
        record, (n_x, n_y) = self.read(data), self.n_cells
        corner_x, corner_y = self._middle(-0.5, -0.5)
        neighbours = np.arange(-1, 2, dtype=np.int32).reshape(3, *[1] * (pos.ndim - 1))
        column = neighbours + _cell_index((pos[..., 0] - corner_x) / self.cell, n_x)
        shift = self._shift(record, column)
        row = neighbours[:, None] + _cell_index((pos[..., 1] - corner_y - shift) / self.cell, n_y)
        trees = self.trees(record, column, row)
        offset = [pos[..., 0] - trees.x, pos[..., 1] - trees.y, pos[..., 2] - self.height / 2]
        trunk = SizedShapes("cylinder", [trees.radius, jnp.full_like(trees.radius, self.height / 2)])
        distance = POINT_DISTANCE["cylinder"](trunk, jnp.stack(jnp.broadcast_arrays(*offset), axis=-1))
        return jnp.min(jnp.where(trees.stands & (distance < self.cell), distance, self.cell), axis=(0, 1))

    def _middle(self, column: Any, row: Any) -> tuple[Any, Any]:
        """Return the middle of cells, before the shifts of the columns, m. (...) and (...)"""
        x, y = (
            middle + self.cell * (index - (n - 1) / 2)
            for middle, index, n in zip(np.asarray(self.center).tolist(), (column, row), self.n_cells, strict=True)
        )
        return x, y

    def _shift(self, record: SceneryData, column: Any) -> Array:
        """Return the shift of columns of cells along y, m. (...)"""
        return (record.uniform(3 * math.prod(self.n_cells) + column) - 0.5) * self.cell

    def _size_index(self, cell: Any) -> Any:
        """Return the number of the radius of the trees of cells, from 0 to 7. (...)"""
        return (cell.astype(np.uint32) * STRIDE) >> (32 - SIZE_BITS)

    def _radius(self, size_index: Any) -> Any:
        """Return the radius with a number, m. (...)"""
        low, high = np.asarray(self.radii, np.float64).tolist()
        return low + (high - low) / (2**SIZE_BITS - 1) * size_index


def _cell_index(position: Array, n: int) -> Array:
    """Return the index of the cell of a position in units of cells, from -2 to n + 1. (...)"""
    return jnp.floor(jnp.clip(position, -2.0, n + 1.0)).astype(jnp.int32)
