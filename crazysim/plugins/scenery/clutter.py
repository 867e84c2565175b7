"""Clutter: boxes, balls and convex meshes in the air."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import SimData
from crazysim.core.settings import setting
from crazysim.errors import ConfigError, short_repr
from crazysim.geometry import Shape, hull
from crazysim.plugins.scenery.scenery import HIDDEN_DEPTH, Model, Scenery
from crazysim.tables import read_numbers

N_SIZES = 4
"""Number of sizes of boxes, and of balls."""
ORIGIN = (0.0, 0.0, 0.0)
"""Position of a shape in the middle of its obstacle, m."""


class Clutter(Scenery):
    """Boxes, balls and convex meshes at any attitude, one in each cubic cell of volume ``1 / density``.

    An obstacle keeps a distance of ``gap / 2`` from the sides of its cell, so that aisles of width ``gap`` lead along
    all sides. Successive cells contain boxes and balls, of 4 sizes each, and meshes, in the same order in all worlds.

    ``difficulty`` is the fraction of the obstacles that are present.
    """

    density: float = setting(default=1 / 8, positive=True)
    """Obstacles per cubic metre, 1/m^3."""
    size: ArrayLike = setting(default=(12.0, 8.0, 4.0), positive=True, shapes=((3,),))
    """Lengths along x, y and z, m, rounded up to whole cells. (3,)"""
    center: ArrayLike = setting(default=(0.0, 0.0, 2.0), shapes=((3,),))
    """Middle of the area, m. (3,)"""
    sizes: ArrayLike = setting(default=(0.2, 0.6), positive=True, shapes=((2,),))
    """Smallest and largest edge of a box and diameter of a ball, m. (2,)"""
    meshes: Sequence[Any] = setting(default=())
    """Corners of each convex mesh, in its own frame, m. (n, 3) each"""
    gap: float = setting(default=0.6, low=0.0)
    """Smallest distance between two obstacles, m."""
    name: str = "clutter"

    def check_settings(self) -> None:
        super().check_settings()
        low, high = np.asarray(self.sizes, np.float64)
        if low > high:
            raise ConfigError(f"expected sizes as smallest and largest, got {self.sizes!r}")
        diameter = 2 * max(_bounding_radius(shape) for _, _, shape in self._kinds())
        if diameter + self.gap > self.cell:
            raise ConfigError(
                f"expected obstacles that fit into their cells of {self.cell:.3g} m with half the gap on each side, "
                f"got a diameter of {diameter:.3g} m and a gap of {self.gap:g} m. Use a lower density, or a smaller "
                f"gap."
            )
        self.check_count(float(np.prod(np.ceil(np.asarray(self.size, np.float64) / self.cell - 1e-6))))

    @property
    def cell(self) -> float:
        """Width of a cell, m."""
        return self.density ** (-1 / 3)

    @property
    def n_cells(self) -> np.ndarray:
        """Number of cells along x, y and z. (3,)"""
        return np.ceil(np.asarray(self.size, np.float64) / self.cell - 1e-6).astype(int)

    def models(self) -> Sequence[Model]:
        kinds = self._kinds()
        middle = self._middles()
        return [
            Model(source, options, [(shape, ORIGIN)], middle[k :: len(kinds)])
            for k, (source, options, shape) in enumerate(kinds)
            if k < len(middle)
        ]

    def poses(self, data: SimData) -> tuple[Array, Array]:
        layout, kinds, n = self.read(data), self._kinds(), math.prod(self.n_cells.tolist())
        cell = np.concatenate([np.arange(k, n, len(kinds)) for k in range(len(kinds))])
        radius = np.concatenate(
            [np.full(len(range(k, n, len(kinds))), _bounding_radius(x[2])) for k, x in enumerate(kinds)]
        )
        u = [layout.uniform(cell + k * n) for k in range(10)]
        dtype = u[0].dtype
        radius, *middle = jnp.asarray(np.concatenate([radius[:, None], self._middles()[cell]], axis=1).T, dtype)
        region_length = self.cell - self.gap - 2 * radius
        pos = [middle[k] + self.wander(data, u[k], u[k + 3], region_length) for k in range(3)]
        is_present = (u[6] < layout.difficulty) & self.is_free(pos[:2], middle[:2], radius, region_length)
        pos[2] = jnp.where(is_present, pos[2], pos[2] - HIDDEN_DEPTH)
        r1, r2 = jnp.sqrt(1 - u[7]), jnp.sqrt(u[7])
        a, b = 2 * jnp.pi * u[8], 2 * jnp.pi * u[9]
        quat = [r1 * jnp.sin(a), r1 * jnp.cos(a), r2 * jnp.sin(b), r2 * jnp.cos(b)]  # uniform: Shoemake 1992
        return jnp.stack(pos, axis=-1), jnp.stack(quat, axis=-1)

    def _middles(self) -> np.ndarray:
        index = np.indices(self.n_cells.tolist()).reshape(3, -1).T
        return np.asarray(self.center, np.float64) + self.cell * (index - (self.n_cells - 1) / 2)

    def _kinds(self) -> list[tuple[str, dict[str, Any], Shape]]:
        kinds: list[tuple[str, dict[str, Any], Shape]] = []
        low, high = np.asarray(self.sizes, np.float64).tolist()
        for size in np.linspace(low, high, N_SIZES).tolist():
            kinds += [
                ("box", {"size": (size, size, size)}, Shape("box", (size / 2, size / 2, size / 2))),
                ("sphere", {"radius": size / 2}, Shape("sphere", (size / 2,))),
            ]
        if not isinstance(self.meshes, (list, tuple, np.ndarray)):
            raise ConfigError(f"expected meshes as a list of corners (n, 3), m, got {short_repr(self.meshes)}")
        for corners in self.meshes:
            array = read_numbers("a mesh as corners (n, 3), m,", corners, shapes=(("any", 3),))
            kinds.append((_mesh_xml(array), {}, hull(array)))
        return kinds


def _bounding_radius(shape: Shape) -> float:
    if shape.kind == "mesh":
        return float(np.linalg.norm(shape.array("vertices"), axis=-1).max())
    return float(np.linalg.norm(shape.size))


def _mesh_xml(corners: np.ndarray) -> str:
    numbers = " ".join(f"{x:.9g}" for x in corners.reshape(-1))
    geom = '<geom type="mesh" mesh="mesh" contype="0" conaffinity="2" rgba="0.55 0.5 0.35 1"/>'
    return (
        f'<mujoco><asset><mesh name="mesh" vertex="{numbers}"/></asset><worldbody><body name="mesh">{geom}</body>'
        f"</worldbody></mujoco>"
    )
