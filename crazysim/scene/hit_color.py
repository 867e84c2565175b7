"""The colour of a ray at its first hit, by the rules of MuJoCo's renderer: a function of one ray, for kernels.

MuJoCo lights the vertices of its triangles with OpenGL's fixed functions; this function lights every pixel with them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from crazysim.core.branches import compute_where, select_where, table_rows
from crazysim.geometry import Shape
from crazysim.geometry.points import Components
from crazysim.geometry.shapes import UNBOUNDED_LENGTH
from crazysim.geometry.vector import Vector
from crazysim.rotation import safe_sqrt
from crazysim.scene.first_hit import (
    Ray,
    Surface,
    Tables,
    camera_ray,
    counts_in_world,
    first_hit_of_ray,
    normal_in_frame,
    surface_at_hit,
    world_vector,
)
from crazysim.scene.mesh_texture import texture_coordinates

MAX_LEVELS = 12
"""Largest number of images of a texture, each half as wide as the one before."""
SHADOW_OFFSET = 1e-3
"""Distance from a surface at which rays to lights begin, m: more than the rounding of positions."""
MIN_COSINE = 1e-3
"""Cosine of the steepest angle of incidence for which the size of a pixel on the surface is computed."""


class Light(NamedTuple):
    """What the kernel must know about a light when it is compiled."""

    is_headlight: bool
    """Whether it shines along the axis of the camera."""
    is_spot: bool
    """Whether it shines from a point, not from one direction."""
    casts_shadow: bool = False
    """Whether objects shade it."""


class LightRow(NamedTuple):
    """A light in a table."""

    pos: Any
    dir: Any
    """Direction in which it shines, unit."""
    ambient: Any
    diffuse: Any
    specular: Any
    attenuation: Any
    """Coefficients of 1, the distance and its square."""
    exponent: Any
    """Exponent of the cosine between its axis and a ray of light."""
    cutoff: Any
    """Cosine of the largest angle between its axis and a ray of light."""

    @classmethod
    def read(cls, table: Array, index: Array) -> LightRow:
        row = table_rows(table, index)
        return cls(*(row[k : k + 3] for k in range(0, 18, 3)), *row[18:])


class View(NamedTuple):
    """Numbers of a scene that concern all rays."""

    pixel_angle: Any
    """Angle between neighbouring pixels in the middle of the image, rad."""
    radius: Any
    """Distance from the camera's vertical axis at which the sky hides everything, m."""
    ambient: Any
    """Ambient light of a scene without lights."""
    sky_size: Any
    """Width of a side of the sky, texels."""
    plane_height: Any
    """Height of the plane that disappears in haze, m."""
    haze_red: Any
    haze_green: Any
    haze_blue: Any
    haze: Any
    """Share of the radius over which the haze extends."""
    densest: Any
    """Height at which the haze is densest, between 0 at its beginning and 1 at the horizon."""


class Paint(NamedTuple):
    """Colours of a scene, as tables in memory."""

    looks: Array
    """Red, green, blue, emission, specular, exponent of highlights, repetitions of the texture along both axes, and its
    shift, of each geom. (n_geoms, 9)"""
    textures: Array
    """First row in ``levels`` and number of rows of the texture of each geom; 0 rows for none. (n_geoms, 2)"""
    levels: Array
    """First texel, width and height of each image of a texture, from large to small. (n_levels, 3)"""
    texels: Array
    """Colours, 8 bits each, red lowest; the six sides of the sky come first. (n_texels, 1)"""
    lights: Array
    """See ``LightRow``. (n_lights, 20)"""
    view: Array
    """See ``View``. (1, 10)"""


class Sight(NamedTuple):
    """A ray of a camera, and the geom that it meets."""

    axes: Sequence[Array]
    """Matrix with the axes of the camera as columns, row by row, world frame. () each"""
    ray: Ray
    """The ray."""
    distance: Array
    """Distance to the geom, m; any number where there is none. ()"""
    geom: Array
    """Index of the geom; -1 for none. ()"""
    look: Array
    """Its row in ``Paint.looks`` and ``Paint.textures``. ()"""
    first_light: Array
    """First row of its world in ``Paint.lights``. ()"""


