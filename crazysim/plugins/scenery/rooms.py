"""Rooms: a building with doors at random positions, drawn again in every world and episode."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import SimData
from crazysim.core.settings import setting
from crazysim.errors import ConfigError
from crazysim.geometry import Shape
from crazysim.plugins.scenery.scenery import HIDDEN_DEPTH, Model, Scenery


class Rooms(Scenery):
    """A building of square rooms in rows, with a door at a random position in each wall between two rooms.

    There is a path between any two rooms. A wall between rooms consists of panels; its door is a missing panel, as high
    as the wall. The outer walls have no doors. ``free`` and ``speed`` have no effect.

    ``difficulty`` is the fraction of the walls between rooms that are present: with 0 the building is a hall.
    """

    count: ArrayLike = setting(default=(3, 2), low=1, high=100, shapes=((2,),))
    """Number of rooms along x and along y. (2,)"""
    room: float = setting(default=4.0, positive=True)
    """Length of the sides of a room, m."""
    door: float = setting(default=1.0, positive=True)
    """Width of a door, m; ``room`` is divided into panels of at least this width."""
    center: ArrayLike = setting(default=(0.0, 0.0), shapes=((2,),))
    """Middle of the building, x and y, m. (2,)"""
    height: float = setting(default=2.5, positive=True)
    """Height of the walls, m."""
    thickness: float = setting(default=0.1, positive=True)
    """Thickness of the walls, m."""
    name: str = "rooms"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n_panels < 2:
            raise ConfigError(
                f"expected rooms at least twice as wide as a door, got rooms of {self.room:g} m and doors of "
                f"{self.door:g} m"
            )
        self.check_count(4 + self.n_walls * self.n_panels, "Use fewer or smaller rooms, or wider doors.")

    @property
    def n_panels(self) -> int:
        """Number of panels of a wall."""
        return int(self.room / self.door + 1e-6)

    def models(self) -> Sequence[Model]:
        outer_walls = [Model(*self._wall_model(length), np.array([middle])) for length, middle in self._outer_walls()]
        inner_walls = (
            [Model(*self._wall_model(self.room / self.n_panels), self._panel_positions())] if self.n_walls else []
        )
        return [*outer_walls, *inner_walls]

    @property
    def n_walls(self) -> int:
        """Number of walls between rooms."""
        n_x, n_y = self._room_counts()
        return (n_x - 1) * n_y + n_x * (n_y - 1)

    def poses(self, data: SimData) -> tuple[Array, Array]:
        record, n_panels = self.read(data), self.n_panels
        wall, panel = np.divmod(np.arange(self.n_walls * n_panels), n_panels)
        is_along_x = wall >= (self._room_counts()[0] - 1) * self._room_counts()[1]
        is_standing = record.uniform(self.n_walls + wall) < record.difficulty
        is_door = jnp.floor(record.uniform(wall) * n_panels) == panel
        depth = jnp.where(is_standing & ~is_door, 0.0, HIDDEN_DEPTH).astype(record.difficulty.dtype)
        outer_walls = np.array([middle for _, middle in self._outer_walls()])
        pos = jnp.asarray(np.concatenate([outer_walls, self._panel_positions()]), depth.dtype)
        depth = jnp.concatenate([jnp.zeros((*depth.shape[:-1], 4), depth.dtype), depth], axis=-1)
        half_yaw = np.concatenate([[0.0, 0.0, np.pi / 4, np.pi / 4], is_along_x * np.pi / 4])
        quat = jnp.asarray(np.stack([0 * half_yaw, 0 * half_yaw, np.sin(half_yaw), np.cos(half_yaw)], axis=-1))
        pos = jnp.broadcast_to(pos, (*depth.shape, 3)) - depth[..., None] * np.array([0, 0, 1], depth.dtype)
        return pos, jnp.broadcast_to(quat.astype(depth.dtype), (*depth.shape, 4))

    def _room_counts(self) -> tuple[int, int]:
        n_x, n_y = np.asarray(self.count).astype(int).tolist()
        return n_x, n_y

    def _wall_model(
        self, length: float
    ) -> tuple[str, dict[str, float], list[tuple[Shape, tuple[float, float, float]]]]:
        """Return the primitive of a wall of a length along y, the settings of the primitive, and the wall's shape."""
        options = {"length": length, "height": self.height, "thickness": self.thickness}
        shape = Shape("box", (self.thickness / 2, length / 2, self.height / 2))
        return "wall", options, [(shape, (0.0, 0.0, self.height / 2))]

    def _outer_walls(self) -> list[tuple[float, np.ndarray]]:
        """Return length and middle of the two outer walls along y, then of the two outer walls along x, m."""
        (x, y), size = np.asarray(self.center, np.float64), self.room * np.array(self._room_counts())
        along_y = [(float(size[1]) + self.thickness, np.array([x + side * size[0] / 2, y, 0.0])) for side in (-1, 1)]
        return along_y + [
            (float(size[0]) + self.thickness, np.array([x, y + side * size[1] / 2, 0.0])) for side in (-1, 1)
        ]

    def _panel_positions(self) -> np.ndarray:
        """Return the middles of all panels, first in walls along y, then along x, m. (n_walls * n_panels, 3)"""
        n_x, n_y = self._room_counts()
        corner = np.asarray(self.center, np.float64) - self.room * np.array([n_x, n_y]) / 2
        offsets = self.room * (np.arange(self.n_panels) + 0.5) / self.n_panels
        panels = [
            [self.room * (i + 1), self.room * j + a, 0.0] for i in range(n_x - 1) for j in range(n_y) for a in offsets
        ] + [[self.room * i + a, self.room * (j + 1), 0.0] for i in range(n_x) for j in range(n_y - 1) for a in offsets]
        return np.array(panels).reshape(-1, 3) + [*corner, 0.0]
