"""The first geom that a ray meets: a function of one ray, for kernels of all rays and for stages of a step.

Geoms that do not move are in a hierarchy of boxes. For kernels of all rays, geoms of movable bodies and drones are in a
second hierarchy; its boxes are computed for each world.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import DTypeLike

from crazysim import rotation
from crazysim.core.branches import any_lane, compute_where, table_rows
from crazysim.core.data import SimData, grid_2d
from crazysim.geometry import Shape
from crazysim.geometry.fieldrays import MIN_COMPONENT, field_ray
from crazysim.geometry.points import Components, components
from crazysim.geometry.rays import Interval, SizedShapes, first_distance, hit_distance, hit_normal
from crazysim.geometry.shapes import N_SIZES, bounding_box
from crazysim.scene import hierarchy
from crazysim.scene.collision import CollisionGeom, CollisionModel

IGNORES_NONE, NOT_A_DRONE = -1, -2
"""Drone index of rays that pass through no drone, and drone index of geoms that are not part of a drone."""

DRONE_OFFSET = 1e4
"""Offset of the drones from the objects while the hierarchy of movable geoms is built, m. Drones then form a separate
branch."""

Surface = Shape | str
"""Shape of a mesh or height field; for other shapes only the kind, since kind and size describe them."""


@dataclasses.dataclass(frozen=True)
class Target:
    """A geom that rays can meet."""

    geom: CollisionGeom
    """The geom, in the frame of its body."""
    carrier: Literal["world", "object", "drone"]
    """Kind of the body; geoms of the world do not move."""
    row: int
    """Row of the body among the objects or drones."""
    body_index: int
    """Index of the body, as in ``Hits.body_index``."""
    initial_pos: tuple[float, ...] = (0.0, 0.0, 0.0)
    """Position of an object in the compiled scene, m. (3,)"""
    map_index: int = -1
    """Index of the map to which the geom belongs; -1 for geoms of all worlds."""

    @property
    def surface(self) -> Surface:
        """Kind of the shape, or the shape itself if kind and size do not describe it."""
        shape = self.geom.shape
        return shape if shape.kind in ("mesh", "hfield") else shape.kind

    def table_row(self, pos: np.ndarray) -> np.ndarray:
        """Return the geom's row in a table: position, a zero, rotation matrix by rows, size in three numbers. (16,)

        Args:
            pos: Position, m. (3,)
        """
        rot = np.eye(3) if self.geom.rot is None else np.array(self.geom.rot)
        size = np.zeros(3)
        if not isinstance(self.surface, Shape):
            size[: len(self.geom.shape.size)] = self.geom.shape.size
        return np.concatenate([pos, [0.0], rot.reshape(-1), size])


class Hierarchy(NamedTuple):
    """Hierarchies of the geoms that do not move, one for each map, as tables in memory.

    Nodes are in the orders of ``build_hierarchies``. A scene without maps has one hierarchy.
    """

    codes: Array
    """Index of the surface of each geom, and index of its drone or ``NOT_A_DRONE``. (n, 2)"""
    boxes: Array
    """Boxes of the nodes, one order after the other. (8 * n_nodes, 6)"""
    links: Array
    """Index of the node after the subtree of each node, and its geom or -1. (8 * n_nodes, 2)"""
    fixed_geoms: Array
    """Geoms, world frame; see ``Target.table_row``. (n_fixed, 16)"""
    ranges: Array
    """First node, and number of nodes, of the hierarchy of each map. (n_maps, 2)"""


class Tables(NamedTuple):
    """Everything that rays of all worlds need, as tables in memory."""

    counts: Array
    """Numbers of fixed nodes per order, of fixed geoms, of movable geoms, and of movable nodes per order. (1, 4) With
    maps, the same for each world, then first node and number of nodes of its hierarchy. (n_worlds, 6)"""
    codes: Array
    """As in ``Hierarchy``, of fixed and then movable geoms. (n, 2)"""
    boxes: Array
    """As in ``Hierarchy``, of the fixed geoms. (8 * n_nodes, 6)"""
    links: Array
    """As in ``Hierarchy``. (8 * n_nodes, 2)"""
    fixed_geoms: Array
    """As in ``Hierarchy``. (n_fixed, 16)"""
    movable_boxes: Array
    """Boxes of the nodes of the movable geoms in every world, in the first order. (n_worlds * n_movable_nodes, 6)"""
    movable_links: Array
    """As ``links``, then the index of the node in the first order. (8 * n_movable_nodes, 3)"""
    movable_geoms: Array
    """Movable geoms, world frame. (n_worlds * n_movable, 16)"""
    camera_poses: Array
    """Position of each camera, m, and the matrix with its axes as columns, row by row. (n_worlds * n_cameras, 12)"""
    pixels: Array
    """Direction of each ray in the frame of its camera, and ``Ray.ignored_drone``. (n_cameras * n_pixels, 4)"""


class Targets:
    """Geoms that rays can meet, and their tables."""

    def __init__(self, model: CollisionModel, n_drones: int, drones: bool, ignored_drone: int = IGNORES_NONE):
        targets = [Target(geom, "world", 0, 0) for geom in model.floor]
        for index, body in enumerate(model.objects, start=1):
            carrier = "world" if body.row is None else "object"
            maps = body.maps or [-1] * len(body.geoms)
            targets += [
                Target(geom, carrier, body.row or 0, index, body.initial_pos, map_index)
                for geom, map_index in zip(body.geoms, maps, strict=True)
            ]
        for drone_geoms in model.drones if drones else ():
            for row in range(n_drones) if drone_geoms.drones is None else drone_geoms.drones:
                if row != ignored_drone:
                    targets += [Target(geom, "drone", row, 1 + len(model.objects) + row) for geom in drone_geoms.geoms]
        self.fixed_geoms = [x for x in targets if x.carrier == "world"]
        """Geoms that do not move."""
        self.movable_geoms = [x for carrier in ("object", "drone") for x in targets if x.carrier == carrier]
        """Geoms of movable objects, then geoms of drones."""
        self.all_geoms = [*self.fixed_geoms, *self.movable_geoms]
        """All geoms, in the order of their indices."""
        self.n_maps = max((body.n_maps for body in model.objects), default=0)
        """Number of maps, of which each world has one; 0 without maps."""
        self.surfaces: tuple[Surface, ...] = tuple(dict.fromkeys(x.surface for x in self.all_geoms))
        """Distinct surfaces of the geoms."""
        owners = [x.row if x.carrier == "drone" else NOT_A_DRONE for x in self.all_geoms]
        codes = [(self.surfaces.index(x.surface), owner) for x, owner in zip(self.all_geoms, owners, strict=True)]
        self.codes = np.array(codes, np.int32).reshape(-1, 2)
        """Index of the surface of each geom, and index of its drone or ``NOT_A_DRONE``. (n, 2)"""

    def build_fixed_hierarchy(self, dtype: DTypeLike) -> Hierarchy:
        """Return the hierarchy of the fixed geoms; see ``build_hierarchy``."""
        low, high = np.zeros((2, len(self.fixed_geoms), 3))
        for k, target in enumerate(self.fixed_geoms):
            rot = np.eye(3) if target.geom.rot is None else np.array(target.geom.rot)
            middle, half = bounding_box(target.geom.shape)
            middle, half = np.array(target.geom.pos) + rot @ middle, np.abs(rot) @ half
            low[k], high[k] = middle - half, middle + half
        map_index = np.array([x.map_index for x in self.fixed_geoms], int)
        groups = [np.flatnonzero((map_index == k) | (map_index < 0)) for k in range(max(self.n_maps, 1))]
        *tables, ranges = hierarchy.build_hierarchies(low, high, groups)
        boxes, links = (x.reshape(-1, x.shape[-1]) for x in tables)
        geoms = np.array([x.table_row(np.array(x.geom.pos)) for x in self.fixed_geoms]).reshape(-1, 16)
        codes = self.codes[: len(self.fixed_geoms)]
        arrays = codes, np.asarray(boxes, dtype), links, np.asarray(geoms, dtype), ranges
        return Hierarchy(*map(jnp.asarray, arrays))

    def movable_nodes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the nodes of the hierarchy of movable geoms, built from their positions in the compiled scene.

        Returns:
            Index of the first leaf of each node, and index after its last leaf, in the first order. (n_nodes, 2)
            Index of each leaf's geom among the movable geoms, in the first order. (n_movable,)
            As in ``Tables.movable_links``. (8, n_nodes, 3)
        """
        low, high = np.zeros((2, len(self.movable_geoms), 3))
        drone_pos = np.pad(grid_2d(1 + max([x.row for x in self.movable_geoms], default=0)), ((0, 0), (0, 1)))
        for k, target in enumerate(self.movable_geoms):
            pos = drone_pos[target.row] + DRONE_OFFSET if target.carrier == "drone" else np.array(target.initial_pos)
            middle, half = pos + np.array(target.geom.pos), bounding_box(target.geom.shape)[1]
            low[k], high[k] = middle - half, middle + half
        _, links = hierarchy.build_hierarchy(low, high)
        geoms = links[0, :, 1]
        leaves_before = np.concatenate([[0], np.cumsum(geoms >= 0)])
        ranges = np.stack([leaves_before[:-1], leaves_before[links[0, :, 0]]], axis=-1)
        # The set of its leaves, which is the same in all orders, identifies a node.
        node_by_leaves = {_leaf_set(links[0], k): k for k in range(len(geoms))}
        indices = np.array(
            [[node_by_leaves[_leaf_set(order, k)] for k in range(len(geoms))] for order in links], np.int32
        )
        return ranges.astype(np.int32), geoms[geoms >= 0], np.concatenate([links, indices[..., None]], axis=-1)

    def movable_rows(self, data: SimData) -> tuple[Array, Array]:
        """Return boxes around the movable geoms, and the rows of these geoms, world frame.

        Returns:
            Lower and upper corners, m. (n_worlds, n_movable, 6)
            Rows of the geoms; see ``Target.table_row``. (n_worlds, n_movable, 16)
        """
        states, dtype = data.states, data.states.pos.dtype
        n_worlds = states.pos.shape[0]
        boxes, geoms = [jnp.zeros((n_worlds, 0, 6), dtype)], [jnp.zeros((n_worlds, 0, 16), dtype)]
        for carrier in ("object", "drone"):
            targets = [x for x in self.movable_geoms if x.carrier == carrier]
            if not targets:
                continue
            if carrier == "object" and data.objects is not None:
                poses = data.objects.pos[:, 0], data.objects.quat[:, 0]
            else:
                poses = states.pos, states.quat
            pos, quat = (x[:, np.array([t.row for t in targets])] for x in poses)
            rows = np.array([t.table_row(np.array(t.geom.pos)) for t in targets])
            rot = rows[:, 4:13].reshape(-1, 3, 3)
            local_middle, half = (np.array(x) for x in zip(*(bounding_box(t.geom.shape) for t in targets), strict=True))
            geom_pos = pos + rotation.rotate(quat, jnp.asarray(rows[:, :3], dtype))
            axes = jnp.stack([rotation.rotate(quat, jnp.asarray(rot[:, :, k], dtype)) for k in range(3)], axis=-1)
            local_middle, half = (jnp.asarray(x, dtype)[:, None] for x in (local_middle, half))
            middle = geom_pos + jnp.sum(axes * local_middle, axis=-1)
            aligned_half = jnp.sum(jnp.abs(axes) * half, axis=-1)
            aligned_half = aligned_half + hierarchy.BOX_PADDING + 4 * jnp.finfo(dtype).eps * jnp.abs(middle)
            boxes.append(jnp.concatenate([middle - aligned_half, middle + aligned_half], axis=-1))
            size = jnp.broadcast_to(jnp.asarray(rows[:, 13:], dtype), (*geom_pos.shape[:2], 3))
            zero = jnp.zeros_like(geom_pos[..., :1])
            geoms.append(jnp.concatenate([geom_pos, zero, axes.reshape(*geom_pos.shape[:2], 9), size], axis=-1))
        return jnp.concatenate(boxes, axis=1), jnp.concatenate(geoms, axis=1)

    def tables(
        self,
        boxes: Array,
        links: np.ndarray,
        geoms: Array,
        camera_poses: Array,
        pixels: Array,
        map_index: Array | None,
    ) -> Tables:
        """Return the tables of rays of all worlds.

        Args:
            boxes: Boxes of the nodes of the movable geoms in every world. (n_worlds, n_nodes, 6)
            links: From ``movable_nodes``.
            geoms: From ``movable_rows``.
            camera_poses: As in ``Tables``. (n_worlds, n_cameras, 12)
            pixels: Directions in the frame of the camera, and ``Ray.ignored_drone``. (n_cameras, n_pixels, 4)
            map_index: ``Objects.map_index``; None without maps. (n_worlds, 1)
        """
        fixed_hierarchy = self.build_fixed_hierarchy(camera_poses.dtype)
        n_nodes = len(fixed_hierarchy.boxes) // hierarchy.N_ORDERS
        counts = np.array([[n_nodes, len(self.fixed_geoms), len(self.movable_geoms), links.shape[1]]], np.int32)
        if map_index is not None:
            ranges = fixed_hierarchy.ranges[map_index[:, 0]]
            counts = jnp.concatenate([jnp.broadcast_to(counts, (len(ranges), 4)), ranges], axis=-1)
        tables = (
            jnp.asarray(counts), jnp.asarray(self.codes), *fixed_hierarchy[1:4], boxes, jnp.asarray(links), geoms,
            camera_poses, pixels,
        )  # fmt: skip
        # Empty tables get a row of zeros, since an array without rows has no memory.
        flat_tables = [x.reshape(-1, x.shape[-1]) for x in tables]
        return Tables(*(x if x.shape[0] else jnp.zeros((1, x.shape[1]), x.dtype) for x in flat_tables))