ReachLight = Callable[[int, Array, Components, Sequence[Array], Components, Array], Array]
"""Function of a light's index, its strength, a point, the normal there, the direction to the light and the distance to
it, m, that returns the strength that reaches the point."""


def color_at_hit(lights: Sequence[Light], has_sky: bool, has_haze: bool, *rays: Any) -> list[Array]:
    """Return red, green and blue of a ray, from 0 to 1. () each

    Args:
        lights: Lights in the order of ``Paint.lights``.
        has_sky: Whether rays that meet nothing have the colour of the sky; they are black otherwise.
        has_haze: Whether a plane disappears in haze at the horizon.
        *rays: Other arguments of ``_look_along``.
    """
    paint, sight, describe, reach_light = _look_along(lights, *rays)
    color = shade(lights, has_sky, has_haze, paint, sight, describe, reach_light)
    return [jnp.clip(c, 0.0, 1.0) for c in color]


def packed_color_at_hit(*args: Any) -> list[Array]:
    """Return the same as ``color_at_hit``, 8 bits each for red (lowest), green and blue. ()"""
    # OpenGL rounds colours to the nearest of 255 steps.
    red, green, blue = ((255 * c + 0.5).astype(jnp.int32) for c in color_at_hit(*args))
    return [red + green * 256 + blue * 65536]


def unpack_color(packed: Array) -> Array:
    """Return the colours that ``packed_color_at_hit`` returned, uint8. (..., 3)"""
    return lax.bitcast_convert_type(packed, np.uint8)[..., :3]


def color_tangent_at_hit(*args: Any) -> list[Array]:
    """Return the tangents of red, green and blue for those of 16 numbers, in the last table. () each

    The numbers are the distance, then the components of the origin, the direction, the third axis of the camera, the
    motion of the point in the frame of the geom, and the rotation of the geom, rad, all in the world frame. Edges, of
    shadows too, do not move.

    Args:
        *args: Those of ``color_at_hit``, and the table. (n_rays, 16)
    """
    color, numbers, tangents = _color_near_hit(*args)
    return jax.jvp(color, numbers, [x.astype(numbers[0].dtype) for x in tangents])[1]


def color_cotangent_at_hit(*args: Any) -> Sequence[Array]:
    """Return the cotangents of the numbers of ``color_tangent_at_hit`` for those of the colours. () each

    Args:
        *args: Those of ``color_at_hit``, and the table. (n_rays, 3)
    """
    color, numbers, cotangents = _color_near_hit(*args)
    return jax.vjp(color, *numbers)[1]([x.astype(numbers[0].dtype) for x in cotangents])


def _color_near_hit(
    lights: Sequence[Light], has_sky: bool, has_haze: bool, *rays: Any
) -> tuple[Callable[..., list[Array]], list[Array], list[Array]]:
    # Function from numbers of a ray to its colour, the numbers, and the ray's row in the last table.
    *along, changes = rays
    paint, sight, describe, reach_light = _look_along(lights, *along)
    sight = sight._replace(distance=jnp.where(jnp.isfinite(sight.distance), sight.distance, 1.0))
    numbers = describe(_rates_of_surface, 20)
    normal, (u, *u_rates), (v, *v_rates), rates = numbers[:3], numbers[3:7], numbers[7:11], numbers[11:]
    point, back = _end(sight), _column(sight.axes, 2)
    shares: dict[int, Array] = {}
    for k, light in enumerate(lights):
        if light.casts_shadow:
            row = LightRow.read(paint.lights, sight.first_light + k)
            strength, to_light, limit = _incidence(light, row, point, back)
            shares[k] = jnp.where(reach_light(k, strength, point, normal, to_light, limit) > 0, 1.0, 0.0)

    def reach(k: int, strength: Array, *_: Any) -> Array:
        return strength * shares[k].astype(strength.dtype) if k in shares else strength

    def color(distance: Array, *components: Array) -> list[Array]:
        origin, direction, (x, y, z), shift, turn = (components[k : k + 3] for k in range(0, 15, 3))
        axes = (*sight.axes[:2], x, *sight.axes[3:5], y, *sight.axes[6:8], z)
        ray = sight.ray._replace(origin=origin, direction=direction)
        # Without terms of second order, whose derivative is zero at a shift and a turn of zero.
        turned = Vector(*normal) + Vector(*turn).cross(Vector(*normal))
        turned += Vector(*(_dot(rates[k::3], shift) for k in range(3)))
        surface = turned.x, turned.y, turned.z, u + _dot(u_rates, shift), *u_rates, v + _dot(v_rates, shift), *v_rates
        moved = sight._replace(axes=axes, ray=ray, distance=distance)
        rgb = shade(lights, has_sky, has_haze, paint, moved, lambda: surface, reach, select_where)
        return [jnp.clip(c, 0.0, 1.0) for c in rgb]

    at_rest = (jnp.zeros_like(point[0]),) * 3
    numbers = [sight.distance, *sight.ray.origin, *sight.ray.direction, *back, *at_rest, *at_rest]
    return color, numbers, table_rows(changes, along[4])


