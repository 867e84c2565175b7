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

    There is a path between any two rooms. A wall between rooms consists of panels between two posts; its door is a
    missing panel, as high as the wall. The outer walls have no doors. ``free`` and ``speed`` have no effect.

    ``difficulty`` is the fraction of the walls between rooms that are present: with 0 the building is a hall.
    """

    count: ArrayLike = setting(default=(3, 2), low=1, high=100, shapes=((2,),))
    """Number of rooms along x and along y. (2,)"""
    room: float = setting(default=4.0, positive=True)
    """Length of the sides of a room, m."""
    door: float = setting(default=1.0, positive=True)
    """Width of a door and of a panel, m; posts of equal width fill the rest of a wall."""
    center: ArrayLike = setting(default=(0.0, 0.0), shapes=((2,),))
    """Middle of the building, x and y, m. (2,)"""
    height: float = setting(default=2.5, positive=True)
    """Height of the walls, m."""
    thickness: float = setting(default=0.1, positive=True)
    """Thickness of the walls, m."""
    name: str = "rooms"

    def check_settings(self) -> None:
        super().check_settings()
        if self.n_panels < 2:
            raise ConfigError(
                f"expected rooms at least twice as wide as a door between their walls, got rooms of {self.room:g} m, "
                f"walls of {self.thickness:g} m and doors of {self.door:g} m. Use a larger room= or a smaller door=."
            )
        self.check_count(4 + self.n_walls * (self.n_panels + 2), "Use fewer or smaller rooms, or wider doors.")

    @property
    def n_panels(self) -> int:
        """Number of panels of a wall."""
        return int((self.room - self.thickness) / self.door + 1e-6)

    def models(self) -> Sequence[Model]:
        outer_walls = [Model(*self._wall_model(length), np.array([middle])) for length, middle in self._outer_walls()]
        if not self.n_walls:
            return outer_walls
        panels, posts = self._piece_positions()
        post_width = (self.room - self.n_panels * self.door) / 2
        return [
            *outer_walls,
            Model(*self._wall_model(self.door), panels),
            Model(*self._wall_model(post_width), posts),
        ]

    @property
    def n_walls(self) -> int:
        """Number of walls between rooms."""
        n_x, n_y = self._room_counts()
        return (n_x - 1) * n_y + n_x * (n_y - 1)

    def poses(self, data: SimData) -> tuple[Array, Array]:
        layout, n_panels = self.read(data), self.n_panels
        wall, panel = np.divmod(np.arange(self.n_walls * n_panels), n_panels)
        is_along_x = wall >= (self._room_counts()[0] - 1) * self._room_counts()[1]
        is_standing = layout.uniform(self.n_walls + wall) < layout.difficulty
        is_door = jnp.floor(layout.uniform(wall) * n_panels) == panel
        is_post_standing = jnp.repeat(is_standing[..., ::n_panels], 2, axis=-1)
        is_present = jnp.concatenate([is_standing & ~is_door, is_post_standing], axis=-1)
        depth = jnp.where(is_present, 0.0, HIDDEN_DEPTH).astype(layout.difficulty.dtype)
        outer_walls = np.array([middle for _, middle in self._outer_walls()])
        pos = jnp.asarray(np.concatenate([outer_walls, *self._piece_positions()]), depth.dtype)
        depth = jnp.concatenate([jnp.zeros((*depth.shape[:-1], 4), depth.dtype), depth], axis=-1)
        is_along_x = np.concatenate([is_along_x, np.repeat(is_along_x[::n_panels], 2)])
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
        options = {"length": length, "height": self.height, "thickness": self.thickness}
        shape = Shape("box", (self.thickness / 2, length / 2, self.height / 2))
        return "wall", options, [(shape, (0.0, 0.0, self.height / 2))]

    def _outer_walls(self) -> list[tuple[float, np.ndarray]]:
        (x, y), size = np.asarray(self.center, np.float64), self.room * np.array(self._room_counts())
        along_y = [(float(size[1]) + self.thickness, np.array([x + side * size[0] / 2, y, 0.0])) for side in (-1, 1)]
        return along_y + [
            (float(size[0]) + self.thickness, np.array([x, y + side * size[1] / 2, 0.0])) for side in (-1, 1)
        ]

    def _piece_positions(self) -> tuple[np.ndarray, np.ndarray]:
        n_x, n_y = self._room_counts()
        corner = np.asarray(self.center, np.float64) - self.room * np.array([n_x, n_y]) / 2
        panels = self.room / 2 + self.door * (np.arange(self.n_panels) - (self.n_panels - 1) / 2)
        post = (self.room - self.n_panels * self.door) / 4

        def in_all_walls(offsets: ArrayLike) -> np.ndarray:
            along_y = [(i + 1, j, 0, a) for i in range(n_x - 1) for j in range(n_y) for a in np.asarray(offsets)]
            along_x = [(i, j + 1, a, 0) for i in range(n_x) for j in range(n_y - 1) for a in np.asarray(offsets)]
            x, y, dx, dy = np.array(along_y + along_x).reshape(-1, 4).T
            return np.stack([self.room * x + dx + corner[0], self.room * y + dy + corner[1], 0 * x], axis=-1)

        return in_all_walls(panels), in_all_walls([post, self.room - post])
