"""Maps: point clouds and triangle meshes as boxes that do not move."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.core.settings import as_rgba, positive_integer
from crazysim.engine.cache import announce_if_slow
from crazysim.errors import ConfigError, require, short_repr
from crazysim.lab.scene.map_files import MapFile, read_map
from crazysim.lab.scene.voxels import count_candidates, merge_voxels, voxels_of_points, voxels_of_triangles
from crazysim.scene.primitives import DRONE_TOUCH_BITS
from crazysim.tables import LENGTH, range_between, read_number, read_numbers

MapSource = str | Path | ArrayLike
"""Path of a ``.ply``, ``.pcd``, ``.stl`` or ``.obj`` file, or the points of a cloud, m. (n_points, 3)"""
MIN_EXTENT, MAX_EXTENT = 0.01, 10_000.0
"""Smallest and largest extent of a map without ``scale``, m."""
MAX_COORDINATE = 1e6
"""Largest coordinate of a map, m."""
MAX_VOXELS = 20_000_000
"""Largest number of points of a cloud, or of voxels near triangles; more would need several GB of memory."""
MAX_UNSCALED_VOXELS = 2_000_000
"""Largest number of voxels near triangles without ``scale``, which take about 5 s: more are mostly files in
millimetres."""
MAX_BOXES = 10_000
"""Largest number of boxes of a map."""


def map_spec(
    source: MapSource,
    resolution: float = 0.1,
    pos: ArrayLike = (0.0, 0.0, 0.0),
    quat: ArrayLike = (0.0, 0.0, 0.0, 1.0),
    scale: float | None = None,
    min_points: int = 1,
    rgba: ArrayLike = (0.62, 0.60, 0.57, 1.0),
) -> mujoco.MjSpec:
    """Return a spec with the boxes of a map in its world body; see ``Scene.add_map``."""
    resolution = read_number("resolution", resolution, LENGTH)
    min_points = positive_integer("min_points", min_points)
    points, triangles = _read_source(source)
    if not np.isfinite(points).all():
        n = int((~np.isfinite(points)).any(axis=1).sum())
        raise ConfigError(
            f"expected finite coordinates, got {n} of {len(points)} points that are not finite. Drop them."
        )
    # Points in metres; errors propose a likely unit.
    points = to_world_frame(points, pos, quat, scale)
    remedy, work = "Use a larger resolution=.", "finding the voxels of triangles"
    if scale is None:
        size = " x ".join(f"{x:.3g}" for x in np.ptp(points, axis=0))
        remedy += (
            f" The map is {size} m large: if the file is in millimetres, pass scale=0.001, and in metres scale=1.0."
        )
        work += f" of a map of {size} m (scale=0.001 if the file is in millimetres)"
    # Voxels of points, or of triangles.
    if triangles is None:
        _check_count("points", len(points), MAX_VOXELS, f"Use a part of the map. {remedy}")
        voxels = voxels_of_points(points, resolution, min_points)
        require(len(voxels), f"expected voxels with min_points={min_points} points, got none. Use a smaller number.")
    else:
        require(
            min_points <= 1, f"expected min_points=1 for triangles, got {min_points}. Only clouds have noise to drop."
        )
        corners = points[triangles]
        max_voxels = MAX_UNSCALED_VOXELS if scale is None else MAX_VOXELS
        label = f"voxels of {resolution:g} m near triangles"
        _check_count(label, count_candidates(corners, resolution), max_voxels, remedy)
        with announce_if_slow(work, "up to 2 minutes for large meshes"):
            voxels = voxels_of_triangles(corners, resolution)
    # Boxes that fill the same space.
    boxes = merge_voxels(voxels)
    require(
        len(boxes) <= MAX_BOXES,
        f"expected a map of at most {MAX_BOXES} boxes, got {len(boxes)} from {len(voxels)} voxels of {resolution} "
        f"m. {remedy}",
    )
    spec = mujoco.MjSpec()
    options = {"type": mujoco.mjtGeom.mjGEOM_BOX, "rgba": as_rgba(rgba), **DRONE_TOUCH_BITS}
    for first, last in zip(boxes[:, :3], boxes[:, 3:], strict=True):
        middle, half = (first + last) / 2 * resolution, (last - first + 1) / 2 * resolution
        spec.worldbody.add_geom(pos=middle, size=half, **options)
    return spec


def to_world_frame(points: NDArray, pos: ArrayLike, quat: ArrayLike, scale: float | None) -> NDArray[np.float64]:
    """Return points of a file in the world frame, m. (n, 3)

    Args:
        points: Finite points in the frame and unit of the file. (n, 3)
        pos: Origin of the file's frame, world frame, m. (3,)
        quat: Attitude of the file's frame, file to world, xyzw. (4,)
        scale: Metres per unit of the file; None for 1, which requires a plausible extent.
    """
    pos, rot, scale = read_frame(points, pos, quat, scale)
    points = scale * points @ rot.T + pos
    if np.abs(points).max() > MAX_COORDINATE:
        raise ConfigError(
            f"expected points within {MAX_COORDINATE:g} m of the origin, got one at {np.abs(points).max():.4g} m. Use "
            f"another pos= or scale=."
        )
    return points


def read_frame(
    points: NDArray, pos: ArrayLike, quat: ArrayLike, scale: float | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return position (3,), rotation matrix (3, 3) and scale of a file's frame, checked; see ``to_world_frame``."""
    pos = read_numbers("pos", pos, range_between(-MAX_COORDINATE, MAX_COORDINATE), ((3,),))
    quat = read_numbers("quat", quat, shapes=((4,),))
    require(np.linalg.norm(quat) > 0, "expected quat as a rotation, got zeros. Use (0, 0, 0, 1) for none.")
    rot = np.empty(9)
    mujoco.mju_quat2Mat(rot, np.roll(quat / np.linalg.norm(quat), 1))
    if scale is not None:
        return pos, rot.reshape(3, 3), read_number("scale", scale, range_between(positive=True))
    extent = float(np.ptp(points, axis=0).max())
    require(
        MIN_EXTENT <= extent <= MAX_EXTENT,
        f"expected a map in metres, of an extent of {MIN_EXTENT:g} to {MAX_EXTENT:g} m, got {extent:.4g}. Pass "
        f"scale=, the number of metres per unit of the file.",
    )
    return pos, rot.reshape(3, 3), 1.0


def _read_source(source: MapSource) -> MapFile:
    if isinstance(source, (str, Path)):
        return read_map(source)
    try:
        points = np.asarray(source, np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"expected a path or points, (n_points, 3), got {short_repr(source)}") from error
    require(
        points.ndim == 2 and points.shape[1] == 3 and len(points),
        f"expected points of a map, (n_points, 3), got an array of shape {points.shape}",
    )
    return MapFile(points, None)


def _check_count(label: str, n: int, limit: int, remedy: str) -> None:
    require(n <= limit, f"expected a map of at most {limit} {label}, got {n}. {remedy}")
