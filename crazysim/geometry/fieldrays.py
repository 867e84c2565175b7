"""Ray casting against a height field, cell by cell."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax

from crazysim.geometry.heightfield import cell_sides, height_at
from crazysim.geometry.shapes import Shape
from crazysim.geometry.vector import Vector, normalize, select_vector, to_vector

MIN_COMPONENT = 1e-12
"""Component of a unit direction below which a ray is treated as parallel; float32 can hold its inverse and square."""

Hit = tuple[Array, Vector]
"""Distance along a ray, m (...), infinite where it misses, and the outward normal of the plane that it hits."""


def field_ray(shape: Shape, origin: Array, direction: Array) -> tuple[Array, Array]:
    """Return the distance along rays to a height field, and its outward normal at the hit.

    As in MuJoCo, a height field is a box up to z = 0, a surface above it, and walls between them. A ray from inside
    ends on the surface, on a wall, on the bottom, or at z = 0, even though the ground continues there.

    Args:
        shape: Height field.
        origin: Origin of each ray, in the frame of the field, m. (..., 3)
        direction: Unit direction of each ray, in the frame of the field. (..., 3)

    Returns:
        Distance, m, infinite where it misses. (...)
        Unit normal, zero where it misses. (..., 3)
    """
    o, d = to_vector(lax.stop_gradient(origin)), to_vector(lax.stop_gradient(direction))
    t, n = _nearer_hit(_nearer_hit(_base_hit(shape, o, d), _wall_hits(shape, o, d)), _surface_hit(shape, o, d))
    is_hit = jnp.isfinite(t)
    # The surface is locally flat, so the derivative is taken of the distance to the plane of the hit.
    hit_point = o + d * jnp.where(is_hit, t, 0.0)
    o, d = to_vector(origin), to_vector(direction)
    approach_rate = n.dot(d)
    is_safe = is_hit & (jnp.abs(approach_rate) > MIN_COMPONENT)
    plane_distance = n.dot(hit_point - o) / jnp.where(is_safe, approach_rate, 1.0)
    hit_distance = jnp.where(is_safe, plane_distance + lax.stop_gradient(t - plane_distance), t)
    normal = jnp.stack([n.x, n.y, n.z], axis=-1)
    return jnp.where(is_hit, hit_distance, jnp.inf), jnp.where(is_hit[..., None], normal, 0.0)


def _nearer_hit(a: Hit, b: Hit) -> Hit:
    return jnp.where(a[0] < b[0], a[0], b[0]), select_vector(a[0] < b[0], a[1], b[1])


def _face_hits(
    half: tuple[float, float], origin: Vector, direction: Vector
) -> list[tuple[Array, Vector, Array, Array]]:
    zero = jnp.zeros_like(origin.x)
    hits = []
    for side in (-1.0, 1.0):
        for k, (p, v, h) in enumerate(((origin.x, direction.x, half[0]), (origin.y, direction.y, half[1]))):
            is_crossing = jnp.abs(v) > MIN_COMPONENT
            t = (side * h - p) / jnp.where(is_crossing, v, 1.0)
            n = Vector(zero + side, zero, zero) if k == 0 else Vector(zero, zero + side, zero)
            coordinate = origin.y + t * direction.y if k == 0 else origin.x + t * direction.x
            is_within = is_crossing & (t >= 0) & (jnp.abs(coordinate) <= half[1 - k])
            hits.append((jnp.where(is_within, t, jnp.inf), n, origin.x + t * direction.x, origin.y + t * direction.y))
    return hits


def _base_hit(shape: Shape, origin: Vector, direction: Vector) -> Hit:
    x_half, y_half, _, base = shape.size
    zero = jnp.zeros_like(origin.x)
    hit = (zero + jnp.inf, Vector(zero, zero, zero))
    for t, n, _, _ in _face_hits((x_half, y_half), origin, direction):
        z = origin.z + jnp.where(jnp.isfinite(t), t, 0.0) * direction.z
        hit = _nearer_hit((jnp.where((z <= 0) & (z >= -base), t, jnp.inf), n), hit)
    is_crossing = jnp.abs(direction.z) > MIN_COMPONENT
    for height, normal_z in ((0.0, 1.0), (-base, -1.0)):
        t = (height - origin.z) / jnp.where(is_crossing, direction.z, 1.0)
        is_within = (
            is_crossing
            & (t >= 0)
            & (jnp.abs(origin.x + t * direction.x) <= x_half)
            & (jnp.abs(origin.y + t * direction.y) <= y_half)
        )
        hit = _nearer_hit((jnp.where(is_within, t, jnp.inf), Vector(zero, zero, zero + normal_z)), hit)
    return hit


def _wall_hits(shape: Shape, origin: Vector, direction: Vector) -> Hit:
    zero = jnp.zeros_like(origin.x)
    hit = (zero + jnp.inf, Vector(zero, zero, zero))
    for t, n, x, y in _face_hits(shape.size[:2], origin, direction):  # type: ignore[arg-type]
        z = origin.z + jnp.where(jnp.isfinite(t), t, 0.0) * direction.z
        x, y = jnp.clip(x, -shape.size[0], shape.size[0]), jnp.clip(y, -shape.size[1], shape.size[1])
        hit = _nearer_hit((jnp.where((z >= 0) & (z <= height_at(shape, x, y)), t, jnp.inf), n), hit)
    return hit


def _surface_hit(shape: Shape, origin: Vector, direction: Vector) -> Hit:
    ground = shape.array("heights")
    n_rows, n_columns = ground.shape
    heights = jnp.asarray(ground, origin.x.dtype)
    side_x, side_y = cell_sides(shape)
    # Origin and direction in units of cells.
    u, v = (origin.x + shape.size[0]) / side_x, (origin.y + shape.size[1]) / side_y
    du, dv = direction.x / side_x, direction.y / side_y
    # Distance at which the ray enters the grid, seen from above.
    start = jnp.zeros_like(origin.x)
    for p, step, n in ((u, du, n_columns - 1), (v, dv, n_rows - 1)):
        is_moving = jnp.abs(step) > MIN_COMPONENT
        entry_distance = (jnp.where(step > 0, 0.0, float(n)) - p) / jnp.where(is_moving, step, 1.0)
        start = jnp.where(is_moving & (entry_distance > start), entry_distance, start)
    column = jnp.clip(jnp.floor(u + start * du), 0, n_columns - 2).astype(jnp.int32)
    row = jnp.clip(jnp.floor(v + start * dv), 0, n_rows - 2).astype(jnp.int32)
    tolerance = 1e-5 if origin.x.dtype == jnp.float32 else 1e-10

    def visit_cell(carry: tuple[Array, Array, Hit], _: None) -> tuple[tuple[Array, Array, Hit], None]:
        column, row, hit = carry
        is_inside = (column >= 0) & (column <= n_columns - 2) & (row >= 0) & (row <= n_rows - 2)
        i, j = jnp.clip(row, 0, n_rows - 2), jnp.clip(column, 0, n_columns - 2)
        a, b, c, e = heights[i, j], heights[i, j + 1], heights[i + 1, j + 1], heights[i + 1, j]
        x, y = u - j.astype(u.dtype), v - i.astype(v.dtype)
        for rise_x, rise_y, triangle_side in ((b - a, c - b, 1.0), (c - e, e - a, -1.0)):
            # Height of the ray's origin above the plane of the triangle, and its rate of descent towards it.
            origin_height = origin.z - a - rise_x * x - rise_y * y
            descent_rate = rise_x * du + rise_y * dv - direction.z
            is_crossing = jnp.abs(descent_rate) > MIN_COMPONENT
            t = origin_height / jnp.where(is_crossing, descent_rate, 1.0)
            hit_x, hit_y = x + t * du, y + t * dv
            is_on_triangle = (
                (hit_x >= -tolerance) & (hit_x <= 1 + tolerance) & (hit_y >= -tolerance) & (hit_y <= 1 + tolerance)
            )
            is_on_triangle = (
                is_on_triangle & (triangle_side * (hit_x - hit_y) >= -tolerance) & is_crossing & is_inside & (t >= 0)
            )
            n = Vector(-rise_x / side_x, -rise_y / side_y, jnp.ones_like(t))
            hit = _nearer_hit((jnp.where(is_on_triangle, t, jnp.inf), n), hit)
        step = jnp.int32(1)
        # Continue with the neighbouring cell that the ray enters first.
        goes_right, goes_up = du > 0, dv > 0
        is_moving_x, is_moving_y = jnp.abs(du) > MIN_COMPONENT, jnp.abs(dv) > MIN_COMPONENT
        t_x = jnp.where(is_moving_x, (jnp.where(goes_right, 1.0, 0.0) - x) / jnp.where(is_moving_x, du, 1.0), jnp.inf)
        t_y = jnp.where(is_moving_y, (jnp.where(goes_up, 1.0, 0.0) - y) / jnp.where(is_moving_y, dv, 1.0), jnp.inf)
        is_x_first = t_x <= t_y
        column = jnp.where(is_inside & is_x_first, column + jnp.where(goes_right, step, -step), column)
        row = jnp.where(is_inside & ~is_x_first, row + jnp.where(goes_up, step, -step), row)
        return (column, row, hit), None

    zero = jnp.zeros_like(origin.x)
    no_hit = (zero + jnp.inf, Vector(zero, zero, zero + 1))
    (_, _, (t, n)), _ = lax.scan(visit_cell, (column, row, no_hit), length=n_rows + n_columns - 2)
    return t, normalize(n, n)
