"""Maps of worlds from above: obstacles, and the paths and headings of drones."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.media.trail import Trail, choose_drone_colors
from crazysim.scene.collision import VISIBLE_GROUPS
from crazysim.sim.sim import Sim

BACKGROUND_COLOR, OBSTACLE_COLOR, OUTLINE_COLOR = (238, 238, 230), (40, 65, 40), (20, 20, 20)
"""Colours of a map, of obstacles, and of the outlines of drones, RGB."""
MIN_OBSTACLE_TOP = 0.1
"""Smallest height of the top of an obstacle, m. Lower geoms are not drawn: markers on the floor, and obstacles that a
layout has moved below the floor."""
MARGIN = 1.0
"""Width of the margin around obstacles and paths, m."""
MIN_WIDTH, MAX_WIDTH = 6.0, 24.0
"""Smallest and largest width of a map, m. If the area is larger than the map, the map follows the first drone."""
MIN_PIXELS = 8
"""Smallest width and height of a map, pixels."""
SAMPLES = 2
"""Number of samples along each side of a pixel."""
EYE_HEIGHT = 1e4
"""Height from which rays are cast, m. Rays deviate from the vertical by at most 3 mm for each metre of height, unless a
map is higher than wide."""
PATH_SECONDS = 1e6
"""Largest duration of a path, s."""
MAX_COORDINATE = 1e5
"""Largest coordinate of obstacles and drones that are drawn, m. This leaves out drones whose states diverge."""


class Grid(NamedTuple):
    """Samples of a part of the horizontal plane. Columns are in the direction of x, rows in the direction of -y."""

    start: NDArray
    """Indices of the first column and the first row. Column 0 and row 0 are at the origin of the world. (2,)"""
    size: NDArray
    """Number of columns and number of rows. (2,)"""
    scale: float
    """Distance between samples, m."""

    def locate(self, points: NDArray) -> NDArray:
        """Return columns and rows of points, world frame, m. (n, 2)"""
        return points * [1, -1] / self.scale - self.start


class TopView:
    """Maps from above of the worlds of a view, with the drones' paths since the last reset."""

    def __init__(self) -> None:
        self.paths = Trail(PATH_SECONDS)
        self._obstacles: dict[int, tuple[NDArray, NDArray]] = {}

    def draw(self, sim: Sim, k: int, width: int, height: int, rgba: ArrayLike | None = None) -> NDArray | None:
        """Return a map of the world that was drawn last, uint8, (height, width, 3); None without obstacles or space.

        Args:
            sim: Simulation.
            k: Index of the world in the arrays that ``paths.add`` receives.
            width: Width of the map, pixels.
            height: Height of the map, pixels.
            rgba: Colour of drones, one or one per drone; None for default colours. (4,) or (n_drones, 4)
        """
        model, data = sim.scene.mj_model, sim.scene.mj_data
        drones = [model.body(f"drone:{i}").id for i in range(sim.n_drones)]
        low, high = _geom_bounds(model, data)
        is_obstacle = (
            ~np.isin(model.body_rootid[model.geom_bodyid], drones)
            & np.isin(model.geom_group, VISIBLE_GROUPS)
            & ~np.isin(model.geom_type, (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD))
            & (high[:, 2] > MIN_OBSTACLE_TOP)
            & (np.abs(data.geom_xpos) < MAX_COORDINATE).all(-1)
        )
        if not is_obstacle.any() or min(width, height) < MIN_PIXELS:
            return None
        path = self.paths.path(k)[..., :2]
        path = np.where(np.abs(path) < MAX_COORDINATE, path, np.nan)
        points = path[np.isfinite(path).all(-1)]
        low, high = (np.concatenate([corner[is_obstacle, :2], points]) for corner in (low, high))
        grid = _choose_grid(low.min(axis=0) - MARGIN, high.max(axis=0) + MARGIN, path[-1, 0], width, height)
        canvas = np.full((*grid.size[::-1], 3), BACKGROUND_COLOR, np.uint8)
        canvas[self._find_obstacles(model, data, k, is_obstacle, grid)] = OBSTACLE_COLOR
        dot_radius = SAMPLES * max(height / 40, 2.0)
        for drone, color in enumerate(choose_drone_colors(sim.n_drones, rgba)):
            pixels, rgb = grid.locate(path[:, drone]), 255 * color[:3]
            heading = data.xmat[drones[drone]].reshape(3, 3)[:2, 0] * [1, -1]
            nose = pixels[-1] + 3 * dot_radius * heading / max(float(np.linalg.norm(heading)), 1e-6)
            _draw_line(canvas, pixels, 0.4 * dot_radius, rgb)
            _draw_line(canvas, np.stack([pixels[-1], nose]), 0.4 * dot_radius, OUTLINE_COLOR)
            _draw_line(canvas, pixels[-1:], 1.4 * dot_radius, OUTLINE_COLOR)
            _draw_line(canvas, pixels[-1:], dot_radius, rgb)
        return canvas.reshape(height, SAMPLES, width, SAMPLES, 3).mean(axis=(1, 3)).astype(np.uint8)

    def _find_obstacles(
        self, model: mujoco.MjModel, data: mujoco.MjData, k: int, is_obstacle: NDArray, grid: Grid
    ) -> NDArray:
        # Rays are cast over an area of twice the size. The result is reused until the map leaves the area or an
        # obstacle moves.
        area = Grid(grid.start // grid.size * grid.size, 2 * grid.size, grid.scale)
        poses = (x[is_obstacle].ravel() for x in (data.geom_xpos, data.geom_xmat))
        key = np.concatenate([*poses, area.start, [grid.scale]])
        last_key, shows_obstacle = self._obstacles.get(k, (np.zeros(0), np.zeros(0)))
        if not np.array_equal(key, last_key):
            shows_obstacle = _cast_rays(model, data, is_obstacle, area)
            self._obstacles[k] = key, shows_obstacle
        (column, row), (width, height) = grid.start - area.start, grid.size
        return shows_obstacle[row : row + height, column : column + width]


def _geom_bounds(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[NDArray, NDArray]:
    rot = data.geom_xmat.reshape(-1, 3, 3)
    middle = data.geom_xpos + (rot @ model.geom_aabb[:, :3, None])[..., 0]
    half_size = (np.abs(rot) @ model.geom_aabb[:, 3:, None])[..., 0]
    return middle - half_size, middle + half_size


def _choose_grid(low: NDArray, high: NDArray, pos: NDArray, width: int, height: int) -> Grid:
    size = SAMPLES * np.array([width, height])
    scale = float(np.clip(((high - low) / size).max(), MIN_WIDTH / size[0], MAX_WIDTH / size[0]))
    middle, slack = (low + high) / 2, np.maximum((high - low - scale * size) / 2, 0.0)
    middle += np.clip(np.nan_to_num(pos - middle), -slack, slack)
    return Grid(np.round(middle * [1, -1] / scale - size / 2).astype(int), size, scale)


def _cast_rays(model: mujoco.MjModel, data: mujoco.MjData, is_obstacle: NDArray, grid: Grid) -> NDArray:
    n_rays, pos = int(grid.size.prod()), data.geom_xpos.copy()
    x, y = (grid.scale * (np.arange(n) + 0.5 - n / 2) for n in grid.size)
    rays = np.stack(np.broadcast_arrays(x, -y[:, None], -EYE_HEIGHT), axis=-1).ravel()
    eye = np.append(grid.scale * (grid.start + grid.size / 2) * [1, -1], EYE_HEIGHT)
    geom, distance = np.full(n_rays, -1, np.int32), np.zeros(n_rays)
    data.geom_xpos[~is_obstacle] = -2 * EYE_HEIGHT  # so that drones do not cover obstacles
    mujoco.mj_multiRay(model, data, eye, rays, None, 1, -1, geom, distance, None, n_rays, mujoco.mjMAXVAL)
    data.geom_xpos[:] = pos
    return ((geom >= 0) & is_obstacle[geom]).reshape(grid.size[::-1])


def _draw_line(canvas: NDArray, points: NDArray, radius: float, rgb: ArrayLike) -> None:
    points = np.clip(points[np.isfinite(points).all(-1)], -np.max(canvas.shape), 2 * np.max(canvas.shape))
    if not len(points):
        return
    length = np.append(0.0, np.linalg.norm(np.diff(points, axis=0), axis=-1).cumsum())
    steps = np.linspace(0.0, length[-1], int(2 * length[-1]) + 1)
    line_points = np.stack([np.interp(steps, length, x) for x in points.T], axis=-1)
    offsets = np.arange(-int(radius), int(radius) + 1)
    disc = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    samples = np.floor(line_points[:, None]).astype(int) + disc[np.linalg.norm(disc, axis=-1) <= radius]
    columns, rows = samples[((samples >= 0) & (samples < canvas.shape[1::-1])).all(-1)].T
    canvas[rows, columns] = rgb
