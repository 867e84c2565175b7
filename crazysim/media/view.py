"""Views: the worlds that an image shows side by side, its camera and its overlays."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.core.settings import check_settings, color, positive_integer, setting
from crazysim.eager import fetch_rows
from crazysim.errors import ConfigError, expect, require
from crazysim.media.top_view import PATH_SECONDS, draw_map
from crazysim.media.trail import Trail, choose_drone_colors
from crazysim.media.worlds import world_indices
from crazysim.sim.sim import Sim
from crazysim.sim.visualize import draw_setpoints, draw_text

BORDER_COLOR = 40
"""Grey level between two worlds, 0 to 255."""

MAX_PIXELS = 16_384
"""Largest width and height of an image."""

RING_POINTS, RING_LINE_WIDTH = 25, 2.0
"""Number of points of a ring, and width of the line of a ring around a drone, pixels."""
MARK_COLOR, MARK_WIDTH = (0.1, 0.8, 0.3, 1.0), 12
"""Colour, RGBA, of the rings that are marks, and their width in images of the free camera, pixels."""
HOOP_COLOR, HOOP_THICKNESS = (0.95, 0.6, 0.1, 1.0), 0.02
"""Colour, RGBA, of hoops, and radius of their rim, m."""
MIN_VIEW_RADIUS = 0.25
"""Smallest radius around points that a camera holds in view, m; a Crazyflie is then a sixth of the image's height."""
DISTANCE_MARGIN = 1.25
"""Distance of a camera that holds points in view, as a multiple of the distance from which they just fit."""


