"""Coordinates of a texture at a point of a mesh: a function of one ray, for kernels."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.branches import table_rows
from crazysim.geometry.points import Components
from crazysim.geometry.triangle import Barycentric, closest_point, from_barycentric
from crazysim.geometry.vector import Vector
from crazysim.scene.nearest_geom import nearest_geom


def texture_coordinates(triangles: np.ndarray, point: Vector) -> list[tuple[Array, Components]]:
    """Return u and v, and their gradients in the frame of the mesh, at the point of a mesh nearest to a point.

    Args:
        triangles: ``Shape.triangles``. (n, 15)
        point: Point, in the frame of the mesh, m. () each
    """
    corners = triangles[:, :9].reshape(-1, 3, 3)
    low, high, everything = corners.min(axis=1), corners.max(axis=1), np.arange(len(corners))
    rows = jnp.asarray(np.concatenate([triangles, _gradients(triangles)], axis=-1), point.x.dtype)

    def weights_in(row: list[Array]) -> tuple[Barycentric, list[Vector]]:
        offsets = [Vector(*row[k : k + 3]) - point for k in (0, 3, 6)]
        return closest_point(*offsets), offsets

    def distance(index: Array) -> Array:
        weights, offsets = weights_in(table_rows(rows, index))
        offset = from_barycentric(weights, *offsets)
        return offset.dot(offset) ** 0.5

    position = point.x, point.y, point.z
    index = nearest_geom(low, high, position, 0.0, distance, [everything], jnp.int32(0))
    row = table_rows(rows, jnp.maximum(index, 0))
    weights, _ = weights_in(row)
    return [
        (sum(w * u for w, u in zip(weights, row[9 + k : 15 : 2], strict=True)), tuple(row[15 + 3 * k : 18 + 3 * k]))
        for k in (0, 1)
    ]  # type: ignore[return-value]


def _gradients(triangles: np.ndarray) -> np.ndarray:
    # Of u and v, in the planes of the triangles; zero for triangles without an area. (n, 6)
    corners, coordinates = triangles[:, :9].reshape(-1, 3, 3), triangles[:, 9:].reshape(-1, 3, 2)
    inverse = np.linalg.pinv(corners[:, 1:] - corners[:, :1], rcond=1e-6)
    return np.moveaxis(inverse @ (coordinates[:, 1:] - coordinates[:, :1]), -1, 1).reshape(-1, 6)
