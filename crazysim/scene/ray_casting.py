"""Rays through the scene in pure JAX: distance, surface normal and body that was hit."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh

from crazysim import rotation
from crazysim.core.branches import table_rows
from crazysim.core.data import SimData
from crazysim.engine.backends import fused
from crazysim.engine.errors import report_unsupported
from crazysim.engine.index_map import map_indices, map_tangents
from crazysim.engine.pytree import PyTree, static
from crazysim.engine.sharding import map_devices
from crazysim.errors import ConfigError, UnsupportedError
from crazysim.geometry import Shape, ray_distance
from crazysim.geometry.heightfield import field_gap
from crazysim.geometry.points import components
from crazysim.geometry.rays import hit_distance, hit_normal
from crazysim.scene.appearance import Appearance
from crazysim.scene.collision import CollisionGeom, CollisionModel
from crazysim.scene.first_hit import (
    IGNORES_NONE,
    Ray,
    Surface,
    Targets,
    first_fixed_hit,
    first_hit,
    geom_shape,
    node_box,
    normal_at_hit,
    ray_in_frame,
)
from crazysim.scene.hierarchy import N_ORDERS
from crazysim.scene.hit_color import color_at_hit, color_cotangent_at_hit, color_tangent_at_hit, packed_color_at_hit
from crazysim.scene.mocap import MocapPoses, require_poses, with_mocap_bodies
from crazysim.scene.object_poses import map_index_of

T = TypeVar("T")
MAX_UNROLLED_GEOMS = 16
"""Largest number of movable geoms of a world for which a stage should cast rays: its program is unrolled over them."""
MAX_PAIRS = 36
"""Largest number of rays times fixed geoms of one world or drone for which the program is unrolled. The unrolled
program is two to three times as fast as a hierarchy, and compiles in about the same time."""
MAX_LOOP_RAYS = 64
"""Largest number of rays in a loop within a step; an index computed at run time selects among at most 64 entries."""


MIN_COSINE = 0.05
"""Smallest cosine between rays and normals in derivatives of distances, which it limits to 20 m/m where rays graze
surfaces."""
MAX_DEPTH_BELOW_FLOOR = 0.1
"""Depth below the floor from which sensors are moved up, m: drones land at -1 mm, and may carry sensors below that."""
FLOOR_CLEARANCE = 1e-5
"""Height above the floor to which these sensors are moved, m, so that rounding does not put them below it again."""


class Hits(PyTree):
    """First surfaces that rays meet."""

    distance: Array
    """Length of the ray, m; infinite where it meets nothing. (...)"""
    normal: Array
    """Unit normal of the surface, world frame; zero where the ray meets nothing. (..., 3)"""
    point: Array
    """Point of the surface, world frame, m; zero where the ray meets nothing. (..., 3)"""
    body_index: Array
    """Index of the body in ``names``; -1 where the ray meets nothing. (...)"""
    names: tuple[str, ...] = static()
    """Names of floor, objects and drones, in the order of ``body_index``."""
    color: Array | None = None
    """Colour of the surface, or of the sky, red, green and blue, uint8, or from 0 to 1 with derivatives; None if it was
    not requested. (..., 3)"""
    is_hidden: Array | None = None
    """Whether the second imager of a stereo camera does not see the surface; None for other cameras. (...)"""
    earlier_point: Array | None = None
    """Place of the point at an earlier time, in the camera's frame then (right, up, back), m; where the ray meets
    nothing, its direction in this frame. None without an earlier time. (..., 3)"""
    was_hidden: Array | None = None
    """Whether a nearer surface hid the point from the camera at the earlier time; None without one. (...)"""
    camera_axes: Array | None = None
    """Axes of the camera in images as columns, right, up and back, world frame; one for each row with a rolling
    shutter. (..., n_cameras, height or 1, 1, 3, 3)"""


def raise_to_floor(model: CollisionModel, pos: Array) -> Array:
    """Return positions of sensors, moved up to the floor where they are a little below it. (..., 3)

    From below, a plane is invisible, and a height field is seen from within.
    """
    for geom in model.floor:
        rot = np.eye(3) if geom.rot is None else np.array(geom.rot)
        local_pos = _constant_product(rot.T, pos - jnp.asarray(geom.pos, pos.dtype))
        if geom.shape.kind == "hfield":
            gap, normal = field_gap(geom.shape, local_pos)
        else:
            gap, normal = local_pos[..., 2], jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0], pos.dtype), pos.shape)
            for k, half in enumerate(geom.shape.size):
                gap = jnp.where(jnp.abs(local_pos[..., k]) <= half, gap, jnp.inf)
        rise = jnp.where((gap < 0) & (gap > -MAX_DEPTH_BELOW_FLOOR), FLOOR_CLEARANCE - gap, 0.0)
        pos = pos + rise[..., None] * _constant_product(rot, normal)
    return pos


def body_names(model: CollisionModel, n_drones: int) -> tuple[str, ...]:
    """Return the names of everything that rays can meet, in the order of ``Hits.body_index``."""
    return ("floor", *(body.name for body in model.objects), *(f"drone:{i}" for i in range(n_drones)))


def cast_rays(
    model: CollisionModel,
    data: SimData,
    origin: Array,
    direction: Array,
    ignored_drones: np.ndarray | None = None,
    drones: bool = True,
    mocap: MocapPoses = None,
    kernels: RayKernels | None = None,
    limit: Array | float = np.inf,
) -> Hits:
    """Return the first surfaces that rays meet, in all worlds, in one world, or around one drone, as in ``data``.

    Args:
        model: Visual or collision model of the scene.
        data: Simulation, for the poses of objects and drones.
        origin: Origins of the rays, world frame, m. (n_worlds, n_rays, 3), without n_worlds in one world or drone
        direction: Unit directions, world frame. Same shape as ``origin``
        ignored_drones: Index of the drone that a ray passes through; None for no drone. (n_rays,)
        drones: Whether rays meet drones; must be False in a stage of one drone, which has no access to other drones.
        mocap: Poses of bodies that are moved through ``mjx_data``; None if there are none.
        kernels: Kernels that may cast the rays of all worlds; None for XLA.
        limit: Distance beyond which rays of one world or drone may miss fixed geoms, m.
    """
    require_poses(model, [body.name for body in model.objects], mocap)
    data = with_mocap_bodies(model, data, mocap)
    if origin.ndim == 3:
        # Each ray becomes a camera of one pixel; the camera's first axis is the direction of the ray.
        zero, ignored = (
            jnp.zeros((*direction.shape, 2), direction.dtype),
            IGNORES_NONE if ignored_drones is None else ignored_drones,
        )
        axes = jnp.concatenate([direction[..., None], zero], axis=-1).reshape(*direction.shape[:2], 9)
        pixel_rays = np.zeros((origin.shape[1], 1, 4))
        pixel_rays[..., 0], pixel_rays[:, 0, 3] = 1.0, ignored
        camera_poses = jnp.concatenate([origin, axes], axis=-1)
        return cast_rays_in_worlds(model, data, camera_poses, pixel_rays, drones, kernels or RayKernels())
    # The nearest of all geoms, in one world or around one drone.
    best = Hits(
        distance=jnp.full(origin.shape[:-1], jnp.inf, origin.dtype),
        normal=jnp.zeros_like(origin),
        point=jnp.zeros_like(origin),
        body_index=jnp.full(origin.shape[:-1], -1, jnp.int32),
        names=body_names(model, data.core.n_drones if drones else 0),
    )
    # Fixed geoms, by a hierarchy if there are many.
    targets = Targets(model, 0, drones=False)
    map_index = map_index_of(data) if targets.n_maps else None
    n_pairs = len(targets.fixed_geoms) * len(origin)
    if n_pairs <= MAX_PAIRS and (map_index is None or not n_pairs):
        for target in targets.fixed_geoms:
            best = _nearer_hits(best, *_hit_geom(target.geom, origin, direction), target.body_index)
    else:
        best = _nearer_hits(best, *_hit_fixed_geoms(targets, origin, direction, limit, map_index))
    # Objects that have the same geoms are one batch.
    groups: dict[tuple[CollisionGeom, ...], list[tuple[int, int]]] = {}
    for index, body in enumerate(model.objects, start=1):
        if body.row is not None:
            groups.setdefault(body.geoms, []).append((body.row, index))
    if data.objects is not None:
        pos, quat = data.objects.pos, data.objects.quat
        for geoms, group in groups.items():
            best = _hit_bodies(best, geoms, pos, quat, np.array(group), origin, direction, None)
    if drones:
        pos, quat = data.states.pos, data.states.quat
        for drone_geoms in model.drones:
            rows = np.arange(data.core.n_drones) if drone_geoms.drones is None else np.asarray(drone_geoms.drones)
            group = np.stack([rows, rows + 1 + len(model.objects)], axis=-1)
            best = _hit_bodies(best, drone_geoms.geoms, pos, quat, group, origin, direction, ignored_drones)
    return best.replace(point=_hit_points(origin, direction, best.distance))


def _hit_points(origin: Array, direction: Array, distance: Array) -> Array:
    is_hit = jnp.isfinite(distance)[..., None]
    return jnp.where(is_hit, origin + jnp.where(is_hit, distance[..., None], 0.0) * direction, 0.0)


def _hit_bodies(
    best: Hits,
    geoms: tuple[CollisionGeom, ...],
    pos: Array,
    quat: Array,
    group: np.ndarray,
    origin: Array,
    direction: Array,
    ignored_rows: np.ndarray | None,
) -> Hits:
    def nearer_hits_of_body(best: Hits, row: Array, body_index: Array) -> Hits:
        p, q = (jnp.take(x, row, axis=-2)[..., None, :] for x in (pos, quat))
        local_origin, local_direction = rotation.rotate_inverse(q, origin - p), rotation.rotate_inverse(q, direction)
        for geom in geoms:
            distance, normal = _hit_geom(geom, local_origin, local_direction)
            distance = distance if ignored_rows is None else jnp.where(ignored_rows == row, jnp.inf, distance)
            best = _nearer_hits(best, distance, rotation.rotate(q, normal), body_index)
        return best

    for row, body_index in group:
        best = nearer_hits_of_body(best, row, body_index)
    return best


def _hit_geom(geom: CollisionGeom, origin: Array, direction: Array) -> tuple[Array, Array]:
    local_origin = origin - jnp.asarray(geom.pos, origin.dtype)
    if geom.rot is None:
        return ray_distance(geom.shape, local_origin, direction)
    rot = np.array(geom.rot)
    distance, normal = ray_distance(
        geom.shape, _constant_product(rot.T, local_origin), _constant_product(rot.T, direction)
    )
    return distance, _constant_product(rot, normal)


def _constant_product(matrix: np.ndarray, vectors: Array) -> Array:
    x = [vectors[..., k] for k in range(3)]
    terms = [[float(m) * v for m, v in zip(row, x, strict=True) if m] for row in matrix]
    return jnp.stack([functools.reduce(jnp.add, row) for row in terms], axis=-1)


def _nearer_hits(best: Hits, distance: Array, normal: Array, body_index: Array | int) -> Hits:
    is_closer = distance < best.distance
    return best.replace(
        distance=jnp.where(is_closer, distance, best.distance),
        normal=jnp.where(is_closer[..., None], normal, best.normal),
        body_index=jnp.where(is_closer, jnp.asarray(body_index, jnp.int32), best.body_index),
    )


def _hit_fixed_geoms(
    targets: Targets, origin: Array, direction: Array, limit: Array | float, map_index: Array | None
) -> tuple[Array, Array, Array]:
    # A loop over the rays finds the nearest geoms without derivatives. The distances to these geoms have derivatives.
    tables = targets.build_fixed_hierarchy(origin.dtype)
    surfaces = targets.surfaces[: 1 + targets.codes[: len(targets.fixed_geoms), 0].max()]
    origins, directions = jax.lax.stop_gradient((origin, direction))
    initial = jax.lax.stop_gradient(jnp.asarray(limit, origin.dtype)), jnp.int32(-1)
    n_nodes = len(tables.boxes) // N_ORDERS
    map_range = (0, n_nodes) if map_index is None else table_rows(tables.ranges, map_index)
    settings = initial, n_nodes, map_range, map_index is None

    def first_geoms(origins: Array, directions: Array) -> Array:
        def cast_next(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
            k, geom_index = carry
            ray = Ray(components(origins[k]), components(directions[k]), jnp.int32(IGNORES_NONE))
            geom = first_fixed_hit(surfaces, tables, ray, *settings)[1]
            return (k + 1, geom_index.at[k].set(geom)), None

        initial_carry = jnp.int32(0), jnp.full(len(origins), -1, jnp.int32)
        return jax.lax.scan(cast_next, initial_carry, length=len(origins))[0][1]

    chunks = [slice(k, k + MAX_LOOP_RAYS) for k in range(0, len(origins), MAX_LOOP_RAYS)]
    geom_index = jnp.concatenate([first_geoms(origins[chunk], directions[chunk]) for chunk in chunks])
    rows = jnp.take(tables.fixed_geoms, jnp.maximum(geom_index, 0), axis=0)
    distance, normal_at = _hit_rows(surfaces, targets.codes, geom_index, rows, origin, direction)
    body_indices = jnp.asarray([target.body_index for target in targets.fixed_geoms], jnp.int32)
    return distance, normal_at(distance), jnp.take(body_indices, jnp.maximum(geom_index, 0))


def _hit_rows(
    surfaces: Sequence[Surface], codes: np.ndarray, geom_index: Array, rows: Array, origin: Array, direction: Array
) -> tuple[Array, Callable[[Array], Array]]:
    row = [rows[..., k] for k in range(16)]
    local_origin, local_direction = ray_in_frame(row, components(origin), components(direction))
    ray_start, ray_direction = jnp.stack(local_origin, axis=-1), jnp.stack(local_direction, axis=-1)
    code = jnp.take(jnp.asarray(codes[:, 0]), jnp.maximum(geom_index, 0))
    surface_hits = []
    distance = jnp.full_like(local_origin[0], jnp.inf)
    for index, surface in enumerate(surfaces):
        is_selected = (geom_index >= 0) & (code == index)
        # Geoms of other kinds get sizes of 1, so that derivatives are finite.
        shape = geom_shape(surface, [*row[:13], *(jnp.where(is_selected, x, 1.0) for x in row[13:])])
        if isinstance(shape, Shape) and shape.kind == "hfield":
            ray_length, normal = ray_distance(shape, ray_start, ray_direction)
        else:
            ray_length, normal = hit_distance(shape, local_origin, local_direction), None
        distance = jnp.where(is_selected, ray_length, distance)
        surface_hits.append((is_selected, shape, normal))

    def normal_at(distance: Array) -> Array:
        normals = jnp.zeros_like(origin)
        for is_selected, shape, normal in surface_hits:
            normal = hit_normal(shape, ray_start, ray_direction, distance) if normal is None else normal
            normals = jnp.where(is_selected[..., None], normal, normals)
        return jnp.stack([sum(row[4 + 3 * i + k] * normals[..., k] for k in range(3)) for i in range(3)], axis=-1)

    return distance, normal_at


# Rays of all worlds -------------------------------------------------------------------------------------------------


def cast_rays_in_worlds(
    model: CollisionModel,
    data: SimData,
    camera_poses: Array,
    pixels: np.ndarray,
    drones: bool,
    kernels: RayKernels,
    appearance: Appearance | None = None,
    pixel_angle: float = 0.0,
) -> Hits:
    """Return the first surfaces that the rays of cameras meet, in all worlds. (n_worlds, n_cameras * n_pixels)

    A function of one ray finds the distance and the nearest geom without derivatives, in a kernel of the engine if
    possible. A second function finds the normal at that point. The derivative of a distance is that of the distance to
    the tangent plane there, without the motion of edges. Inside ``jit``, unused results are not computed.

    Args:
        model: Model, without bodies whose poses are not part of the data.
        data: Simulation, for the poses of objects and drones.
        camera_poses: Position of each camera, m, and the matrix with its axes as columns, row by row; world frame.
            (n_worlds, n_cameras, 12)
        pixels: Unit directions in the frame of the camera, and the drone that a ray passes through or ``IGNORES_NONE``.
            (n_cameras, n_pixels, 4)
        drones: Whether rays meet drones.
        appearance: The scene's materials and lights, for colours; None for no colours.
        pixel_angle: Angle between neighbouring pixels in the middle of the image, rad; for colours.
    """
    ignored = np.unique(pixels[..., 3])
    targets = Targets(model, data.core.n_drones, drones, int(ignored[0]) if len(ignored) == 1 else IGNORES_NONE)
    n_worlds, (n_cameras, n_pixels, _) = camera_poses.shape[0], pixels.shape
    # The nearest geom of each ray, in kernels.
    boxes, movable = targets.movable_rows(data)
    boxes, links = kernels.node_boxes(targets, jax.lax.stop_gradient(boxes))
    map_index = map_index_of(data) if targets.n_maps else None
    pixel_table = jnp.asarray(pixels, camera_poses.dtype)
    tables = targets.tables(boxes, links, movable, camera_poses, pixel_table, map_index)
    n, tables = n_worlds * n_cameras * n_pixels, jax.lax.stop_gradient(tables)
    ray_fn = functools.partial(first_hit, targets.surfaces, n_pixels, n_cameras)
    (ray_length, geom_index), platform = kernels.run(ray_fn, n, tables, targets)
    hit_table = ray_length[:, None], geom_index[:, None]
    distance, geom_index = ray_length.reshape(n_worlds, -1), geom_index.reshape(n_worlds, -1)

    # Rays in the world frame.
    pixel_direction = jnp.asarray(pixels[..., :3], camera_poses.dtype)
    axes = camera_poses[..., 3:].reshape(n_worlds, n_cameras, 1, 3, 3)
    direction = sum(axes[..., k] * pixel_direction[..., k, None] for k in range(3)).reshape(n_worlds, -1, 3)
    origin = jnp.repeat(camera_poses[..., :3], n_pixels, axis=1)
    names = body_names(model, data.core.n_drones if drones else 0)
    color = None
    if appearance is not None:
        paint = appearance.paint(data, targets.all_geoms, pixel_angle)
        color_fn = color_at_hit if appearance.has_derivatives else packed_color_at_hit
        color_fn = functools.partial(color_fn, *appearance.flags, targets.surfaces, n_pixels, n_cameras)
        color, _ = kernels._map_indices(color_fn, n, [*paint, *tables, *hit_table])
        # Packed colours are unpacked when their pixels are in the order of the image.
        color = jnp.stack(color, axis=-1).reshape(n_worlds, -1, len(color))
    if not targets.all_geoms:
        return Hits(distance, jnp.zeros_like(origin), jnp.zeros_like(origin), geom_index, names, color)
    # The normal, in a kernel if possible, and derivatives of both.
    n_fixed = len(targets.fixed_geoms)
    rows = jnp.take(tables.fixed_geoms, jnp.clip(geom_index, 0, max(n_fixed - 1, 0)), axis=0)
    if targets.movable_geoms:
        movable_rows = jnp.take_along_axis(movable, jnp.maximum(geom_index - n_fixed, 0)[..., None], axis=1)
        rows = jnp.where((geom_index < n_fixed)[..., None], rows, movable_rows)
    _, normal_at = _hit_rows(targets.surfaces, targets.codes, geom_index, rows, origin, direction)
    if platform is None:
        normal = normal_at(distance)
    else:
        ray_fn = functools.partial(normal_at_hit, targets.surfaces, n_pixels, n_cameras)
        normal = jnp.stack(map_indices(ray_fn, n, [*tables, *hit_table], platform, compile_now=False), axis=-1)
        normal = normal.reshape(*distance.shape, 3)
    distance = _replace_derivative(distance, _gap(distance, normal, rows, origin, direction))
    normal = _replace_derivative(normal, normal_at(distance))
    if appearance is not None and appearance.has_derivatives:
        fns = tuple(
            functools.partial(fn, *appearance.flags, targets.surfaces, n_pixels, n_cameras)
            for fn in (color_tangent_at_hit, color_cotangent_at_hit)
        )
        back = jnp.broadcast_to(axes[..., 2], (n_worlds, n_cameras, n_pixels, 3)).reshape(n_worlds, -1, 3)
        numbers = _numbers_of_color(distance, rows, origin, direction, back)
        color = _with_tangents((fns, platform), color, numbers, (*paint, *tables, *hit_table))
    body_indices = jnp.asarray([*(target.body_index for target in targets.all_geoms), -1], jnp.int32)
    return Hits(distance, normal, _hit_points(origin, direction, distance), body_indices[geom_index], names, color)


def _numbers_of_color(distance: Array, rows: Array, origin: Array, direction: Array, back: Array) -> Array:
    # Of which ``color_tangent_at_hit`` takes the tangents. (n_worlds, n_rays, 16)
    length = jnp.where(jnp.isfinite(distance), distance, 0.0)
    axes = _axes_of_geoms(rows)
    local_end = _in_frame(axes, origin + length[..., None] * direction - rows[..., :3])
    shift = jnp.sum(_hold(axes) * local_end[..., None, :], axis=-1)
    turn = jnp.sum(jnp.cross(_hold(axes), axes, axisa=-2, axisb=-2, axisc=-2), axis=-1) / 2
    return jnp.concatenate([length[..., None], origin, direction, back, shift, turn], axis=-1)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _with_tangents(fns: Any, color: Array, numbers: Array, tables: Sequence[Array]) -> Array:
    # The colours, (n_worlds, n_rays, 3), whose derivatives are those by the numbers.
    del fns, numbers, tables
    return color


@_with_tangents.defjvp
def _(fns: Any, primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    (color, numbers, tables), (fns, platform) = primals, fns
    result = map_tangents(fns, tables, tangents[1].reshape(-1, numbers.shape[-1]), platform)
    return color, result.reshape(color.shape).astype(color.dtype)


def _gap(distance: Array, normal: Array, rows: Array, origin: Array, direction: Array) -> Array:
    # Has the derivative of the distances to the tangent planes of the surfaces, which move with their geoms.
    length = _hold(jnp.where(jnp.isfinite(distance), distance, 0.0))
    cosine = jnp.sum(normal * direction, axis=-1)
    cosine = jnp.where(cosine < 0, -1.0, 1.0) * jnp.maximum(jnp.abs(cosine), MIN_COSINE)
    weight, end = normal / cosine[..., None], origin + length[..., None] * direction
    axes = _axes_of_geoms(rows)
    local_weight = _hold(_in_frame(axes, weight))
    local_end = _in_frame(axes, _hold(end) - rows[..., :3])
    return -jnp.sum(_hold(weight) * end, axis=-1) - jnp.sum(local_weight * local_end, axis=-1)


def _axes_of_geoms(rows: Array) -> Array:
    # Matrices with the axes of geoms as columns. (..., 3, 3)
    return rows[..., 4:13].reshape(*rows.shape[:-1], 3, 3)


def _in_frame(axes: Array, vectors: Array) -> Array:
    # Vectors of the world in the frames with these axes. (..., 3)
    return jnp.sum(axes * vectors[..., None], axis=-2)


@jax.custom_jvp
def _hold(x: Array) -> Array:
    return x


@_hold.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    return _refuse_derivative(primals[0]), jnp.zeros_like(tangents[0])


@jax.custom_jvp
def _refuse_derivative(x: Array) -> Array:
    return x


@_refuse_derivative.defjvp
def _(*_: Any) -> tuple[Array, Array]:
    raise ConfigError(
        "expected the first derivative of distances of rays, got a second one. Use central differences of the first."
    )


@dataclasses.dataclass
class RayKernels:
    """Kernels of the engine that cast rays; XLA where kernels are not available."""

    platform: str | None = None
    """Platform of the kernels, ``"cpu"`` or ``"gpu"``; None for XLA."""
    strict: bool = False
    """Whether to raise an error where XLA would be used with an ``EngineWarning``."""
    mesh: Mesh | None = None
    """Devices over which the worlds are distributed; None for one device."""
    last_used: str = ""
    """Description of how the last rays were cast, for ``Sim.explain``; empty before the first rays."""
    reported_warnings: set[str] = dataclasses.field(default_factory=set)
    """Warnings that have already been given."""

    @classmethod
    def choose(cls, engine: str, device: jax.Device, mesh: Mesh | None, strict: bool) -> RayKernels:
        """Return the kernels for a simulation, or XLA if its engine or its device has no kernels.

        Args:
            engine: Engine of the simulation, one of ``crazysim.engine.ENGINES``.
            device: Device of its data.
            mesh: Devices over which its worlds are distributed; None for one device.
            strict: Whether to raise an error where XLA would be used with an ``EngineWarning``.
        """
        has_kernels = str(engine) in ("auto", "fused") and not fused.unavailable_reason(device.platform)
        return cls(device.platform if has_kernels else None, strict, mesh)

    def run_on_each_device(self, fn: Callable[[SimData, RayKernels], T], data: SimData) -> T:
        """Return the results of a function of data and kernels; each device computes them for its own worlds.

        Args:
            fn: Function whose results have a leading axis over worlds.
            data: Data of all worlds.
        """
        if self.mesh is None:
            return fn(data, self)
        kernels = dataclasses.replace(self, mesh=None)
        results = map_devices(lambda data: fn(data, kernels), data, self.mesh)
        self.last_used = kernels.last_used
        return results

    def node_boxes(self, targets: Targets, leaf_boxes: Array) -> tuple[Array, np.ndarray]:
        """Return the boxes of the nodes of the movable geoms in every world, (n_worlds, n_nodes, 6), and their links.

        ``Targets.movable_nodes`` defines nodes and links.

        Args:
            leaf_boxes: Boxes of the movable geoms, from ``Targets.movable_rows``. (n_worlds, n_movable, 6)
        """
        ranges, leaves, links = targets.movable_nodes()
        n_worlds, n_nodes = len(leaf_boxes), len(ranges)
        if not n_nodes:
            return leaf_boxes, links
        counts = jnp.array([[n_nodes, len(leaves)]], jnp.int32)
        tables = counts, jnp.asarray(ranges), leaf_boxes[:, leaves].reshape(-1, 6)
        boxes, _ = self._map_indices(node_box, n_worlds * n_nodes, tables)
        return jnp.stack(boxes, axis=-1).reshape(n_worlds, n_nodes, 6), links

    def run(
        self, fn: Callable[..., Any], n: int, tables: Sequence[Array], targets: Targets
    ) -> tuple[list[Array], str | None]:
        """Return the results of a function of one ray for ``n`` rays, and the platform of its kernel; None for XLA."""
        hits, platform = self._map_indices(fn, n, tables)
        has_objects = any(target.carrier == "object" for target in targets.movable_geoms)
        method = "XLA, without a kernel" if platform is None else "one kernel with a lane for each ray"
        n_fixed, n_movable = len(targets.fixed_geoms), len(targets.movable_geoms)
        counts = f"{n_fixed} fixed geoms in a hierarchy, {n_movable} movable geoms in another"
        advice = ", which cost more: mocap=False makes them fixed" if has_objects else ""
        self.last_used = f"{method}; {counts}{advice}"
        return hits, platform

    def _map_indices(self, fn: Callable[..., Any], n: int, tables: Sequence[Array]) -> tuple[list[Array], str | None]:
        if self.platform is not None and self.mesh is None:
            try:
                return map_indices(fn, n, tables, self.platform), self.platform
            except UnsupportedError as error:
                problem, remedy = f"rays have no kernel: {error.reason}", "Leave out the geoms that need it"
                report_unsupported([problem], self.strict, self.reported_warnings, remedy)
        return map_indices(fn, n, tables, None), None


@jax.custom_jvp
def _replace_derivative(value: Array, differentiable: Array) -> Array:
    del differentiable
    return value


@_replace_derivative.defjvp
def _(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    return primals[0], tangents[1]