def _look_along(
    lights: Sequence[Light],
    is_per_world: bool,
    surfaces: Sequence[Surface],
    n_pixels: int,
    n_cameras: int,
    index: Array,
    *tables: Array,
) -> tuple[Paint, Sight, Callable[..., Sequence[Array]], ReachLight]:
    """Return the colours of the scene, a ray, and the two functions of it that ``shade`` takes.

    Args:
        lights: Lights in the order of ``Paint.lights``.
        is_per_world: Whether looks, textures and lights have rows for each world, one world after the other.
        surfaces: ``Targets.surfaces``.
        n_pixels: Number of rays of a camera.
        n_cameras: Number of cameras of a world.
        index: Index of the ray, as in ``first_hit``. ()
        *tables: Fields of ``Paint`` and ``Tables``, then the two results of ``first_hit``. (n_rays, 1) each
    """
    n_paint = len(Paint._fields)
    paint, t, (distances, geoms) = Paint(*tables[:n_paint]), Tables(*tables[n_paint:-2]), tables[-2:]
    world, ray = camera_ray(t, n_pixels, n_cameras, index)
    counts = counts_in_world(t, world)
    axes = table_rows(t.camera_poses, lax.div(index, jnp.int32(n_pixels)))[3:]
    (distance,), (geom,) = table_rows(distances, index), table_rows(geoms, index)
    scene = world if is_per_world else jnp.int32(0)
    row = jnp.where(geom < 0, jnp.int32(0), geom)  # other lanes of a branch read a row, too, which must exist
    look = row + scene * (counts[1] + counts[2])

    def describe(fn: Callable[..., Any] = _normal_and_texture, n_results: int = 11) -> Sequence[Array]:
        return surface_at_hit(fn, n_results, surfaces, n_pixels, n_cameras, index, *tables[n_paint:])

    def reach_light(
        k: int, strength: Array, point: Components, normal: Sequence[Array], to_light: Components, limit: Array
    ) -> Array:
        def trace_to_light(strength: Array) -> Array:
            x, y, z = (p + SHADOW_OFFSET * n for p, n in zip(point, normal, strict=True))
            shadow_ray = Ray((x, y, z), to_light, ray.ignored_drone)
            return jnp.where(first_hit_of_ray(surfaces, t, counts, world, shadow_ray, limit)[1] < 0, strength, 0.0)

        if not lights[k].casts_shadow:
            return strength
        is_facing = (strength > 0) & (_dot(normal, to_light) > 0)
        return compute_where(is_facing, trace_to_light, jnp.where(is_facing, strength, 0.0))

    return paint, Sight(axes, ray, distance, geom, look, scene * len(lights)), describe, reach_light


