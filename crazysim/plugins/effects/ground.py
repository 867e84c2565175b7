"""The ground of a world: the flat floor, or terrain, with height and normal at any position as pure functions."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim.core.data import SimData
from crazysim.eager import jit_eager_calls
from crazysim.geometry.heightfield import OUTSIDE_DISTANCE, surface_at
from crazysim.pytree import PyTree, leaf, static


class TerrainData(PyTree):
    """Heights of the ground on a grid, and below every drone."""

    heights: Array = leaf("shared", 2)
    """Heights of the nodes above the middle of the terrain, rows along y and columns along x, m. (n_rows, n_columns)"""
    middle: Array = leaf("shared", 1)
    """Position of the middle of the terrain, world frame, m. (3,)"""
    half_size: Array = leaf("shared", 1)
    """Half extents along x and y, m. (2,)"""
    height_below: Array = leaf("drone", 1)
    """Height of the ground below the drone after the last step, world frame, m. (n_worlds, n_drones, 1)"""
    floor: bool = static()
    """True if a flat floor at z = 0 surrounds the terrain; False if the terrain's border extends without end."""

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
        height, normal, is_inside = surface_at(self.heights, self.half_size, pos - self.middle)
        if self.floor:
            normal = jnp.where(is_inside[..., None], normal, jnp.asarray([0.0, 0.0, 1.0], normal.dtype))
            return jnp.where(is_inside, height + self.middle[2], 0.0)[..., None], normal
        return (height + self.middle[2])[..., None], normal

    def gap_at(self, point: Array) -> tuple[Array, Array]:
        """Return the distance of a point above the plane of the triangle below it, and the plane's normal.

        Args:
            point: Position, world frame, m. (..., 3)

        Returns:
            Signed distance, m (...), and unit normal (..., 3). Beyond the border of a terrain that a flat floor
            surrounds, the distance is ``OUTSIDE_DISTANCE``.
        """
        height, normal, is_inside = surface_at(self.heights, self.half_size, point - self.middle)
        gap = (point[..., 2] - self.middle[2] - height) * normal[..., 2]
        return jnp.where(is_inside, gap, OUTSIDE_DISTANCE) if self.floor else gap, normal


@jit_eager_calls()
def ground_at(data: SimData, pos: Array) -> tuple[Array, Array]:
    """Return height and normal of the ground at the x and y of a position; zero and upwards without terrain.

    Where terrains overlap, the highest one is used.

    Args:
        data: Data of one world or of one drone.
        pos: Position, world frame, m. (..., 3)

    Returns:
        Height, world frame, m (..., 1), and unit normal, upwards (..., 3).
    """
    height = jnp.zeros_like(pos[..., :1])
    normal = jnp.zeros_like(pos).at[..., 2].set(1.0)
    for k, terrain in enumerate(x for x in data.plugins.values() if isinstance(x, TerrainData)):
        terrain_height, terrain_normal = terrain.surface_at(pos)
        is_higher = terrain_height > height if k else jnp.ones_like(terrain_height, bool)
        height, normal = jnp.where(is_higher, terrain_height, height), jnp.where(is_higher, terrain_normal, normal)
    return height, normal


def ground_height(data: SimData, pos: Array) -> Array:
    """Return the height of the ground at a position, m, as ``ground_at`` does. (..., 1)"""
    return ground_at(data, pos)[0]


def ground_below(data: SimData) -> Array | float:
    """Return the height of the ground below a drone, m, after the last step; zero without terrain. (..., 1)"""
    heights = [x.height_below for x in data.plugins.values() if isinstance(x, TerrainData)]
    height: Array | float = heights[0] if heights else 0.0
    for other in heights[1:]:
        height = jnp.maximum(height, other)
    return height
