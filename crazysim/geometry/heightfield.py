"""Signed distances to a height field: the solid below triangles over a grid, with walls and a bottom.

Only the triangles of the cells near a point are examined, so the cost does not depend on the size of the grid. The
indices of these triangles are computed from the point.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from crazysim.geometry.points import maximum, triangles_distance
from crazysim.geometry.segments import segment_to_box
from crazysim.geometry.shapes import Shape
from crazysim.geometry.vector import Vector, to_vector
from crazysim.rotation import clip, safe_sqrt

OUTSIDE_DISTANCE = 1e3
"""Distance assigned to points beyond the border of a field, m: too large for a contact, but finite for solvers."""


def cell_sides(shape: Shape) -> tuple[float, float]:
    """Return the side lengths of a cell along x and y, m."""
    n_rows, n_columns = shape.array("heights").shape
    return 2 * shape.size[0] / (n_columns - 1), 2 * shape.size[1] / (n_rows - 1)


def field_distance(shape: Shape, point: Array, radius: float = 0.0) -> Array:
    """Return the signed distance from a point to the ground, m. (...)

    The cell below the point and all cells within ``radius`` are examined. Distances of a magnitude up to ``radius`` are
    exact; larger results are the distance to the nearest examined cell, an upper bound. The sign is always correct.

    Args:
        shape: Height field.
        point: Points in the frame of the field, m. (..., 3)
        radius: Distance up to which the result is exact, m. Values below the side of a cell act as one side.
    """
    position = to_vector(point)
    x_half, y_half, _, base = shape.size
    grid = nearby_corners(shape, position, radius)
    surface = triangles_distance(position, *triangles(grid))
    # The walls and the bottom can be nearer than the surface.
    qx, qy = clip(position.x, -x_half, x_half), clip(position.y, -y_half, y_half)
    is_below = position.z < height_at(shape, lax.stop_gradient(qx), lax.stop_gradient(qy))
    dx, dy, dz = position.x - qx, position.y - qy, maximum(-base - position.z, 0.0)
    border_distance = safe_sqrt(dx * dx + dy * dy + dz * dz)
    wall = maximum(
        maximum(position.x - x_half, -x_half - position.x), maximum(position.y - y_half, -y_half - position.y)
    )
    wall = maximum(wall, -base - position.z)
    inner_distance = maximum(-surface, wall)
    return jnp.where(is_below, jnp.where(wall < 0, inner_distance, border_distance), surface)


def drone_to_field(half: tuple[float, ...], shape: Shape, pos: Array, rot: Array) -> Array:
    """Return the signed distance from a box or a segment to the ground, m. (...)

    For separated shapes the nearest points are a corner of the box and a point of the ground, or a point of the box
    and a point on an edge of the ground. Distances up to half the diagonal of the box are exact; larger results are
    upper bounds. For overlapping shapes, the depth is the larger of the depths of the deepest corner and edge. The
    shortest translation that separates the box from all triangles can be longer.

    Args:
        half: Half lengths of the box, m; zeros for a segment. (3,)
        shape: Height field.
        pos: Position of the centre of the box in the frame of the field, m. (..., 3)
        rot: Rotation matrix from the frame of the box to the frame of the field. (..., 3, 3)
    """
    half_diagonal = math.sqrt(sum(h * h for h in half))
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0] if h else [0.0] for h in half], indexing="ij"), axis=-1).reshape(-1, 3)
    local_corners = jnp.asarray(signs * np.asarray(half), pos.dtype)
    corners = pos[..., None, :] + sum(rot[..., None, :, k] * local_corners[:, k, None] for k in range(3))
    corner_distance = jnp.min(field_distance(shape, corners, half_diagonal), axis=-1)
    grid = nearby_corners(shape, to_vector(lax.stop_gradient(pos)), 2 * half_diagonal)
    axes = [to_vector(rot[..., k]) for k in range(3)]
    position = to_vector(pos)
    a, b = edges(grid)
    middle, edge_vectors = (a + b) * 0.5, b - a
    length = jnp.sqrt(edge_vectors.dot(edge_vectors))
    offsets = Vector(
        *(m - p[..., None] for m, p in ((middle.x, position.x), (middle.y, position.y), (middle.z, position.z)))
    )
    batched_axes = [Vector(axis.x[..., None], axis.y[..., None], axis.z[..., None]) for axis in axes]
    x, y, z = (offsets.dot(axis) for axis in batched_axes)
    u, v, w = (edge_vectors.dot(axis) / length for axis in batched_axes)
    edge_distance = jnp.min(segment_to_box((x, y, z), (u, v, w), 0.5 * length, half), axis=-1)
    return jnp.where(edge_distance < corner_distance, edge_distance, corner_distance)


def nearby_corners(shape: Shape, position: Vector, radius: float) -> Vector:
    """Return the corners of the cells within a radius of a point, without derivatives, m. (..., n_y + 1, n_x + 1)"""
    heights = shape.array("heights")
    starts, counts = [], []
    for coordinate, half, side, n in (
        (position.y, shape.size[1], cell_sides(shape)[1], heights.shape[0] - 1),
        (position.x, shape.size[0], cell_sides(shape)[0], heights.shape[1] - 1),
    ):
        n_neighbours = max(1, math.ceil(radius / side))
        count = min(n, 2 * n_neighbours + 1)
        cell = jnp.floor((lax.stop_gradient(coordinate) + half) / side).astype(jnp.int32)
        starts.append(jnp.clip(cell - n_neighbours, 0, n - count))
        counts.append(count + 1)
    rows = starts[0][..., None, None] + jnp.arange(counts[0], dtype=jnp.int32)[:, None]
    columns = starts[1][..., None, None] + jnp.arange(counts[1], dtype=jnp.int32)
    rows, columns = jnp.broadcast_arrays(rows, columns)
    dtype = position.x.dtype
    side_x, side_y = cell_sides(shape)
    z = jnp.asarray(heights, dtype)[rows, columns]
    return Vector(columns.astype(dtype) * side_x - shape.size[0], rows.astype(dtype) * side_y - shape.size[1], z)


def triangles(grid: Vector) -> tuple[Vector, Vector, Vector]:
    """Return the three corners of both triangles of every cell, concatenated. (..., n_triangles) each"""

    def take_corners(rows: slice, columns: slice) -> list[Array]:
        return [v[..., rows, columns].reshape(*v.shape[:-2], -1) for v in (grid.x, grid.y, grid.z)]

    low, high = slice(None, -1), slice(1, None)
    a, b, c, d = take_corners(low, low), take_corners(low, high), take_corners(high, high), take_corners(high, low)

    def concatenate(p: list[Array], q: list[Array]) -> Vector:
        return Vector(*(jnp.concatenate(pair, axis=-1) for pair in zip(p, q, strict=True)))

    return concatenate(a, a), concatenate(b, c), concatenate(c, d)


def edges(grid: Vector) -> tuple[Vector, Vector]:
    """Return the ends of all edges along x, y and the diagonals of cells, concatenated. (..., n_edges) each"""
    all_nodes, but_last, but_first = slice(None), slice(None, -1), slice(1, None)

    def concatenate(*parts: tuple[slice, slice]) -> Vector:
        columns = ([v[..., i, j].reshape(*v.shape[:-2], -1) for i, j in parts] for v in (grid.x, grid.y, grid.z))
        return Vector(*(jnp.concatenate(column, axis=-1) for column in columns))

    return concatenate((all_nodes, but_last), (but_last, all_nodes), (but_last, but_last)), concatenate(
        (all_nodes, but_first), (but_first, all_nodes), (but_first, but_first)
    )


def height_at(shape: Shape, x: Array, y: Array) -> Array:
    """Return the height of the surface at positions within the field, m. (...)"""
    heights = jnp.asarray(shape.array("heights"), x.dtype)
    side_x, side_y = cell_sides(shape)
    u, v, rise_x, rise_y, origin = triangle_at(heights, (x + shape.size[0]) / side_x, (y + shape.size[1]) / side_y)
    return origin + rise_x * u + rise_y * v


def surface_at(heights: Array, half: Array, point: Array) -> tuple[Array, Array, Array]:
    """Return height and normal of the surface at a point, and True where the point lies on the field.

    Beyond its border the field continues with the heights of the border.

    Args:
        heights: Heights of the nodes, rows along y and columns along x, m. (n_rows, n_columns)
        half: Half extents along x and y, m. (2,)
        point: Point in the frame of the field, m; its z is ignored. (..., 3)

    Returns:
        Height, m (...), unit normal, upwards (..., 3), and True on the field (...).
    """
    n_rows, n_columns = heights.shape
    x, y = point[..., 0], point[..., 1]
    is_on_field = (jnp.abs(x) <= half[0]) & (jnp.abs(y) <= half[1])
    side_x, side_y = 2 * half[0] / (n_columns - 1), 2 * half[1] / (n_rows - 1)
    cell_x = clip((x + half[0]) / side_x, 0.0, float(n_columns - 1))
    cell_y = clip((y + half[1]) / side_y, 0.0, float(n_rows - 1))
    u, v, rise_x, rise_y, origin = triangle_at(heights, cell_x, cell_y)
    slope_x, slope_y = rise_x / side_x, rise_y / side_y
    normal_z = 1 / jnp.sqrt(1 + slope_x * slope_x + slope_y * slope_y)
    return (
        origin + rise_x * u + rise_y * v,
        jnp.stack([-slope_x * normal_z, -slope_y * normal_z, normal_z], axis=-1),
        is_on_field,
    )


def field_gap(shape: Shape, point: Array) -> tuple[Array, Array]:
    """Return the distance of a point to the plane of the triangle below it, m (...), and the plane's normal (..., 3).

    Near a surface without sharp edges this is the signed distance to the ground, at a small fraction of the cost of
    ``field_distance``. Beyond the border and below the bottom of the ground, it is ``OUTSIDE_DISTANCE``.
    """
    half = jnp.asarray(shape.size[:2], point.dtype)
    height, normal, is_over_ground = surface_at(jnp.asarray(shape.array("heights"), point.dtype), half, point)
    is_over_ground = is_over_ground & (point[..., 2] > -shape.size[3])
    return jnp.where(is_over_ground, (point[..., 2] - height) * normal[..., 2], OUTSIDE_DISTANCE), normal


def triangle_at(heights: Array, u: Array, v: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Return the triangle below a point: the position in its cell, its rises, and the height of the cell's origin.

    For a point outside of the grid, it is the triangle of the nearest cell.

    Args:
        heights: Heights of the nodes, rows along y and columns along x, m. (n_rows, n_columns)
        u: Coordinate along x in units of cells. (...)
        v: Coordinate along y in units of cells. (...)

    Returns:
        Position in the cell along x and y, rises of the triangle over a cell along x and y, m, and height at the
        cell's corner of smallest x and y, m. (...) each
    """
    column = jnp.clip(jnp.floor(u), 0, heights.shape[1] - 2).astype(jnp.int32)
    row = jnp.clip(jnp.floor(v), 0, heights.shape[0] - 2).astype(jnp.int32)
    u, v = u - column.astype(u.dtype), v - row.astype(v.dtype)
    a, b, c, d = (heights[row + i, column + j] for i, j in ((0, 0), (0, 1), (1, 1), (1, 0)))
    is_right = u > v
    return u, v, jnp.where(is_right, b - a, c - d), jnp.where(is_right, c - b, d - a), a