def shade(
    lights: Sequence[Light],
    has_sky: bool,
    has_haze: bool,
    paint: Paint,
    sight: Sight,
    describe: Callable[[], Sequence[Array]],
    reach_light: ReachLight,
    branch: Callable[..., Any] = compute_where,
) -> Components:
    """Return red, green and blue of a ray, from 0 to 1 before they are limited. () each

    Args:
        lights: As in ``color_at_hit``, like the next two.
        has_sky: Whether there is a sky.
        has_haze: Whether there is haze.
        paint: Colours of the scene.
        sight: The ray and the geom that it meets.
        describe: Function that returns the normal of the surface, then the position along both axes of its texture,
            each with its gradient in the world frame, 1/m.
        reach_light: Function for the shadows of lights.
        branch: ``compute_where``, or ``select_where`` for derivatives.
    """
    ray, distance, view = sight.ray, sight.distance, View(*table_rows(paint.view, jnp.int32(0)))
    back, zero = _column(sight.axes, 2), jnp.zeros_like(sight.distance)

    def light_surface(_: Components) -> Components:
        surface_numbers = describe()
        normal, (u, *u_rates), (v, *v_rates) = surface_numbers[:3], surface_numbers[3:7], surface_numbers[7:]
        *own_color, emission, specular, exponent, u_scale, v_scale, shift = table_rows(paint.looks, sight.look)
        point = _end(sight)
        to_eye = [-d for d in ray.direction]
        steepness = _dot(normal, to_eye)
        # OpenGL limits the sum of all lights without shadows, and each light with shadows, which MuJoCo adds to it.
        color, shaded_color = [c * (emission + view.ambient) for c in own_color], [zero] * 3
        for k, light in enumerate(lights):
            row_of_light = LightRow.read(paint.lights, sight.first_light + k)
            strength, to_light, limit = _incidence(light, row_of_light, point, back)
            strength = reach_light(k, strength, point, normal, to_light, limit)
            parts = _reflection(row_of_light, strength, to_light, normal, to_eye, specular, exponent)
            part = [a * own + b for own, (a, b) in zip(own_color, parts, strict=True)]
            if light.casts_shadow:
                shaded_color = [a + jnp.minimum(b, 1.0) for a, b in zip(shaded_color, part, strict=True)]
            else:
                color = [a + b for a, b in zip(color, part, strict=True)]
        color = [jnp.minimum(a, 1.0) + b for a, b in zip(color, shaded_color, strict=True)]
        first_level, n_levels = table_rows(paint.textures, sight.look)

        def draw_texture(color: Components) -> Components:
            # The image whose texels are nearest to the distance between neighbouring pixels on the surface.
            _, width, height = table_rows(paint.levels, first_level)
            spacing = -distance * view.pixel_angle * _dot(ray.direction, back)
            squared_rate = zero
            for axis in (_column(sight.axes, 0), _column(sight.axes, 1)):
                slope = _dot(normal, axis) / jnp.maximum(steepness, MIN_COSINE)
                step = [spacing * (a + slope * d) for a, d in zip(axis, ray.direction, strict=True)]
                du, dv = _dot(u_rates, step) * u_scale * width, _dot(v_rates, step) * v_scale * height
                squared_rate = jnp.maximum(squared_rate, du * du + dv * dv)
            level = sum(jnp.where(squared_rate > 2 ** (2 * k + 1), jnp.int32(1), 0) for k in range(MAX_LEVELS - 1))
            level = first_level + jnp.maximum(
                jnp.minimum(level, n_levels - 1), 0
            )  # a row, in lanes without texture, too
            texel = _interpolate(paint, level, u * u_scale - shift, v * v_scale - shift)
            return tuple(c * k for c, k in zip(color, texel, strict=True))  # type: ignore[return-value]

        return branch(n_levels > 0, draw_texture, tuple(color))

    x, y, rise = ray.direction
    level_share = safe_sqrt(x * x + y * y)
    reach = jnp.where(sight.geom >= 0, distance, jnp.inf) * level_share
    color = zero, zero, zero
    is_far = ~(reach < view.radius)
    if has_sky:
        color = branch(is_far, lambda _: _sky_color(paint, view, ray.direction), color)
    color = branch(~is_far, light_surface, color)
    return _add_haze(view, ray.origin[2], rise, level_share, reach, color) if has_haze else color


def _end(sight: Sight) -> Components:
    x, y, z = (o + sight.distance * d for o, d in zip(sight.ray.origin, sight.ray.direction, strict=True))
    return x, y, z


def _column(matrix: Sequence[Array], k: int) -> Components:
    return matrix[k], matrix[k + 3], matrix[k + 6]


