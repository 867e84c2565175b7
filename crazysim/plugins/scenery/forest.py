"""Obstacles that stand in cells of a jittered grid: the trees of a forest, and pillars."""

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
from crazysim.core.random import GOLDEN_STRIDE
from crazysim.core.settings import setting
from crazysim.errors import ConfigError
from crazysim.geometry import Shape
from crazysim.geometry.points import POINT_DISTANCE, box_distance
from crazysim.geometry.rays import SizedShapes
from crazysim.plugins.scenery.scenery import HIDDEN_DEPTH, Model, Scenery

SIZE_BITS = 3
"""Number of bits of the index of a size. There are only 8 sizes, because contact reports compute all obstacles of one
size together."""


class CellObstacles(NamedTuple):
    """Obstacles of some cells."""

    x: Array
    """Position of the vertical axis along x, m. (...)"""
    y: Array
    """Position of the vertical axis along y, m. (...)"""
    half_yaw: Array
    """Half the angle of rotation about the axis, rad. (...)"""
    size: Array
    """Size, m: the radius of a trunk, or the width of a pillar. (...)"""
    is_standing: Array
    """Whether the cell has an obstacle. (...)"""


class StandingObstacles(Scenery):
    """Base class of upright obstacles, one in each square cell of area ``1 / density``.

    Columns of cells, which extend along y, are shifted along y by random lengths, so that no straight aisle leads along
    x. An obstacle keeps a distance of ``gap / 2`` from the edges of its cell: from every point outside the obstacles
    there is a path of width ``gap`` to every other point. The sizes of the obstacles, 8 different ones, are the same in
    all worlds.

    ``difficulty`` is the fraction of the obstacles that stand.
    """

    density: float = setting(default=1 / 16, positive=True)
    """Obstacles per square metre, 1/m^2."""
    size: ArrayLike = setting(default=(32.0, 20.0), positive=True, shapes=((2,),))
    """Length along x and width along y, m, rounded up to whole cells. (2,)"""
    center: ArrayLike = setting(default=(0.0, 0.0), shapes=((2,),))
    """Middle of the area, x and y, m. (2,)"""
    height: float = setting(default=5.0, positive=True)
    """Height of the obstacles, m."""
    gap: float = setting(default=0.6, low=0.0)
    """Smallest distance between two obstacles of a column of cells, and between columns, m."""

    @property
    def sizes(self) -> tuple[float, float]:
        """Smallest and largest size, m."""
        raise NotImplementedError

    def radius(self, size: Any) -> Any:
        """Return the radius of the circle around obstacles of a size, m. (...)"""
        raise NotImplementedError

    def model(self, size: float) -> tuple[str, dict[str, Any], Shape]:
        """Return the primitive of obstacles of a size, the settings of the primitive, and the shape."""
        raise NotImplementedError

    def distance(self, obstacles: CellObstacles, offset: Sequence[Array]) -> Array:
        """Return the distance to obstacles, m. (...)

        Args:
            offset: Components of the vectors from the middles of the obstacles to a point, world frame, m. (...) each
        """
        raise NotImplementedError

    def check_settings(self) -> None:
        super().check_settings()
        low, high = self.sizes
        if low > high:
            raise ConfigError(f"expected the smallest before the largest size of {self.name!r}, got {(low, high)}")
        if 2 * self.radius(high) + self.gap > self.cell:
            raise ConfigError(
                f"expected obstacles that fit into their cells of {self.cell:.3g} m with half the gap on each side, "
                f"got a diameter of {2 * self.radius(high):.3g} m and a gap of {self.gap:g} m. Use a lower density, or "
                f"a smaller gap."
            )
        self.check_count(float(np.prod(np.ceil(np.asarray(self.size, np.float64) / self.cell - 1e-6))))

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
    def cells_by_size(self) -> np.ndarray:
        """Cell of each obstacle, sorted by the size of the obstacles. (n,)"""
        return np.argsort(self._size_index(np.arange(math.prod(self.n_cells))), kind="stable")

    def models(self) -> Sequence[Model]:
        cells, models = self.cells_by_size, []
        middle = np.stack([*self._middle(*np.divmod(cells, self.n_cells[1])), np.zeros(len(cells))], axis=-1)
        size_index = self._size_index(cells)
        for index in np.unique(size_index):
            source, options, shape = self.model(float(self._size(index)))
            shapes = [(shape, (0.0, 0.0, self.height / 2))]
            models.append(Model(source, options, shapes, middle[size_index == index]))
        return models

    def poses(self, data: SimData) -> tuple[Array, Array]:
        obstacles = self.obstacles_in_cells(data, *np.divmod(self.cells_by_size, self.n_cells[1]))
        z = jnp.where(obstacles.is_standing, 0.0, -HIDDEN_DEPTH)
        pos, zero = jnp.stack([obstacles.x, obstacles.y, z], axis=-1), jnp.zeros_like(z)
        quat = jnp.stack([zero, zero, jnp.sin(obstacles.half_yaw), jnp.cos(obstacles.half_yaw)], axis=-1)
        return pos, quat

    def obstacles_in_cells(self, data: SimData, column: Any, row: Any) -> CellObstacles:
        """Return the obstacles of cells; cells outside the area have none.

        Args:
            data: Data of all worlds, one world, or one drone.
            column: Index of each cell along x, integer; it broadcasts with the axes of worlds. (...)
            row: Index of each cell along y, integer. (...)
        """
        layout, (n_x, n_y) = self.read(data), self.n_cells
        cell = column * n_y + row
        start_x, start_y, random_number = (layout.uniform(3 * cell + k) for k in range(3))
        turn, vel_x, vel_y = (layout.uniform(4 * n_x * n_y + 3 * cell + k) for k in range(3))
        size = self._size(self._size_index(cell)).astype(start_x.dtype)
        region_length = self.cell - self.gap - 2 * self.radius(size)
        middle_x, middle_y = self._middle(column, row)
        middle_y = middle_y + self._shift(data, column)
        x = middle_x + self.wander(data, start_x, vel_x, region_length)
        y = middle_y + self.wander(data, start_y, vel_y, region_length)
        is_inside = (column >= 0) & (column < n_x) & (row >= 0) & (row < n_y)
        is_free = self.is_free((x, y), (middle_x, middle_y), self.radius(size), region_length)
        is_standing = is_inside & (random_number < layout.difficulty) & is_free
        return CellObstacles(x, y, jnp.pi * turn, size, is_standing)

    def clearance(self, data: SimData, pos: Array) -> Array:
        """Return the distance from points to the surface of the nearest obstacle, m, negative inside. (...)

        Distances are limited to the width of a cell. Only the nine cells around a point are read, so the cost does not
        depend on the size of the area.

        Args:
            data: Data of all worlds, one world, or one drone.
            pos: Points, world frame, m: (n_worlds, n, 3), without n_worlds in one world, or (3,) for one drone.
        """
        n_x, n_y = self.n_cells
        corner_x, corner_y = self._middle(-0.5, -0.5)
        neighbours = np.arange(-1, 2, dtype=np.int32).reshape(3, *[1] * (pos.ndim - 1))
        column = neighbours + _cell_index((pos[..., 0] - corner_x) / self.cell, n_x)
        row = neighbours[:, None] + _cell_index((pos[..., 1] - corner_y - self._shift(data, column)) / self.cell, n_y)
        obstacles = self.obstacles_in_cells(data, column, row)
        offset = [pos[..., 0] - obstacles.x, pos[..., 1] - obstacles.y, pos[..., 2] - self.height / 2]
        distance = self.distance(obstacles, jnp.broadcast_arrays(*offset))
        return jnp.min(jnp.where(obstacles.is_standing & (distance < self.cell), distance, self.cell), axis=(0, 1))

    def _middle(self, column: Any, row: Any) -> tuple[Any, Any]:
        x, y = (
            middle + self.cell * (index - (n - 1) / 2)
            for middle, index, n in zip(np.asarray(self.center).tolist(), (column, row), self.n_cells, strict=True)
        )
        return x, y

    def _shift(self, data: SimData, column: Any) -> Array:
        return (self.read(data).uniform(3 * math.prod(self.n_cells) + column) - 0.5) * self.cell

    def _size_index(self, cell: Any) -> Any:
        return (cell.astype(np.uint32) * GOLDEN_STRIDE) >> (32 - SIZE_BITS)

    def _size(self, size_index: Any) -> Any:
        low, high = self.sizes
        return low + (high - low) / (2**SIZE_BITS - 1) * size_index


