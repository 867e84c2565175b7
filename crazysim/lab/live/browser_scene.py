"""The scene of a live simulation in a browser: batches of meshes whose poses are sent once per picture."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.lab.live.attitude import rotate
from crazysim.lab.live.browser_trails import Trails, finite_rows
from crazysim.lab.live.picture import LIGHT_RADIUS, WIND_SCALE, Picture
from crazysim.lab.live.scene_bodies import DRONE, MARK_RADIUS, SceneBodies, SceneBody
from crazysim.media.trail import choose_drone_colors
from crazysim.media.web import add_geoms, create_mesh, rgb
from crazysim.scene.visual_geoms import VisualGeom

SETPOINT_RADIUS = 0.025
"""Radius of a setpoint's sphere, m."""
CLICK_SIZE = 0.02
"""Smallest half size of the box in which a click hits a body, as a fraction of the distance from the camera."""
HIDDEN_SCALE = 1e-6
"""Scale of a mark that is not shown."""
CONTACT_COLOR, FOLLOWED_COLOR, WIND_COLOR = (230, 40, 30), (60, 150, 255), (90, 150, 200)
"""Colours of marks, rgb, 0 to 255."""


class BrowserScene:
    """Nodes of one viser server that show some worlds, side by side in a grid."""

    def __init__(
        self,
        server: Any,
        shapes: list[VisualGeom],
        bodies: SceneBodies,
        picture: Picture,
        spacing: float,
        trail: float,
    ):
        self._scene, self._bodies = server.scene, bodies
        scene = server.scene
        n_worlds, n_drones = picture.drone_pos.shape[:2]
        self.offsets = grid_offsets(n_worlds, spacing)
        self._root = scene.add_frame("/world", show_axes=False)
        shapes_by_color: dict[tuple, list[VisualGeom]] = defaultdict(list)
        shapes_by_body: dict[int, list[VisualGeom]] = defaultdict(list)
        for shape in shapes:
            if shape.mocap < 0:
                shapes_by_color[tuple(np.round(shape.rgba, 3))].append(shape)
            elif shape.kind != "plane":
                shapes_by_body[shape.mocap].append(shape)
        for k, (rgba, fixed_shapes) in enumerate(shapes_by_color.items()):
            infinite_planes = [s for s in fixed_shapes if s.kind == "plane" and not s.size[:2].any()]
            finite_shapes = [s for s in fixed_shapes if not any(s is plane for plane in infinite_planes)]
            if infinite_planes:
                add_geoms(scene, f"/world/floor/{k}", infinite_planes, rgba)
            for w, offset in enumerate(self.offsets if finite_shapes else []):
                node = scene.add_frame(f"/world/fixed/{w}/{k}", position=offset, show_axes=False)
                add_geoms(scene, node.name, finite_shapes, rgba)
        self._batches: list[tuple[Any, NDArray]] = []
        for equal_bodies in _group_equal_bodies(shapes_by_body):
            self._add_bodies(np.array(equal_bodies), shapes_by_body[equal_bodies[0]], picture)

        colors = np.tile(choose_drone_colors(n_drones, None)[:, :3], (n_worlds, 1))
        drone_pos = self._to_grid(picture.drone_pos).reshape(-1, 3)
        self._setpoints = self._add_spheres("setpoints", SETPOINT_RADIUS, picture.setpoint, to_rgb_bytes(colors), 0.8)
        self._contacts = self._add_spheres("contacts", MARK_RADIUS, picture.drone_pos, CONTACT_COLOR, 0.45)
        self._contacts.batched_scales = np.full(len(drone_pos), HIDDEN_SCALE, np.float32)
        self._lights = self._add_spheres("lights", LIGHT_RADIUS, picture.drone_pos, to_rgb_bytes(0 * colors), 0.7)
        self._lights.batched_scales = np.full(len(drone_pos), HIDDEN_SCALE, np.float32)
        self._led_colors = np.zeros_like(colors)
        self._followed_mark = scene.add_icosphere(
            "/world/followed", radius=MARK_RADIUS, color=FOLLOWED_COLOR, opacity=0.25, visible=False
        )
        self._label = scene.add_label("/world/followed/name", "", position=(0, 0, MARK_RADIUS), anchor="bottom-center")
        self._wind = None
        self._trail_mocap_ids = bodies.trail_mocap_ids
        trail_pos = self._to_grid(picture.pos[:, self._trail_mocap_ids]).reshape(-1, 3)
        trail_colors = np.tile(choose_drone_colors(len(self._trail_mocap_ids), None)[:, :3], (n_worlds, 1))
        self._trail = Trails(scene, trail_pos, trail_colors, trail) if trail > 0 else None
        self.visible: dict[str, bool] = dict.fromkeys(("trails", "setpoints", "contacts", "wind", "lights"), True)

    def update(self, picture: Picture, follow: bool) -> None:
        """Show a picture.

        Args:
            picture: Picture.
            follow: True to keep the followed body in the middle: the worlds move, and the camera stays.
        """
        pos, visible = self._to_grid(picture.pos), self.visible
        for handle, bodies in self._batches:
            handle.batched_positions = finite_rows(pos[:, bodies].reshape(-1, 3))
            handle.batched_wxyzs = finite_rows(
                np.roll(picture.quat[:, bodies], 1, axis=-1).reshape(-1, 4), (1, 0, 0, 0)
            )
        drone_pos = self._to_grid(picture.drone_pos)
        if self._setpoints is not None:
            self._setpoints.visible = visible["setpoints"]
            self._setpoints.batched_positions = finite_rows(self._to_grid(picture.setpoint).reshape(-1, 3))
        has_contact = picture.has_contact.ravel() & visible["contacts"]
        self._contacts.batched_scales = np.where(has_contact, 1.0, HIDDEN_SCALE).astype(np.float32)
        if has_contact.any():
            self._contacts.batched_positions = finite_rows(drone_pos.reshape(-1, 3))
        self._show_lights(drone_pos.reshape(-1, 3), picture.lights.reshape(-1, 3) * visible["lights"])
        self._show_wind(drone_pos, picture)
        if self._trail is not None:
            self._trail.update(
                picture.time, finite_rows(pos[:, self._trail_mocap_ids].reshape(-1, 3)), visible["trails"]
            )
        self._show_followed(pos, picture, follow)

    def pick(
        self, picture: Picture, origin: ArrayLike, direction: ArrayLike
    ) -> tuple[int, SceneBody | None, NDArray | None]:
        """Return what a ray from the camera hits: the index of a shown world, a body, and a point of the floor.

        If the ray hits a body, the point is None; if it hits the floor, the body is None. If it hits nothing, both are
        None and the index is 0. The point is in the frame of the world, m. (3,)

        Args:
            picture: Picture that the user has seen.
            origin: Origin of the ray in the browser's scene, m. (3,)
            direction: Direction of the ray. (3,)
        """
        origin = np.asarray(origin, float) - np.asarray(self._root.position, float)
        direction = np.asarray(direction, float) / np.linalg.norm(direction)
        distances = self._ray_distances(picture, origin, direction)
        if np.isfinite(distances).any():
            shown_index, mocap = np.unravel_index(distances.argmin(), distances.shape)
            return int(shown_index), self._bodies.items[self._bodies.owner[mocap]], None
        if direction[2] > -1e-6:
            return 0, None, None
        point = origin - direction * origin[2] / direction[2]
        shown_index = int(np.linalg.norm(self.offsets - point, axis=-1).argmin())
        return shown_index, None, point - self.offsets[shown_index]

    def _ray_distances(self, picture: Picture, origin: NDArray, direction: NDArray) -> NDArray:
        # The distance is infinite if the ray does not enter the box around the body. Boxes of small and distant bodies
        # are enlarged, so that these bodies are easy to click.
        start = origin - self._to_grid(picture.pos)
        distance = np.linalg.norm(start, axis=-1, keepdims=True)
        low, high = self._bodies.low, self._bodies.high
        is_drone = np.array([self._bodies.items[k].kind == DRONE for k in self._bodies.owner])
        min_radius = np.maximum(np.where(is_drone, MARK_RADIUS, 0.0)[:, None], CLICK_SIZE * distance)
        to_body = picture.quat * (-1, -1, -1, 1)
        local_start = rotate(to_body, start)
        local_direction = rotate(to_body, np.broadcast_to(direction, start.shape))
        with np.errstate(divide="ignore", invalid="ignore"):
            to_low = (np.minimum(low, -min_radius) - local_start) / local_direction
            to_high = (np.maximum(high, min_radius) - local_start) / local_direction
        entry_distance, exit_distance = np.fmin(to_low, to_high).max(-1), np.fmax(to_low, to_high).min(-1)
        is_hit = (entry_distance > 0) & (entry_distance <= exit_distance) & (high > low).any(-1)
        ray_distance = np.linalg.norm(start - (start @ direction)[..., None] * direction, axis=-1)
        return np.where(is_hit, ray_distance, np.inf)

    def _add_bodies(self, bodies: NDArray, shapes: list[VisualGeom], picture: Picture) -> None:
        shapes_by_color: dict[tuple, list[VisualGeom]] = defaultdict(list)
        for shape in shapes:
            shapes_by_color[tuple(np.round(shape.rgba, 3))].append(shape)
        pos = self._to_grid(picture.pos)[:, bodies].reshape(-1, 3)
        quat = np.roll(picture.quat[:, bodies], 1, axis=-1).reshape(-1, 4)
        for k, (rgba, same_color_shapes) in enumerate(shapes_by_color.items()):
            mesh = create_mesh(same_color_shapes)
            handle = self._scene.add_batched_meshes_simple(
                f"/world/bodies/{bodies[0]}/{k}", np.asarray(mesh.vertices, np.float32),
                np.asarray(mesh.faces, np.uint32), finite_rows(quat, (1, 0, 0, 0)), finite_rows(pos),
                batched_colors=rgb(rgba), opacity=None if rgba[3] >= 1 else float(rgba[3]), lod="off",
                flat_shading=True, side="double",
            )  # fmt: skip
            self._batches.append((handle, bodies))

    def _add_spheres(self, name: str, radius: float, pos: NDArray, colors: Any, opacity: float) -> Any:
        if not pos.size:
            return None
        import trimesh

        sphere = trimesh.creation.icosphere(subdivisions=2, radius=radius)
        points = finite_rows(self._to_grid(pos).reshape(-1, 3))
        return self._scene.add_batched_meshes_simple(
            f"/world/{name}", np.asarray(sphere.vertices, np.float32), np.asarray(sphere.faces, np.uint32),
            np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1)), points, batched_colors=colors, opacity=opacity, lod="off",
        )  # fmt: skip

    def _show_wind(self, drone_pos: NDArray, picture: Picture) -> None:
        if not picture.wind.size:
            return
        arrow_start = finite_rows(drone_pos.reshape(-1, 3))
        ends = np.stack([arrow_start, arrow_start + WIND_SCALE * finite_rows(picture.wind.reshape(-1, 3))], axis=1)
        ends = ends.astype(np.float32)
        if self._wind is None:
            self._wind = self._scene.add_arrows(
                "/world/wind", ends, WIND_COLOR, shaft_radius=0.006, head_radius=0.015, head_length=0.04
            )
        self._wind.visible = self.visible["wind"]
        self._wind.points = ends

    def _show_lights(self, drone_pos: NDArray, colors: NDArray) -> None:
        if not np.array_equal(colors, self._led_colors):
            self._led_colors = colors
            self._lights.batched_colors = to_rgb_bytes(colors)
            self._lights.batched_scales = np.where(colors.any(-1), 1.0, HIDDEN_SCALE).astype(np.float32)
        if colors.any():
            self._lights.batched_positions = finite_rows(drone_pos)

    def _show_followed(self, body_pos: NDArray, picture: Picture, follow: bool) -> None:
        shown_index = None
        if picture.followed is not None:
            shown_index = next((i for i, world in enumerate(picture.worlds) if world == picture.followed[0]), None)
        self._followed_mark.visible = shown_index is not None
        if shown_index is None or picture.followed is None:
            self._root.position = (0.0, 0.0, 0.0)
            return
        pos = finite_rows(body_pos[shown_index, picture.followed[1]])
        radius = self._bodies.mark_radius(picture.followed[1])
        self._followed_mark.position = pos
        if radius != self._followed_mark.radius:  # only on a change, because browsers rebuild the sphere
            self._followed_mark.radius, self._label.position = radius, (0.0, 0.0, radius)
        self._label.text = picture.followed_name
        self._root.position = -pos if follow else (0.0, 0.0, 0.0)

    def _to_grid(self, pos: NDArray) -> NDArray:
        return pos + self.offsets[:, None]


def grid_offsets(n: int, spacing: float) -> NDArray:
    """Return the origins of n worlds in a square grid around the origin, m. (n, 3)"""
    columns = int(np.ceil(np.sqrt(n)))
    row, column = np.divmod(np.arange(n), columns)
    rows = -(-n // columns)
    return spacing * np.stack([column - (columns - 1) / 2, (rows - 1) / 2 - row, np.zeros(n)], axis=-1)


def to_rgb_bytes(colors: NDArray) -> NDArray:
    """Return colours, 0 to 1, as whole numbers from 0 to 255. (n, 3)"""
    return np.round(255 * colors[:, :3]).astype(np.uint8)


def _group_equal_bodies(shapes_by_body: dict[int, list[VisualGeom]]) -> list[list[int]]:
    groups: dict[tuple, list[int]] = defaultdict(list)
    for body, shapes in shapes_by_body.items():
        key = tuple(
            (s.kind, *(np.round(x, 6).tobytes() for x in (s.size, s.rgba, s.pos, s.quat)), s.vertices.tobytes())
            for s in shapes
        )
        groups[key].append(body)
    return list(groups.values())