def _leaf_set(links: np.ndarray, node: int) -> frozenset[int]:
    geoms = links[node : links[node, 0], 1]
    return frozenset(geoms[geoms >= 0].tolist())


def node_box(index: Array, counts: Array, ranges: Array, leaf_boxes: Array) -> list[Array]:
    """Return the box around the leaves of a node in one world: six coordinates of lower and upper corner. () each

    Args:
        index: Index of the node; nodes of the first world come first. ()
        counts: Number of nodes and number of leaves of a world. (1, 2)
        ranges: Index of the first leaf of each node, and index after its last leaf. (n_nodes, 2)
        leaf_boxes: Boxes of the leaves of every world. (n_worlds * n_leaves, 6)
    """
    n_nodes, n_leaves = table_rows(counts, jnp.int32(0))
    world = lax.div(index, n_nodes)
    first_leaf, end_leaf = table_rows(ranges, index - world * n_nodes)

    def include_leaf(carry: tuple[Array, list[Array]]) -> tuple[Array, list[Array]]:
        leaf, box = carry
        box_of_leaf = table_rows(leaf_boxes, world * n_leaves + leaf)
        low = [_minimum(a, b) for a, b in zip(box[:3], box_of_leaf[:3], strict=True)]
        high = [_maximum(a, b) for a, b in zip(box[3:], box_of_leaf[3:], strict=True)]
        return leaf + 1, [*low, *high]

    infinite = jnp.asarray(jnp.inf, leaf_boxes.dtype)
    return lax.while_loop(
        lambda carry: carry[0] < end_leaf, include_leaf, (first_leaf, [infinite] * 3 + [-infinite] * 3)
    )[1]


