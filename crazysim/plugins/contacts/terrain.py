"""Terrain: a height field as the ground of all worlds."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from crazysim.core.data import SimData
from crazysim.core.plugin import Simulation, StagePlacement
from crazysim.core.settings import as_rgba
from crazysim.core.stages import stop_at_ground
from crazysim.engine.pytree import device_array
from crazysim.errors import ConfigError
from crazysim.plugins.contacts.response import ContactResponse
from crazysim.plugins.effects.grid import MAX_FUSED_VALUES, UNFUSED_REASON
from crazysim.plugins.effects.ground import HeightField, ground_below, ground_height
from crazysim.storage import read_bytes

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
"""First bytes of a PNG image. Bytes 16 to 23 of the file are width and height."""
MAX_FILE_BYTES = 256 * 2**20
"""Largest size of an image file, bytes."""
MAX_PIXELS = 2**24
"""Largest number of pixels of an image, 4096 x 4096, which take 0.5 GB."""
BASE_THICKNESS = 1.0
"""Thickness of the ground below the lowest height, m."""
MIN_HEIGHT_RANGE = 1e-3
"""Smallest range of heights that is set for MuJoCo's height field, m, also for flat terrain."""


class Terrain(HeightField):
    """A height field on which drones and loads land; replaces the stage ``clip_floor_pos``.

    It is part of the scene: images, range finders and depth cameras include it, and it is the floor in contact reports
    and for a ``ContactResponse``, which must be added after it.
    """

    name: str = "terrain"

    def bind(self, sim: Simulation) -> Terrain:
        heights, size, pos = self._check_heights(sim)
        dtype = sim.data.states.pos.dtype
        half_size = device_array(size / 2, dtype)
        bound = self.with_arrays(sim, heights=device_array(heights, dtype), half_size=half_size)
        _set_height_field(sim.scene, self, heights, size, pos)
        return bound.replace(height_below=bound.surface_at(sim.data.states.pos)[0])

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        scope = "drone" if self._check_heights(sim)[0].size <= MAX_FUSED_VALUES else "batch"
        details: Any = {"batched": True, "unfused_reason": UNFUSED_REASON, "ground": ground_below}
        stop_stage = self.stage(self.stop_drones, scope, **details)
        return [StagePlacement(stop_stage, before="measurements", replaces="clip_floor_pos")]

    def stop_drones(self, data: SimData) -> SimData:
        """Return the data with drones that are below the ground, or on it and not rising, on the ground at rest."""
        ground = ground_height(data, data.states.pos)
        states = stop_at_ground(data.states, ground)
        return self.write(data.replace(states=states), self.replace(height_below=ground))

    def _check_heights(self, sim: Simulation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        source = self.heights
        is_image = isinstance(source, (str, Path))
        size, pos = np.asarray(self.size, np.float64), np.asarray(self.pos, np.float64)
        n = 3 if is_image else 2
        if size.shape != (n,):
            raise ConfigError(
                f"expected size as {n} positive lengths, m, {'along x, y and z' if is_image else 'along x and y'}, "
                f"got {self.size!r}"
            )
        heights = size[2] * read_image(source) if isinstance(source, (str, Path)) else np.asarray(source, np.float64)
        if heights.ndim != 2 or min(heights.shape) < 2:
            raise ConfigError(
                f"expected heights of two or more rows and columns, m, got shape {np.shape(heights)}. Use a 2-D array."
            )
        if self.floor and heights.min() + pos[2] < 0:
            raise ConfigError(
                f"expected heights of at least 0 m above the flat floor, got {heights.min() + pos[2]:.4g} m. Use "
                f"floor=False to remove the flat floor, or a higher pos."
            )
        if any(isinstance(plugin, ContactResponse) for plugin in sim.scene.plugins()):
            raise ConfigError(
                "expected terrain before contact response, which replaces the stage that stops drones at the floor, "
                "got a ContactResponse. Use sim.remove, then add Terrain and ContactResponse in this order."
            )
        return heights, size[:2], pos


def read_image(path: str | Path) -> np.ndarray:
    """Return the brightness of a PNG image, its lowest row first, from 0 at the darkest pixel to 1. (n_rows, n_columns)

    MuJoCo reads the image with 8 bits per pixel.

    Raises:
        ConfigError: If the file cannot be read, is no PNG image, or has more than ``MAX_PIXELS`` pixels.
    """
    content = read_bytes(path, MAX_FILE_BYTES)
    size = struct.unpack(">II", content[16:24]) if content[:8] == PNG_SIGNATURE and len(content) >= 24 else (0, 0)
    if not 0 < size[0] * size[1] <= MAX_PIXELS:
        raise ConfigError(
            f"expected a PNG image of heights of at most {MAX_PIXELS} pixels, got {str(path)!r} of "
            f"{size[0]} x {size[1]} pixels. Use a smaller image, or convert it to PNG."
        )
    spec = mujoco.MjSpec()
    spec.add_hfield(name="image", file=str(path), size=[1, 1, 1, 1])
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="image")
    try:
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ConfigError(f"expected a PNG image of heights, got {str(path)!r}: {error}") from error
    return np.asarray(model.hfield_data, np.float64).reshape(int(model.hfield_nrow[0]), int(model.hfield_ncol[0]))


def _set_height_field(scene: Any, plugin: Terrain, heights: np.ndarray, size: np.ndarray, pos: np.ndarray) -> None:
    spec, min_height = scene.spec, float(heights.min())
    height_range = max(float(np.ptp(heights)), MIN_HEIGHT_RANGE)
    fractions = ((heights - min_height) / height_range).astype(np.float32)
    field, geom = spec.hfield(plugin.name), spec.geom(plugin.name)
    if (field is None) != (geom is None):
        raise ConfigError(f"expected a new name, got {plugin.name!r}, which the scene has. Use name=.")
    if field is None:
        field = spec.add_hfield(name=plugin.name)
        geom = spec.worldbody.add_geom(name=plugin.name, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=plugin.name)
    field.size = [*(size / 2), height_range, BASE_THICKNESS]
    field.nrow, field.ncol = heights.shape
    field.userdata = fractions.ravel()
    geom.pos = [pos[0], pos[1], pos[2] + min_height]
    if plugin.rgba is not None:
        geom.rgba = as_rgba(plugin.rgba)
    elif spec.material("floor") is not None:
        geom.material = "floor"
    if not plugin.floor:
        for plane in [g for g in spec.worldbody.geoms if g.type == mujoco.mjtGeom.mjGEOM_PLANE]:
            spec.delete(plane)
    scene.revision += 1
