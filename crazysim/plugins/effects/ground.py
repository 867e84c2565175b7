"""The ground of a world: the flat floor, or terrain, with height and normal at any position as pure functions."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Plugin, derived, param, state
from crazysim.core.settings import color, setting
from crazysim.eager import jit_eager_calls
from crazysim.geometry.heightfield import OUTSIDE_DISTANCE, surface_at


class HeightField(Plugin, abstract=True):
    """Ground with heights on a grid: what ``Terrain``, which adds it to the scene, knows about its surface."""

    heights: ArrayLike | str | Path = param(core=("rows", "columns"), scope="shared")
    """Heights, m, rows along y and columns along x (n_rows, n_columns); or the path of a PNG image. Its brightness is
    the height, zero at the darkest pixel, and its upper edge is at the largest y."""
    size: ArrayLike = setting(positive=True, shapes=((2,), (3,)), keep=False)
    """Full lengths along x and y, m (2,); for an image, also the height of its brightest pixel (3,)."""
    pos: Param = param(default=(0.0, 0.0, 0.0), core=(3,), scope="shared", shapes=((3,),))
    """Middle of the terrain at height zero, world frame, m. (3,)"""
    floor: bool = True
    """True to keep the flat floor around the terrain. False to remove it, as depressions below z = 0 require; the
    heights of the border then extend outwards without end."""
    rgba: ArrayLike | None = color()
    """Colour; None for the colour of the floor. (4,)"""
    half_size: Array = derived((2,), scope="shared")
    """Half extents along x and y, m. (2,)"""
    height_below: Array = state()
    """Height of the ground below the drone after the last step, world frame, m. (n_worlds, n_drones, 1)"""

    @jit_eager_calls()
    def surface_at(self, pos: Array) -> tuple[Array, Array]:
        """Return height and normal of the ground at the x and y of a position.

        The surface is linear on the two triangles of each cell, as MuJoCo draws and collides it: contacts, rays and
        images have the same ground.

        Args:
            pos: Position, world frame, m. (..., 3)

        Returns:
            Height, world frame, m (..., 1), and unit normal, upwards (..., 3).
        """
        height, normal, is_inside = surface_at(self.heights, self.half_size, pos - self.pos)  # type: ignore[arg-type]
        if self.floor:
            normal = jnp.where(is_inside[..., None], normal, jnp.asarray([0.0, 0.0, 1.0], normal.dtype))
            return jnp.where(is_inside, height + self.pos[2], 0.0)[..., None], normal
        return (height + self.pos[2])[..., None], normal

    def gap_at(self, point: Array) -> tuple[Array, Array]:
        """Return the distance of a point above the plane of the triangle below it, and the plane's normal.

        Args:
            point: Position, world frame, m. (..., 3)

        Returns:
            Signed distance, m (...), and unit normal (..., 3). Beyond the border of a terrain that a flat floor
            surrounds, the distance is ``OUTSIDE_DISTANCE``.
        """
        height, normal, is_inside = surface_at(self.heights, self.half_size, point - self.pos)  # type: ignore[arg-type]
        gap = (point[..., 2] - self.pos[2] - height) * normal[..., 2]
        return jnp.where(is_inside, gap, OUTSIDE_DISTANCE) if self.floor else gap, normal


@jit_eager_calls()
def ground_at(data: SimData, pos: Array) -> tuple[Array, Array]:
    """Look up height and normal of the ground at the x and y of a position; zero and upwards without terrain.

    Where terrains overlap, the highest one is used.

    Args:
        data: Data of one world or of one drone.
        pos: Position, world frame, m. (..., 3)

    Returns:
        Height, world frame, m (..., 1), and unit normal, upwards (..., 3).
    """
    height = jnp.zeros_like(pos[..., :1])
    normal = jnp.zeros_like(pos).at[..., 2].set(1.0)
    for k, terrain in enumerate(x for x in data.plugins.values() if isinstance(x, HeightField)):
        terrain_height, terrain_normal = terrain.surface_at(pos)
        is_higher = terrain_height > height if k else jnp.ones_like(terrain_height, bool)
        height, normal = jnp.where(is_higher, terrain_height, height), jnp.where(is_higher, terrain_normal, normal)
    return height, normal


def ground_height(data: SimData, pos: Array) -> Array:
    """Look up the height of the ground at a position, m, as ``ground_at`` does. (..., 1)"""
    return ground_at(data, pos)[0]


def ground_below(data: SimData) -> Array | float:
    """Return the height of the ground below a drone, m, after the last step; zero without terrain. (..., 1)"""
    heights = [x.height_below for x in data.plugins.values() if isinstance(x, HeightField)]
    height: Array | float = heights[0] if heights else 0.0
    for other in heights[1:]:
        height = jnp.maximum(height, other)
    return height