def _dot(a: Sequence[Array], b: Sequence[Array]) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _normal_and_texture(
    surface: Surface, row: Sequence[Array], origin: Components, direction: Components, distance: Array
) -> tuple[Array, ...]:
    # World normal; position along both axes of the texture, each with its gradient. The texture covers a side of a box,
    # or a plane, once; along infinite axes of planes, of terrain and meshes without own coordinates it covers 2 m.
    normal = normal_in_frame(surface, row, origin, direction, distance)
    texture = [jnp.zeros_like(distance)] * 8
    point, half = [o + distance * d for o, d in zip(origin, direction, strict=True)], row[13:16]
    if isinstance(surface, Shape) and surface.triangles is not None:
        coordinates = texture_coordinates(surface.triangles, Vector(*point))
        texture = [x for start, rate in coordinates for x in (start, *world_vector(row, rate))]
    elif surface in ("plane", "rectangle", "box") or isinstance(surface, Shape):
        axes: list[list[Any]] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
        if surface == "box":
            is_x_side, is_z_side = jnp.abs(normal[0]) > 0.5, jnp.abs(normal[2]) > 0.5
            axes = [
                [jnp.where(is_x_side, 0.0, 1.0), jnp.where(is_x_side, 1.0, 0.0), 0.0],
                [0.0, jnp.where(is_z_side, 1.0, 0.0), jnp.where(is_z_side, 0.0, 1.0)],
            ]
        texture = []
        for axis, sign in zip(axes, (0.5, -0.5), strict=True):
            size = _dot(axis, half)
            is_finite = (size > 0) & (size < UNBOUNDED_LENGTH)
            rate = sign / jnp.where(is_finite, size, 1.0)
            start = jnp.where(is_finite, 0.5, 0.0)
            texture += [start + rate * _dot(axis, point), *world_vector(row, tuple(rate * a for a in axis))]  # type: ignore[arg-type]
    return *world_vector(row, normal), *texture


def _rates_of_surface(surface: Surface, row: Sequence[Array], origin: Components, *ray: Any) -> tuple[Array, ...]:
    # The results of ``_normal_and_texture``, and the derivatives of the normal by motions along the world's axes.
    rates = [jnp.zeros_like(origin[0])] * 9
    if isinstance(surface, str):  # meshes and terrain have flat sides
        normal_at = lambda *point: world_vector(row, normal_in_frame(surface, row, point, *ray))  # noqa: E731
        rates = [x for k in (4, 7, 10) for x in jax.jvp(normal_at, origin, tuple(row[k : k + 3]))[1]]
    return *_normal_and_texture(surface, row, origin, *ray), *rates


def _incidence(light: Light, row: LightRow, point: Components, back: Components) -> tuple[Array, Components, Array]:
    # Strength at a point without shadows, direction to the light, and distance to it.
    strength, distance = jnp.ones_like(point[0]), jnp.full_like(point[0], jnp.inf)
    to_light: Any = back if light.is_headlight else [-x for x in row.dir]
    if light.is_spot:
        offset = [a - b for a, b in zip(row.pos, point, strict=True)]
        distance = jnp.sqrt(jnp.maximum(_dot(offset, offset), 1e-12))
        to_light = [x / distance for x in offset]
        cosine = -_dot(to_light, row.dir)
        falloff = row.attenuation[0] + distance * (row.attenuation[1] + distance * row.attenuation[2])
        falloff = jnp.maximum(falloff, 1e-9)  # an attenuation of zeros is allowed
        strength = jnp.where(cosine >= row.cutoff, _power(jnp.maximum(cosine, 0.0), row.exponent) / falloff, 0.0)
    return strength, tuple(to_light), distance  # type: ignore[return-value]


def _reflection(
    row: LightRow,
    strength: Array,
    to_light: Components,
    normal: Sequence[Array],
    to_eye: Sequence[Array],
    specular: Array,
    exponent: Array,
) -> list[tuple[Array, Array]]:
    # Per channel: light that the surface's colour multiplies, and its highlight.
    cosine = _dot(normal, to_light)
    # Of the direction midway between light and eye, which is their sum with the length sqrt(2 + 2 l.e).
    square = jnp.maximum(2 + 2 * _dot(to_light, to_eye), 1e-6)
    highlight_cosine = jnp.clip((cosine + _dot(normal, to_eye)) * lax.rsqrt(square), 0.0, 1.0)
    highlight = jnp.where(cosine > 0, strength * specular * _power(highlight_cosine, exponent), 0.0)
    cosine = strength * jnp.maximum(cosine, 0.0)
    return [
        (strength * a + cosine * d, highlight * s)
        for a, d, s in zip(row.ambient, row.diffuse, row.specular, strict=True)
    ]