class Ray(NamedTuple):
    """A ray in one world."""

    origin: Components
    """Origin, world frame, m."""
    direction: Components
    """Unit direction, world frame."""
    ignored_drone: Array
    """Index of the drone that the ray passes through, or ``IGNORES_NONE``."""


BestHit = tuple[Array, Array]
"""Distance to the nearest geom so far, m, and its index; infinite and -1 if there is none."""


def first_hit(surfaces: Sequence[Surface], n_pixels: int, n_cameras: int, index: Array, *tables: Array) -> BestHit:
    """Return the distance to the first geom that a ray meets, and the index of the geom; see ``Targets.all_geoms``.

    If several geoms are at the same distance, the lowest index is returned.

    Args:
        surfaces: ``Targets.surfaces``.
        n_pixels: Number of rays of a camera.
        n_cameras: Number of cameras of a world.
        index: Index of the ray; pixels of the first camera of the first world come first. ()
        *tables: Fields of ``Tables``.
    """
    t = Tables(*tables)
    world, ray = camera_ray(t, n_pixels, n_cameras, index)
    counts = counts_in_world(t, world)
    return first_hit_of_ray(surfaces, t, counts, world, ray, jnp.full_like(ray.origin[0], jnp.inf))


def first_hit_of_ray(
    surfaces: Sequence[Surface], t: Tables, counts: Sequence[Array], world: Array, ray: Ray, limit: Array
) -> BestHit:
    """Return the distance to the first geom that any ray in a world meets, and its index; see ``first_hit``.

    Args:
        surfaces: ``Targets.surfaces``.
        t: Geoms of all worlds.
        counts: From ``counts_in_world``.
        world: Index of the world. ()
        ray: The ray.
        limit: Distance beyond which nothing is met, m. ()
    """
    n_nodes, n_fixed, n_movable, n_movable_nodes, *map_range = counts
    best = limit, jnp.int32(-1)
    best = first_fixed_hit(surfaces, t, ray, best, n_nodes, map_range or (0, n_nodes))

    def read_node(k: Array) -> tuple[Sequence[Array], Array, Array]:
        next_node, geom, first_order = table_rows(t.movable_links, k)
        return table_rows(t.movable_boxes, world * n_movable_nodes + first_order), next_node, geom

    def hit_geom(k: Array, is_near: Array, best: BestHit) -> BestHit:
        code, owner = table_rows(t.codes, n_fixed + k)
        is_near = is_near & (owner != ray.ignored_drone)
        row = table_rows(t.movable_geoms, world * n_movable + k)
        return _nearer_hit(surfaces, code, n_fixed + k, row, ray, is_near, best)

    return _walk_hierarchy(read_node, hit_geom, ray, best, n_movable_nodes, 0, n_movable_nodes)


