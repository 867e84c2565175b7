"""The scene of a page: batches of meshes of a viser server, whose poses are sent once per picture."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.media.picture import WIND_COLOR, WIND_RADIUS, Picture, Spheres
from crazysim.media.trail import MIN_ALPHA, choose_drone_colors
from crazysim.scene.visual_geoms import VisualGeom

PLANE_HALF_SIZE = 20.0
"""Half size of infinite planes, m."""
HIDDEN_SCALE = 1e-6
"""Scale of a sphere that is not shown."""
FLOOR_GREY = 0.8
"""Grey that trails fade to, 0 to 1."""
NO_TURN = (1, 0, 0, 0)
"""Quaternion of a body whose attitude is not finite, wxyz."""


class BrowserScene:
    """Nodes of one viser server that show some worlds, side by side in a grid, at first as in a picture."""

    def __init__(self, server: Any, shapes: list[VisualGeom], picture: Picture, spacing: float = 0.0):
        self._scene = scene = server.scene
        self.offsets = grid_offsets(len(picture.worlds), spacing)
        self._root = scene.add_frame("/world", show_axes=False)
        self._label = scene.add_label("/world/name", "", anchor="bottom-center", visible=False)
        self._handles: dict[str, Any] = {}
        self._sent_values: dict[tuple[str, str], NDArray] = {}
        fixed_shapes: dict[tuple, list[VisualGeom]] = defaultdict(list)
        shapes_by_body: dict[int, list[VisualGeom]] = defaultdict(list)
        for shape in shapes:
            if shape.mocap < 0:
                is_infinite = shape.kind == "plane" and not shape.size[:2].any()
                fixed_shapes[is_infinite, _color_key(shape)].append(shape)
            elif shape.kind != "plane":
                shapes_by_body[shape.mocap].append(shape)
        for k, ((is_infinite, rgba), same_color_shapes) in enumerate(fixed_shapes.items()):
            for w, offset in enumerate(np.zeros((1, 3)) if is_infinite else self.offsets):
                node = scene.add_frame(f"/world/fixed/{w}/{k}", position=offset, show_axes=False)
                _add_geoms(scene, node.name, same_color_shapes, rgba)
        self._batches: list[tuple[Any, NDArray]] = []
        for equal_bodies in _group_equal_bodies(shapes_by_body):
            self._add_bodies(np.array(equal_bodies), shapes_by_body[equal_bodies[0]], picture)
        self.update(picture)

    def update(self, picture: Picture, follow: bool = False) -> None:
        """Show a picture. Bodies whose poses are not finite stay where they were.

        Args:
            follow: Whether to keep the followed body in the middle: the worlds move, and the camera stays.
        """
        pos, quat = self._to_grid(picture.pos), np.roll(picture.quat, 1, axis=-1)
        for handle, bodies in self._batches:
            self._send(handle, "batched_positions", pos[:, bodies].reshape(-1, 3))
            self._send(handle, "batched_wxyzs", quat[:, bodies].reshape(-1, 4))
        for name, spheres in picture.spheres.items():
            self._show_spheres(name, spheres)
        if picture.wind.size:
            self._show_wind(picture.wind + self.offsets[:, None, None])
        if len(picture.trail) > 1:
            self._show_trails(picture.trail + self.offsets[:, None])
        focus, center = picture.focus, np.zeros(3)
        self._label.visible = focus is not None
        if focus is not None:
            pos = finite_rows(focus.pos + self.offsets[focus.shown_index])
            self._label.position, self._label.text = pos + [0.0, 0.0, focus.radius], focus.name
            center = pos if follow else center
        self._root.position = -center

    @property
    def origin(self) -> NDArray:
        """Position of the origin of the grid, which moves with a followed body, m. (3,)"""
        return np.asarray(self._root.position, float)

    def _send(self, handle: Any, name: str, values: NDArray) -> None:
        # Values that have not changed are not sent again, and values that are not finite never.
        last_values = self._sent_values.get((handle.name, name))
        if last_values is not None:
            values = np.where(np.isfinite(values), values, last_values)
        if last_values is None or not np.array_equal(values, last_values):
            self._sent_values[handle.name, name] = values
            setattr(handle, name, np.nan_to_num(values))

    def _add_bodies(self, bodies: NDArray, shapes: list[VisualGeom], picture: Picture) -> None:
        shapes_by_color: dict[tuple, list[VisualGeom]] = defaultdict(list)
        for shape in shapes:
            shapes_by_color[_color_key(shape)].append(shape)
        pos = finite_rows(self._to_grid(picture.pos)[:, bodies].reshape(-1, 3))
        quat = finite_rows(np.roll(picture.quat[:, bodies], 1, axis=-1).reshape(-1, 4), NO_TURN)
        for k, (rgba, same_color_shapes) in enumerate(shapes_by_color.items()):
            handle = self._scene.add_batched_meshes_simple(
                f"/world/bodies/{bodies[0]}/{k}", *_create_mesh(same_color_shapes), quat, pos,
                batched_colors=rgb(rgba), opacity=_opacity(rgba), lod="off", flat_shading=True, side="double",
            )  # fmt: skip
            self._sent_values[handle.name, "batched_positions"] = pos
            self._sent_values[handle.name, "batched_wxyzs"] = quat
            self._batches.append((handle, bodies))

    def _show_spheres(self, name: str, spheres: Spheres) -> None:
        is_shown = spheres.is_shown.ravel()
        if is_shown.size and name not in self._handles:
            import trimesh

            sphere, n = trimesh.creation.icosphere(subdivisions=2), len(is_shown)
            self._handles[name] = self._scene.add_batched_meshes_simple(
                f"/world/{name}", np.asarray(sphere.vertices, np.float32), np.asarray(sphere.faces, np.uint32),
                np.tile(NO_TURN, (n, 1)), np.zeros((n, 3)), batched_colors=np.zeros((n, 3), np.uint8),
                opacity=_opacity(spheres.rgba[0, 0]), lod="off",
            )  # fmt: skip
        if name in self._handles:
            handle = self._handles[name]
            scales = np.where(is_shown, spheres.radius, HIDDEN_SCALE).astype(np.float32)
            self._send(handle, "batched_scales", scales)
            if is_shown.any():
                self._send(handle, "batched_colors", _to_bytes(spheres.rgba[..., :3].reshape(-1, 3)))
                self._send(handle, "batched_positions", self._to_grid(spheres.pos).reshape(-1, 3))

    def _show_wind(self, arrows: NDArray) -> None:
        points = arrows.reshape(-1, 2, 3).astype(np.float32)
        if "wind" not in self._handles:
            self._handles["wind"] = self._scene.add_arrows(
                "/world/wind", finite_rows(points), rgb(WIND_COLOR), shaft_radius=WIND_RADIUS, head_radius=0.015,
                head_length=0.04,
            )  # fmt: skip
        self._send(self._handles["wind"], "points", points)

    def _show_trails(self, path: NDArray) -> None:
        points = np.stack([path[:-1], path[1:]], axis=3).reshape(-1, 2, 3).astype(np.float32)
        if "trails" not in self._handles:
            # Lines are opaque, so they fade to the grey of the floor.
            fade = np.linspace(MIN_ALPHA, 1.0, len(path) - 1)[:, None, None]
            colors = np.tile(choose_drone_colors(path.shape[2], None)[:, :3], (path.shape[1], 1))
            shades = _to_bytes(FLOOR_GREY - fade * (FLOOR_GREY - colors)).reshape(-1, 1, 3)
            self._handles["trails"] = self._scene.add_line_segments(
                "/world/trails", finite_rows(points), np.repeat(shades, 2, axis=1), thickness=2.0,
                thickness_units="screen",
            )  # fmt: skip
        self._send(self._handles["trails"], "points", points)

    def _to_grid(self, pos: NDArray) -> NDArray:
        return pos + self.offsets[:, None]


def grid_offsets(n: int, spacing: float) -> NDArray:
    """Return the origins of n worlds in a square grid around the origin, m. (n, 3)"""
    columns = int(np.ceil(np.sqrt(n)))
    row, column = np.divmod(np.arange(n), columns)
    rows = -(-n // columns)
    return spacing * np.stack([column - (columns - 1) / 2, (rows - 1) / 2 - row, np.zeros(n)], axis=-1)


def finite_rows(values: NDArray, fill_value: ArrayLike = 0.0) -> NDArray:
    """Return rows of numbers, (..., k), with rows that are not finite replaced by ``fill_value``, () or (k,)."""
    is_invalid = ~np.isfinite(values).all(-1, keepdims=True)
    return np.where(is_invalid, np.asarray(fill_value, values.dtype), values)


def rgb(rgba: Any, brightness: float = 1.0) -> tuple[int, int, int]:
    """Return red, green and blue from 0 to 255 of a colour from 0 to 1, multiplied by ``brightness``."""
    r, g, b = (int(x) for x in _to_bytes(brightness * np.asarray(rgba[:3], float)))
    return r, g, b


def _to_bytes(colors: NDArray) -> NDArray:
    return np.round(255 * np.clip(colors, 0.0, 1.0)).astype(np.uint8)


def _opacity(rgba: Any) -> float | None:
    return None if rgba[3] >= 1 else float(rgba[3])


def _color_key(shape: VisualGeom) -> tuple:
    return tuple(np.round(shape.rgba, 3))


def _group_equal_bodies(shapes_by_body: dict[int, list[VisualGeom]]) -> list[list[int]]:
    groups: dict[tuple, list[int]] = defaultdict(list)
    for body, shapes in shapes_by_body.items():
        key = tuple(
            (s.kind, *(np.round(x, 6).tobytes() for x in (s.size, s.rgba, s.pos, s.quat)), s.vertices.tobytes())
            for s in shapes
        )
        groups[key].append(body)
    return list(groups.values())


def _add_geoms(scene: Any, name: str, shapes: list[VisualGeom], rgba: tuple) -> None:
    # Each plane is a grid; all other geoms are one mesh.
    solid_shapes = [shape for shape in shapes if shape.kind != "plane"]
    for i, shape in enumerate(shape for shape in shapes if shape.kind == "plane"):
        width, height = (2 * PLANE_HALF_SIZE if size == 0 else 2 * float(size) for size in shape.size[:2])
        scene.add_grid(
            f"{name}/plane{i}", width, height, cell_size=1.0, cell_color=rgb(rgba, 0.9), section_size=5.0,
            section_color=rgb(rgba, 0.8), plane_color=rgb(rgba), plane_opacity=float(rgba[3]),
            infinite_grid=not shape.size[:2].any(), fade_distance=2 * PLANE_HALF_SIZE,
            position=shape.pos, wxyz=np.roll(shape.quat, 1),
        )  # fmt: skip
    if solid_shapes:
        scene.add_mesh_simple(
            f"{name}/mesh", *_create_mesh(solid_shapes), color=rgb(rgba), opacity=_opacity(rgba), flat_shading=True,
            side="double",
        )  # fmt: skip


def _create_mesh(shapes: list[VisualGeom]) -> tuple[NDArray, NDArray]:
    # Vertices and faces of geoms of one body, in the body's frame.
    import trimesh

    meshes = []
    for shape in shapes:
        pose = np.eye(4)
        pose[:3, :3] = trimesh.transformations.quaternion_matrix(np.roll(shape.quat, 1))[:3, :3]
        pose[:3, 3] = shape.pos
        meshes.append(_create_geom_mesh(shape).apply_transform(pose))
    mesh = trimesh.util.concatenate(meshes)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32)


def _create_geom_mesh(shape: VisualGeom) -> Any:
    import trimesh

    radius, half = float(shape.size[0]), float(shape.size[1])
    if shape.kind == "box":
        return trimesh.creation.box(extents=2 * shape.size)
    if shape.kind == "cylinder":
        return trimesh.creation.cylinder(radius=radius, height=2 * half, sections=24)
    if shape.kind == "capsule":
        return trimesh.creation.capsule(radius=radius, height=2 * half, count=[12, 12])
    if shape.kind == "mesh":
        return trimesh.Trimesh(shape.vertices, shape.faces, process=False)
    mesh = trimesh.creation.icosphere(subdivisions=2)
    return mesh.apply_scale(shape.size if shape.kind == "ellipsoid" else radius)
