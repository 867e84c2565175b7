"""Gates: a course of gates at random positions, drawn again in every world and episode."""

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
from crazysim.plugins.scenery.scenery import MAX_OBSTACLES, Model, Scenery


class Gates(Scenery):
    """Gates one behind the other along x, each displaced along x, y and z, and turned.

    ``difficulty`` scales displacements and turns: with 0 the gates are in a line. All gates are always there, so
    ``free`` has no effect.
    """

    count: int = setting(default=6, low=1, high=MAX_OBSTACLES)
    """Number of gates."""
    start: ArrayLike = setting(default=(3.0, 0.0, 1.5), shapes=((3,),))
    """Middle of the first gate before it is displaced, m. (3,)"""
    spacing: float = setting(default=4.0, positive=True)
    """Distance between neighbouring gates along x, before they are displaced, m."""
    offset: ArrayLike = setting(default=(0.5, 2.0, 0.5), low=0.0, shapes=((3,),))
    """Largest displacement along x, y and z, m. (3,)"""
    turn: float = setting(default=0.6, low=0.0, high=np.pi)
    """Largest yaw, rad."""
    opening: ArrayLike = setting(default=(0.8, 0.8), positive=True, shapes=((2,),))
    """Width and height of the openings, m. (2,)"""
    bar: float = setting(default=0.08, positive=True)
    """Thickness of the frames, m."""
    name: str = "gates"

    def check_settings(self) -> None:
        super().check_settings()
        lowest = float(np.asarray(self.start)[2] - np.asarray(self.offset)[2] - np.asarray(self.opening)[1] / 2)
        if lowest < self.bar:
            raise ConfigError(
                f"expected gates above the floor, got a lower bar at {lowest - self.bar:.3g} m. Use a higher start, or "
                f"a smaller offset."
            )

    def models(self) -> Sequence[Model]:
        width, height = np.asarray(self.opening, np.float64).tolist()
        options = {"width": width, "height": height, "bar": self.bar}
        y, z, b = width / 2, height / 2, self.bar / 2
        shapes = [(Shape("box", (b, b, z + self.bar)), (0.0, side * (y + b), 0.0)) for side in (-1, 1)]
        shapes += [(Shape("box", (b, y, b)), (0.0, 0.0, side * (z + b))) for side in (-1, 1)]
        return [Model("gate", options, shapes, self._undisplaced_positions())]

    def poses(self, data: SimData) -> tuple[Array, Array]:
        layout, gate = self.read(data), np.arange(self.count)
        u = [layout.uniform(gate + k * self.count) for k in range(7)]
        region_length = 2 * np.asarray(self.offset, np.float64)
        pos = [
            self._undisplaced_positions()[:, k]
            + self.wander(data, u[k], u[k + 3], layout.difficulty * region_length[k])
            for k in range(3)
        ]
        half_yaw = (u[6] - 0.5) * self.turn * layout.difficulty
        quat = [0 * half_yaw, 0 * half_yaw, jnp.sin(half_yaw), jnp.cos(half_yaw)]
        return jnp.stack([x.astype(half_yaw.dtype) for x in pos], axis=-1), jnp.stack(quat, axis=-1)

    def _undisplaced_positions(self) -> np.ndarray:
        return np.asarray(self.start, np.float64) + self.spacing * np.arange(self.count)[:, None] * [1.0, 0.0, 0.0]