def counts_in_world(t: Tables, world: Array) -> list[Array]:
    """Return the row of ``Tables.counts`` that concerns a world."""
    return table_rows(t.counts, world if t.counts.shape[1] > 4 else jnp.int32(0))


def camera_ray(t: Tables, n_pixels: int, n_cameras: int, index: Array) -> tuple[Array, Ray]:
    camera_number = lax.div(index, jnp.int32(n_pixels))
    world = lax.div(camera_number, jnp.int32(n_cameras))
    camera, pixel = camera_number - world * n_cameras, index - camera_number * n_pixels
    pose = table_rows(t.camera_poses, camera_number)
    *direction, ignored_drone = table_rows(t.pixels, camera * n_pixels + pixel)
    x, y, z = (pose[k] * direction[0] + pose[k + 1] * direction[1] + pose[k + 2] * direction[2] for k in (3, 6, 9))
    return world, Ray((pose[0], pose[1], pose[2]), (x, y, z), ignored_drone.astype(jnp.int32))


def normal_at_hit(
    surfaces: Sequence[Surface], n_pixels: int, n_cameras: int, index: Array, *tables: Array
) -> Components:
    """Return the unit normal where a ray meets its first geom, world frame; zero if it meets nothing.

    For the arguments see ``surface_at_hit``.
    """

    def normal_in_world_frame(surface: Surface, row: Sequence[Array], *ray: Any) -> Components:
        return world_vector(row, normal_in_frame(surface, row, *ray))

    return surface_at_hit(normal_in_world_frame, 3, surfaces, n_pixels, n_cameras, index, *tables)