@dataclass
class View:
    """A view of a simulation: one world, or several in a grid.

    Trails and the smoothed aim of the camera persist between images.
    """

    worlds: Sequence[int] = (0,)
    """Indices of the worlds, row by row."""
    width: int = 1280
    """Width of the whole image, pixels."""
    height: int = 720
    """Height of the whole image, pixels."""
    camera: int | str = -1
    """Name or id of a camera; -1 is the free camera."""
    cam_config: Mapping[str, Any] | Callable[[float], Mapping[str, Any]] | None = None
    """Settings of the free camera, or a function from time, s, to settings for a moving camera."""
    follow: int | None = None
    """Index of the drone that the free camera looks at, or None."""
    hold: Callable[[Sim, int], ArrayLike] | None = None
    """Function that returns points of a world, ``hold(sim, world)``, world frame, m (n, 3), or None. The free camera
    holds these points and all drones in view, from a distance that fits."""
    lag: float = setting(default=0.3, low=0.0)
    """Time constant with which the camera follows the bodies of ``follow`` or ``hold``, s."""
    trail: float = setting(default=0.0, low=0.0)
    """Duration of the drones' trails, s; 0 for no trails."""
    setpoints: bool = False
    """Whether to draw the positions of state commands, as spheres."""
    rgba: ArrayLike | None = color(per_item=True)
    """Colour of trails, setpoints and drones on maps, one or one per drone; None for default colours."""
    text: str | None = None
    """ASCII text at the top left of each world, with the fields ``{world}`` and ``{time}``; None for no text."""
    draw: Callable[[Sim, int], None] | None = None
    """Function that draws further overlays of a world, ``draw(sim, world)``, or None."""
    inset: Callable[[Sim, int], NDArray | None] | None = None
    """Function that returns a small picture of a world, ``inset(sim, world)``, uint8, (height, width, 3), or None. The
    picture is drawn enlarged at the bottom right of that world."""
    top_view: bool = False
    """True to draw a map from above at the bottom left of each world that has obstacles, with the drones' paths since
    the last reset."""
    marks: Callable[[Sim, int], ArrayLike] | None = None
    """Function that returns points of a world to mark, ``marks(sim, world)``, m (n, 3), or None. Marks are rings of one
    size in all images, which hide nothing; points that are not finite have none."""
    hoops: Callable[[Sim, int], ArrayLike] | None = None
    """Function that returns hoops of a world to draw, ``hoops(sim, world)``, or None: middle, m, unit vector along the
    axis, and radius, m. (n, 7)"""
    ring_width: int = setting(default=0, low=0)
    """Width of a ring around every drone that the free camera shows smaller than that, pixels; 0 for no rings."""
    columns: int | None = None
    """Worlds per row; None for a grid with about as many columns as rows."""
    border: int = setting(default=2, low=0)
    """Width of the lines between worlds, pixels."""
    _trail: Trail | None = field(default=None, init=False, repr=False)
    _paths: Trail | None = field(default=None, init=False, repr=False)
    _aim: dict[int, tuple[float, NDArray]] = field(default_factory=dict, init=False, repr=False)
    """Time of the last image, s, and aim of its camera: a point and for ``hold`` a distance, by index in ``worlds``."""

    def __post_init__(self) -> None:
        check_settings(self)
        self.width, self.height = (
            positive_integer(name, getattr(self, name), MAX_PIXELS) for name in ("width", "height")
        )
        worlds = np.atleast_1d(np.asarray(self.worlds))  # ``check_settings`` has checked that these are numbers
        expect(worlds.ndim == 1, "worlds as a list of indices", self.worlds, "Use (0,).")
        self.worlds = worlds.tolist()
        if self.columns is not None:
            positive_integer("columns", self.columns)
        require(
            min(self.tile_size) >= 1,
            f"expected an image that {len(self.worlds)} worlds fit into, got {self.width} x {self.height} pixels. "
            f"Show fewer worlds or increase the size.",
        )
        require(
            self.follow is None or self.hold is None,
            "expected a drone to follow or points to hold in view, got both. Use only one of them.",
        )
        require(
            (self.follow is None and self.hold is None) or self.camera == -1,
            f"expected camera=-1, the free camera, to follow a drone or hold points in view, got "
            f"{self.camera!r}. Drones carry the cameras track_cam:i and fpv_cam:i.",
        )
        if self.trail != 0:
            self._trail = Trail(self.trail)
        if self.top_view:
            self._paths = Trail(PATH_SECONDS)
        _format_text(self.text, 0, 0.0)

    @property
    def grid(self) -> tuple[int, int]:
        """Numbers of rows and columns."""
        n = len(self.worlds)
        columns = min(n, int(np.ceil(np.sqrt(n))) if self.columns is None else self.columns)
        return -(-n // columns), columns

    @property
    def tile_size(self) -> tuple[int, int]:
        """Width and height of one world, pixels."""
        rows, columns = self.grid
        return (
            (self.width - self.border * (columns - 1)) // columns,
            (self.height - self.border * (rows - 1)) // rows,
        )

    def tile(self, k: int) -> tuple[slice, slice]:
        """Return the rows and columns of pixels of the k-th world."""
        row, column = divmod(k, self.grid[1])
        width, height = self.tile_size
        left, top = column * (width + self.border), row * (height + self.border)
        return slice(top, top + height), slice(left, left + width)

    def render(self, sim: Sim) -> NDArray:
        """Render an image of a simulation. (height, width, 3), uint8

        Overlays that were drawn with ``crazysim.sim.visualize`` appear in each of the worlds.

        Raises:
            RenderError: If this machine cannot draw.
        """
        time, pos = self._read_worlds(sim)
        image = np.full((self.height, self.width, 3), BORDER_COLOR, np.uint8)
        width, height = self.tile_size
        saved_overlays = sim.overlays.copy()
        try:
            for k, world in enumerate(self.worlds):
                sim.overlays.restore(saved_overlays)
                config = self._draw(sim, k, time[k], pos[k])
                tile = image[self.tile(k)]
                tile[:] = np.asarray(sim.render("rgb_array", world, self.camera, config, width, height))
                if self._paths is not None:
                    path = self._paths.path(k)
                    _draw_top_view(tile, draw_map(sim, world, path, width // 2, 3 * height // 8, self.rgba))
                if self.inset is not None:
                    _draw_inset(tile, self.inset(sim, world))
        except Exception:
            sim.overlays.restore(saved_overlays)  # for the next image
            raise
        return image

    def show(self, sim: Sim) -> None:
        """Show the first of the worlds in a window of the view's size.

        Raises:
            RenderError: If there is no screen.
        """
        time, pos = self._read_worlds(sim)
        config = self._draw(sim, 0, time[0], pos[0])
        sim.render("human", self.worlds[0], self.camera, config, self.width, self.height)

    def _read_worlds(self, sim: Sim) -> tuple[NDArray, NDArray]:
        worlds = world_indices(sim, self.worlds)
        require(
            self.follow is None or self.follow in range(sim.n_drones),
            f"expected a drone from 0 to {sim.n_drones - 1} to follow, got {self.follow!r}",
        )
        time, pos = (
            np.asarray(fetch_rows(sim.time, worlds)[:, 0], float),
            np.asarray(fetch_rows(sim.data.states.pos, worlds), float),
        )
        if self._trail is not None:
            self._trail.add(time, pos)
        if self._paths is not None:
            self._paths.add(time, pos)
        return time, pos

    def _draw(self, sim: Sim, k: int, time: float, pos: NDArray) -> dict[str, Any]:
        config = self._cam_config(sim, k, time, pos)
        if self.hoops is not None:
            for hoop in np.asarray(self.hoops(sim, self.worlds[k]), float).reshape(-1, 7):
                _draw_hoop(sim, hoop)
        if self.camera == -1:
            self._draw_rings_and_marks(sim, k, pos, config)
        if self._trail is not None:
            self._trail.draw(sim.overlays, k, self.rgba)
        if self.setpoints:
            draw_setpoints(sim, self.worlds[k], choose_drone_colors(sim.n_drones, self.rgba))
        if self.draw is not None:
            self.draw(sim, self.worlds[k])
        if self.text is not None:
            draw_text(sim, _format_text(self.text, self.worlds[k], time))
        return config

    def _cam_config(self, sim: Sim, k: int, time: float, pos: NDArray) -> dict[str, Any]:
        config = self.cam_config(time) if callable(self.cam_config) else self.cam_config
        expect(
            config is None or isinstance(config, Mapping),
            "cam_config to return a dict",
            config,
            "Use {'distance': 3.0}.",
        )
        config = dict(config or {})
        if self.follow is not None:
            config["lookat"] = self._smooth_aim(k, time, pos[self.follow])
        if self.hold is not None:
            target = np.asarray(self.hold(sim, self.worlds[k]), float)
            require(
                target.shape[-1:] == (3,), f"expected hold to return points of shape (n, 3), got shape {target.shape}."
            )
            points = np.concatenate([pos, target.reshape(-1, 3)])
            points, fovy = points[np.isfinite(points).all(-1)], float(sim.mj_model.vis.global_.fovy)
            *middle, distance = self._smooth_aim(k, time, _frame_points(points, fovy))
            config |= {"lookat": middle, "distance": max(distance, _fitting_distance(points, middle, fovy))}
        return config

    def _draw_rings_and_marks(self, sim: Sim, k: int, pos: NDArray, config: Mapping[str, Any]) -> None:
        model, camera = sim.mj_model, mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(model, camera)
        lookat, distance = np.asarray(config.get("lookat", camera.lookat)), config.get("distance", camera.distance)
        azimuth, elevation = (np.radians(config.get(x, getattr(camera, x))) for x in ("azimuth", "elevation"))
        right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
        ahead = np.array([*(np.cos(elevation) * np.array([-right[1], right[0]])), np.sin(elevation)])
        eye, pixel = lookat - distance * ahead, 2 * np.tan(np.radians(model.vis.global_.fovy) / 2) / self.tile_size[1]
        angle = np.linspace(0, 2 * np.pi, RING_POINTS)[:, None]
        circle = np.cos(angle) * right + np.sin(angle) * np.cross(right, ahead)
        marks = np.zeros((0, 3)) if self.marks is None else np.asarray(self.marks(sim, self.worlds[k]), float)
        rings = [(point, MARK_WIDTH, 0.0, MARK_COLOR) for point in marks.reshape(-1, 3)]
        for drone, drone_color in enumerate(choose_drone_colors(sim.n_drones, self.rgba)):
            rings.append((pos[drone], self.ring_width, model.geom(f"col_sphere:{drone}").size[0], drone_color))
        for point, width, min_radius, rgba in rings:
            radius = width / 2 * pixel * ((point - eye) @ ahead)
            if radius > min_radius and np.isfinite(point).all():
                # Halfway to the camera, where it has the same place in the image and the floor does not hide it.
                ring = (eye + point + radius * circle) / 2
                sim.overlays.line(ring, rgba, RING_LINE_WIDTH, RING_LINE_WIDTH)

    def _smooth_aim(self, k: int, time: float, aim: NDArray) -> NDArray:
        last_time, value = self._aim.get(k, (np.inf, aim))
        weight = 1.0 if time < last_time or self.lag == 0 else 1 - np.exp(-(time - last_time) / self.lag)
        if np.isfinite(aim).all():
            value = value + weight * (aim - value)
        self._aim[k] = (time, value)
        return value


def _draw_hoop(sim: Sim, hoop: NDArray) -> None:
    axis, angle = hoop[3:6], np.linspace(0, 2 * np.pi, RING_POINTS)[:, None]
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    rim = hoop[:3] + hoop[6] * (np.cos(angle) * side + np.sin(angle) * np.cross(axis, side))
    for start, end in itertools.pairwise(rim):
        sim.overlays.capsule(start, end, HOOP_THICKNESS, HOOP_COLOR, cylinder=False)


def _draw_inset(tile: NDArray, picture: NDArray | None) -> None:
    # Its pixels are repeated as often as fits into a quarter of the image's width and a third of its height.
    if picture is None:
        return
    scale = max(min(tile.shape[1] // (4 * picture.shape[1]), tile.shape[0] // (3 * picture.shape[0])), 1)
    picture = np.pad(picture.repeat(scale, axis=0).repeat(scale, axis=1), ((2, 0), (2, 0), (0, 0)))
    height, width = (min(n, limit) for n, limit in zip(picture.shape[:2], tile.shape[:2], strict=True))
    tile[tile.shape[0] - height :, tile.shape[1] - width :] = picture[:height, :width]


def _draw_top_view(tile: NDArray, picture: NDArray | None) -> None:
    if picture is not None:
        picture = np.pad(picture, ((2, 0), (0, 2), (0, 0)))
        tile[tile.shape[0] - picture.shape[0] :, : picture.shape[1]] = picture


def _frame_points(points: NDArray, fovy: float) -> NDArray:
    if not len(points):
        return np.full(4, np.nan)
    middle = (points.min(0) + points.max(0)) / 2
    return np.append(middle, DISTANCE_MARGIN * _fitting_distance(points, middle, fovy))


def _fitting_distance(points: NDArray, middle: ArrayLike, fovy: float) -> float:
    radius = np.linalg.norm(points - np.asarray(middle), axis=-1).max(initial=MIN_VIEW_RADIUS)
    return float(radius / np.sin(np.radians(fovy) / 2))


def _format_text(text: str | None, world: int, time: float) -> str:
    try:
        return "" if text is None else text.format(world=world, time=time)
    except (KeyError, IndexError, ValueError) as error:
        raise ConfigError(
            f"expected text with the fields {{world}} and {{time:.1f}} only, got {text!r}: {error}"
        ) from None