def _power(x: Array, exponent: Array) -> Array:
    # exp(exponent log x) for x from 0 to 1, with the series of atanh. Powers of small x are too large, by at most 0.02
    # for exponents from 1.
    y = (x - 1) / (x + 1)
    z = y * y
    series = y * (1 + z * (1 / 3 + z * (1 / 5 + z * (1 / 7 + z * (1 / 9 + z * (1 / 11 + z / 13))))))
    return jnp.exp(2 * exponent * series)


def _interpolate(paint: Paint, level: Array, u: Array, v: Array) -> Components:
    first, width, height = table_rows(paint.levels, level)

    def neighbours(u: Array, size: Array) -> tuple[Array, Array, Array]:
        x = (u - jnp.floor(u)) * size - 0.5
        low = jnp.floor(x)
        k = low.astype(jnp.int32)
        return jnp.where(k < 0, size - 1, jnp.minimum(k, size - 1)), jnp.where(k + 1 >= size, 0, k + 1), x - low

    (left, right, right_share), (top, bottom, bottom_share) = neighbours(u, width), neighbours(v, height)
    upper, lower = (
        [a + right_share * (b - a) for a, b in zip(_texel(paint, k + left), _texel(paint, k + right), strict=True)]
        for k in (first + top * width, first + bottom * width)
    )
    return tuple(a + bottom_share * (b - a) for a, b in zip(upper, lower, strict=True))  # type: ignore[return-value]


def _texel(paint: Paint, index: Array) -> list[Array]:
    (packed,) = table_rows(paint.texels, index)
    bytes_of_color = packed & 255, (packed >> 8) & 255, (packed >> 16) & 255
    return [x.astype(paint.view.dtype) * (1 / 255) for x in bytes_of_color]


def _sky_color(paint: Paint, view: View, direction: Components) -> Components:
    # A side of the cube by the largest component; MuJoCo's sky has y up, and OpenGL's cubes are left-handed.
    x, y, z = direction[0], direction[2], -direction[1]
    ax, ay, az = jnp.abs(x), jnp.abs(y), jnp.abs(z)
    is_x, is_y = (ax >= ay) & (ax >= az), (ay > ax) & (ay >= az)
    is_negative = jnp.where(is_x, x, jnp.where(is_y, y, z)) < 0
    side = jnp.where(is_x, jnp.int32(0), jnp.where(is_y, jnp.int32(2), jnp.int32(4))) + is_negative.astype(jnp.int32)
    across = jnp.where(is_x, jnp.where(x < 0, z, -z), jnp.where(~is_y & (z < 0), -x, x))
    down = jnp.where(is_y, jnp.where(y < 0, -z, z), -y)
    scale = 0.5 / jnp.maximum(jnp.maximum(ax, ay), az)
    size = view.sky_size
    column, row = (jnp.clip((0.5 + scale * p) * size, 0.0, size - 1).astype(jnp.int32) for p in (across, down))
    width = size.astype(jnp.int32)
    red, green, blue = _texel(paint, (side * width + row) * width + column)
    return red, green, blue


def _add_haze(
    view: View, height: Array, rise: Array, level_share: Array, reach: Array, color: Components
) -> Components:
    # A cone around the camera, from the plane up to the horizon; its transparency falls, then rises.
    elevation = (height - view.plane_height) / view.radius
    depth = -rise / jnp.maximum((elevation * level_share - rise * view.haze), 1e-12)
    share = jnp.where(1 - depth < view.densest, (1 - depth) / view.densest, depth / (1 - view.densest))
    is_behind = (elevation > 0) & (rise < 0) & (depth < 1) & (reach >= view.radius * (1 - view.haze * depth))
    share = jnp.where(is_behind, jnp.clip(share, 0.0, 1.0), 0.0)
    haze = view.haze_red, view.haze_green, view.haze_blue
    red, green, blue = (c + share * (h - c) for c, h in zip(color, haze, strict=True))
    return red, green, blue