def world_vector(row: Sequence[Array], vector: Components) -> Components:
    """Return a vector in the frame of the geom with the given row in the world frame; see ``Target.table_row``."""
    a, b, c = vector
    x, y, z = (row[i] * a + row[i + 1] * b + row[i + 2] * c for i in (4, 7, 10))
    return x, y, z


def surface_at_hit(
    describe: Callable[..., Any],
    n_results: int,
    surfaces: Sequence[Surface],
    n_pixels: int,
    n_cameras: int,
    index: Array,
    *tables: Array,
) -> Any:
    """Return ``describe(surface, row, origin, direction, distance)`` of the first geom that a ray meets, or zeros.

    Args:
        describe: Function of a surface, of the row of its geom, and of a ray in the frame of the geom.
        n_results: Number of its results.
        surfaces: ``Targets.surfaces``.
        n_pixels: Number of rays of a camera.
        n_cameras: Number of cameras of a world.
        index: Index of the ray, as in ``first_hit``. ()
        *tables: Fields of ``Tables``, then the two results of ``first_hit`` for all rays. (n_rays, 1) each
    """
    t, (distances, geoms) = Tables(*tables[:-2]), tables[-2:]
    world, ray = camera_ray(t, n_pixels, n_cameras, index)
    _, n_fixed, n_movable, *_ = counts_in_world(t, world)
    (distance,), (geom,) = table_rows(distances, index), table_rows(geoms, index)
    code, _ = table_rows(t.codes, _maximum(geom, jnp.int32(0)))

    def describe_row(row: Sequence[Array], results: Any) -> Any:
        local_origin, local_direction = ray_in_frame(row, ray.origin, ray.direction)
        for k, surface in enumerate(surfaces):

            def describe_surface(_: Any, surface: Surface = surface) -> Any:
                return describe(surface, row, local_origin, local_direction, distance)

            results = (
                compute_where(code == k, describe_surface, results) if len(surfaces) > 1 else describe_surface(results)
            )
        return results

    def describe_fixed_geom(results: Any) -> Any:
        return describe_row(table_rows(t.fixed_geoms, fixed_row), results)

    def describe_movable_geom(results: Any) -> Any:
        return describe_row(table_rows(t.movable_geoms, world * n_movable + movable_row), results)

    # Lanes that a branch does not concern read rows in it, too, which must exist.
    fixed_row = _maximum(_minimum(geom, n_fixed - 1), jnp.int32(0))
    movable_row = _maximum(geom - n_fixed, jnp.int32(0))
    zeros = (jnp.zeros_like(distance),) * n_results
    results = compute_where((geom >= 0) & (geom < n_fixed), describe_fixed_geom, zeros)
    return compute_where(geom >= n_fixed, describe_movable_geom, results)