class Forest(StandingObstacles):
    """Upright trunks, one at a random position in each square cell of area ``1 / density``.

    Columns of cells, which extend along y, are shifted along y by random lengths, so that no straight aisle leads along
    x. A tree keeps a distance of ``gap / 2`` from the edges of its cell: from every point outside the trees there is a
    path of width ``gap`` to every other point. The radii of the trees, 8 different ones, are the same in all worlds.
    Positions differ between worlds and episodes.

    ``difficulty`` is the fraction of the trees that stand.
    """

    radii: ArrayLike = setting(default=(0.1, 0.3), positive=True, shapes=((2,),))
    """Smallest and largest radius, m. (2,)"""
    name: str = "forest"

    @property
    def sizes(self) -> tuple[float, float]:
        low, high = np.asarray(self.radii, np.float64).tolist()
        return low, high

    def radius(self, size: Any) -> Any:
        return size

    def model(self, size: float) -> tuple[str, dict[str, Any], Shape]:
        return "cylinder", {"radius": size, "height": self.height}, Shape("cylinder", (size, self.height / 2))

    def distance(self, obstacles: CellObstacles, offset: Sequence[Array]) -> Array:
        trunk = SizedShapes("cylinder", [obstacles.size, jnp.full_like(obstacles.size, self.height / 2)])
        return POINT_DISTANCE["cylinder"](trunk, jnp.stack(offset, axis=-1))


class Pillars(StandingObstacles):
    """Square pillars, randomly turned about their axes, one in each square cell of area ``1 / density``.

    For their layout see ``Forest``.
    """

    widths: ArrayLike = setting(default=(0.3, 0.8), positive=True, shapes=((2,),))
    """Smallest and largest width, m. (2,)"""
    height: float = setting(default=3.0, positive=True)
    name: str = "pillars"

    @property
    def sizes(self) -> tuple[float, float]:
        low, high = np.asarray(self.widths, np.float64).tolist()
        return low, high

    def radius(self, size: Any) -> Any:
        return size / math.sqrt(2)

    def model(self, size: float) -> tuple[str, dict[str, Any], Shape]:
        shape = Shape("box", (size / 2, size / 2, self.height / 2))
        return "wall", {"thickness": size, "length": size, "height": self.height}, shape

    def distance(self, obstacles: CellObstacles, offset: Sequence[Array]) -> Array:
        sin, cos = jnp.sin(2 * obstacles.half_yaw), jnp.cos(2 * obstacles.half_yaw)
        x, y, z = offset
        half_width = obstacles.size / 2
        box_pos = cos * x + sin * y, cos * y - sin * x, z
        return box_distance((half_width, half_width, jnp.full_like(half_width, self.height / 2)), box_pos)  # type: ignore[arg-type]


def _cell_index(position: Array, n: int) -> Array:
    return jnp.floor(jnp.clip(position, -2.0, n + 1.0)).astype(jnp.int32)
