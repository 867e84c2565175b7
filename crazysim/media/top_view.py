"""Maps of worlds: the scene from above, and the paths and headings of drones."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.media.trail import choose_drone_colors
from crazysim.scene.collision import VISIBLE_GROUPS
from crazysim.sim.sim import Sim

HEADING_COLOR = (0.08, 0.08, 0.08, 1.0)
"""Colour of the line ahead of a drone, rgba."""
MIN_OBSTACLE_TOP = 0.1
"""Smallest height of the top of an obstacle, m. Lower geoms do not count: markers on the floor, and obstacles that a
layout has moved below the floor."""
MARGIN = 1.0
"""Width of the margin around obstacles and paths, m."""
MIN_WIDTH, MAX_WIDTH = 6.0, 24.0
"""Smallest and largest width of a map, m. If the area is larger than the map, the map follows the first drone."""
MIN_PIXELS = 8
"""Smallest width and height of a map, pixels."""
PATH_SECONDS = 1e6
"""Largest duration of a path, s."""
MAX_COORDINATE = 1e5
"""Largest coordinate of obstacles and drones that are drawn, m. This leaves out drones whose states diverge."""


def draw_map(
    sim: Sim, world: int, path: NDArray, width: int, height: int, rgba: ArrayLike | None = None
) -> NDArray | None:
    """Return a map of the world that was drawn last, uint8, (height, width, 3); None without obstacles or space.

    Args:
        path: Positions of the drones since the last reset, m. (n, n_drones, 3)
        width: Width of the map, pixels.
        height: Height of the map, pixels.
        rgba: Colour of drones, one or one per drone; None for default colours. (4,) or (n_drones, 4)
    """
    model, data = sim.scene.mj_model, sim.scene.mj_data
    drones = [model.body(f"drone:{i}").id for i in range(sim.n_drones)]
    low, high = _obstacle_bounds(model, data, drones)
    if not len(low) or min(width, height) < MIN_PIXELS:
        return None
    path = np.where((np.abs(path) < MAX_COORDINATE).all(-1, keepdims=True), path, np.nan)
    points = path[np.isfinite(path).all(-1)][:, :2]
    low, high = (np.concatenate([corner, points]) for corner in (low, high))
    low, high = low.min(axis=0) - MARGIN, high.max(axis=0) + MARGIN
    size = np.array([width, height])
    scale = float(np.clip(((high - low) / size).max(), MIN_WIDTH / width, MAX_WIDTH / width))  # m in a pixel
    middle, slack = (low + high) / 2, np.maximum((high - low - scale * size) / 2, 0.0)
    middle += np.clip(np.nan_to_num(path[-1, 0, :2] - middle), -slack, slack)

    dot_radius = scale * max(height / 40, 2.0)
    for drone, color in enumerate(choose_drone_colors(sim.n_drones, rgba)):
        pos = path[np.isfinite(path[:, drone]).all(-1), drone]
        if len(pos) and np.isfinite(path[-1, drone]).all():
            ahead = data.xmat[drones[drone]].reshape(3, 3)[:, 0] * [1, 1, 0]
            nose = pos[-1] + 3 * dot_radius * ahead / max(float(np.linalg.norm(ahead)), 1e-6)
            sim.overlays.line(pos, color, height / 60, height / 60)
            sim.overlays.capsule(pos[-1], nose, 0.4 * dot_radius, HEADING_COLOR, cylinder=True)
            sim.overlays.points(pos[-1:], color, 1.2 * dot_radius)
    fovy, distance = model.vis.global_.fovy, model.vis.map.zfar * model.stat.extent / 2
    config = {"lookat": [*middle, 0.0], "distance": distance, "azimuth": 90.0, "elevation": -90.0}
    try:
        # From far away through a narrow angle, rays are nearly vertical.
        model.vis.global_.fovy = np.degrees(2 * np.arctan(scale * height / 2 / distance))
        return np.asarray(sim.render("rgb_array", world, -1, config, width, height))
    finally:
        model.vis.global_.fovy = fovy


def _obstacle_bounds(model: mujoco.MjModel, data: mujoco.MjData, drones: list[int]) -> tuple[NDArray, NDArray]:
    rot = data.geom_xmat.reshape(-1, 3, 3)
    middle = data.geom_xpos + (rot @ model.geom_aabb[:, :3, None])[..., 0]
    half_size = (np.abs(rot) @ model.geom_aabb[:, 3:, None])[..., 0]
    is_obstacle = (
        ~np.isin(model.body_rootid[model.geom_bodyid], drones)
        & np.isin(model.geom_group, VISIBLE_GROUPS)
        & ~np.isin(model.geom_type, (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD))
        & ((middle + half_size)[:, 2] > MIN_OBSTACLE_TOP)
        & (np.abs(data.geom_xpos) < MAX_COORDINATE).all(-1)
    )
    return (middle - half_size)[is_obstacle, :2], (middle + half_size)[is_obstacle, :2]