def normal_in_frame(
    surface: Surface, row: Sequence[Array], origin: Components, direction: Components, distance: Array
) -> Components:
    if isinstance(surface, Shape) and surface.kind == "hfield":
        return components(field_ray(surface, jnp.stack(origin), jnp.stack(direction))[1])
    if isinstance(surface, Shape):
        return _mesh_normal(surface, *(s + distance * a for s, a in zip(origin, direction, strict=True)))
    return components(hit_normal(geom_shape(surface, row), jnp.stack(origin), jnp.stack(direction), distance))


def _mesh_normal(shape: Shape, x: Array, y: Array, z: Array) -> Components:
    planes = jnp.asarray(np.column_stack([shape.array("normals"), shape.array("offsets")]), x.dtype)

    def compare_plane(carry: tuple[Array, Array, Components], _: None) -> tuple[tuple[Array, Array, Components], None]:
        k, max_distance, normal = carry
        a, b, c, offset = table_rows(planes, k)
        plane_distance = a * x + b * y + c * z - offset
        is_nearer = plane_distance > max_distance
        u, v, w = (jnp.where(is_nearer, new, old) for new, old in zip((a, b, c), normal, strict=True))
        return (k + 1, jnp.where(is_nearer, plane_distance, max_distance), (u, v, w)), None

    zero = jnp.zeros_like(x)
    initial = jnp.int32(0), jnp.full_like(x, -jnp.inf), (zero, zero, zero)
    return lax.scan(compare_plane, initial, length=len(planes))[0][2]


def first_fixed_hit(
    surfaces: Sequence[Surface],
    tables: Hierarchy | Tables,
    ray: Ray,
    best: BestHit,
    n_nodes: Array | int,
    map_range: Sequence[Array | int],
    is_packet: bool = True,
) -> BestHit:
    """Return the best hit so far, or a nearer hit of a fixed geom.

    Args:
        surfaces: ``Targets.surfaces``.
        tables: The fixed geoms.
        n_nodes: Number of nodes in one order of all hierarchies.
        map_range: First node, and number of nodes, of the hierarchy of the ray's world.
        is_packet: Whether rays that are computed together mostly meet the same boxes, as neighbours in an image.
    """
    first_node, n_nodes_of_map = map_range

    def read_node(k: Array) -> tuple[Sequence[Array], Array, Array]:
        next_node, geom = table_rows(tables.links, k)
        return table_rows(tables.boxes, k), next_node, geom

    def hit_geom(geom: Array, is_crossing: Array, best: BestHit) -> BestHit:
        code, _ = table_rows(tables.codes, geom)
        return _nearer_hit(surfaces, code, geom, table_rows(tables.fixed_geoms, geom), ray, is_crossing, best)

    return _walk_hierarchy(read_node, hit_geom, ray, best, n_nodes, first_node, n_nodes_of_map, is_packet)


def _walk_hierarchy(
    read_node: Callable[[Array], tuple[Sequence[Array], Array, Array]],
    hit_geom: Callable[[Array, Array, BestHit], BestHit],
    ray: Ray,
    best: BestHit,
    nodes_per_order: Array | int,
    first_node: Array | int,
    n_nodes: Array | int,
    is_packet: bool = True,
) -> BestHit:
    meets_any = any_lane if is_packet else lambda condition: condition
    inverse = [1 / jnp.where(jnp.abs(d) < MIN_COMPONENT, MIN_COMPONENT, d) for d in ray.direction]
    scaled = [o * i for o, i in zip(ray.origin, inverse, strict=True)]
    are_negative = [meets_any(d < 0) for d in ray.direction]
    order = sum(jnp.where(is_negative, jnp.int32(1 << k), 0) for k, is_negative in enumerate(are_negative))
    first_node = order * nodes_per_order + first_node

    def check_node(carry: tuple[Array, BestHit]) -> tuple[Array, BestHit]:
        node, best = carry
        # Lanes that have ended, or are at no leaf, read rows, too, which must exist.
        box, next_node, geom = read_node(_minimum(first_node + node, hierarchy.N_ORDERS * nodes_per_order - 1))
        meets_box = _meets_box(box[:3], box[3:], scaled, inverse, best[0])

        leaf_geom = _maximum(geom, jnp.int32(0))

        def descend(carry: tuple[Array, BestHit]) -> tuple[Array, BestHit]:
            return node + 1, compute_where(geom >= 0, lambda best: hit_geom(leaf_geom, meets_box, best), carry[1])

        return compute_where(meets_any(meets_box), descend, (next_node, best))

    return lax.while_loop(lambda carry: carry[0] < n_nodes, check_node, (jnp.int32(0), best))[1]


def _maximum(a: Array, b: Array) -> Array:
    return jnp.where(a < b, b, a)


def _minimum(a: Array, b: Array | int) -> Array:
    return jnp.where(a > b, b, a)


def _meets_box(
    low: Sequence[Array],
    high: Sequence[Array],
    scaled_origin: Sequence[Array],
    inverse_direction: Sequence[Array],
    best_distance: Array,
) -> Array:
    ends = [(a * i - s, b * i - s) for a, b, s, i in zip(low, high, scaled_origin, inverse_direction, strict=True)]
    x, y, z = (_minimum(*pair) for pair in ends)
    near = _maximum(_maximum(x, y), z)
    x, y, z = (_maximum(*pair) for pair in ends)
    far = _minimum(_minimum(x, y), z)
    return (near <= far) & (far >= 0) & (near <= best_distance)


def _nearer_hit(
    surfaces: Sequence[Surface], code: Array, geom: Array, row: Sequence[Array], ray: Ray, is_near: Array, best: BestHit
) -> BestHit:
    local_origin, local_direction = ray_in_frame(row, ray.origin, ray.direction)
    for surface_index, surface in enumerate(surfaces):

        def hit_surface(best: BestHit, surface: Surface = surface) -> BestHit:
            distance = _ray_length(surface, row, local_origin, local_direction)
            is_closer = is_near & ((distance < best[0]) | ((distance == best[0]) & (geom < best[1])))
            return jnp.where(is_closer, distance, best[0]), jnp.where(is_closer, geom, best[1])

        best = compute_where(code == surface_index, hit_surface, best) if len(surfaces) > 1 else hit_surface(best)
    return best


def ray_in_frame(row: Sequence[Array], origin: Components, direction: Components) -> tuple[Components, Components]:
    """Return a ray in the frame of the geom with the given row; see ``Target.table_row``."""
    offset = [o - p for o, p in zip(origin, row, strict=False)]
    local_origin, local_direction = (
        tuple(sum(row[4 + 3 * i + k] * v[i] for i in range(3)) for k in range(3)) for v in (offset, direction)
    )
    return local_origin, local_direction  # type: ignore[return-value]


def geom_shape(surface: Surface, row: Sequence[Array]) -> Shape | SizedShapes:
    """Return the shape of the geom with the given row; see ``Target.table_row``."""
    return SizedShapes(surface, row[13 : 13 + N_SIZES[surface]]) if isinstance(surface, str) else surface


def _ray_length(surface: Surface, row: Sequence[Array], origin: Components, direction: Components) -> Array:
    if isinstance(surface, str):
        return hit_distance(geom_shape(surface, row), origin, direction)
    if surface.kind == "hfield":
        return field_ray(surface, jnp.stack(origin), jnp.stack(direction))[0]
    return _mesh_ray_length(surface, origin, direction)


def _mesh_ray_length(shape: Shape, origin: Components, direction: Components) -> Array:
    planes = jnp.asarray(np.column_stack([shape.array("normals"), shape.array("offsets")]), origin[0].dtype)

    def cut_by_plane(carry: tuple[Array, Interval], _: None) -> tuple[tuple[Array, Interval], None]:
        k, (near, far, is_crossing) = carry
        x, y, z, offset = table_rows(planes, k)
        depth = offset - (x * origin[0] + y * origin[1] + z * origin[2])
        rate = x * direction[0] + y * direction[1] + z * direction[2]
        is_parallel = jnp.abs(rate) < MIN_COMPONENT
        t = depth / jnp.where(is_parallel, 1.0, rate)
        near = jnp.where(~is_parallel & (rate < 0) & (t > near), t, near)
        far = jnp.where(~is_parallel & (rate > 0) & (t < far), t, far)
        return (k + 1, (near, far, is_crossing & ~(is_parallel & (depth < 0)))), None

    infinite = jnp.full_like(origin[0], jnp.inf)
    initial = jnp.int32(0), (-infinite, infinite, infinite > 0)
    (_, (near, far, is_crossing)), _ = lax.scan(cut_by_plane, initial, length=len(planes))
    return first_distance((near, far, is_crossing & (near <= far)))
