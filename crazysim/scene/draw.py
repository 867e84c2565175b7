"""Marks that a user draws into the next picture: lines, points and capsules."""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

RED = (1.0, 0.0, 0.0, 1.0)


@dataclass
class Marks:
    """What is drawn over the scene in the next picture only."""

    limit: int = 10_000
    """Most marks that one picture takes."""
    _geoms: list[tuple] = field(default_factory=list)

    def __len__(self) -> int:
        """Return how many marks wait for the next picture."""
        return len(self._geoms)

    def line(self, points: NDArray, rgba: ArrayLike, start_size: float, end_size: float) -> None:
        """Add a line through points (n, 3), its width in pixels going from one size to the other."""
        widths = np.linspace(start_size, end_size, max(len(points) - 1, 1))
        pieces = zip(points[:-1], points[1:], widths, strict=False)
        self._add([(mujoco.mjtGeom.mjGEOM_LINE, width, a, b) for a, b, width in pieces], rgba)

    def points(self, points: NDArray, rgba: ArrayLike, size: float) -> None:
        """Add spheres of a radius, m, at points (n, 3)."""
        self._add([(mujoco.mjtGeom.mjGEOM_SPHERE, size, point, None) for point in points], rgba)

    def capsule(self, p1: NDArray, p2: NDArray, radius: float, rgba: ArrayLike, cylinder: bool) -> None:
        """Add a capsule or cylinder of a radius, m, between two points."""
        kind = mujoco.mjtGeom.mjGEOM_CYLINDER if cylinder else mujoco.mjtGeom.mjGEOM_CAPSULE
        self._add([(kind, radius, p1, p2)], rgba)

    def _add(self, geoms: list[tuple], rgba: ArrayLike) -> None:
        if len(self) + len(geoms) > self.limit:
            raise ValueError(
                f"a picture takes {self.limit} marks at most; draw fewer, or raise sim.max_visual_geom before drawing"
            )
        rgba = np.broadcast_to(np.asarray(rgba, np.float32), (4,))
        self._geoms += [(*geom, rgba) for geom in geoms]

    def write(self, scene: mujoco.MjvScene) -> None:
        """Append the marks to a scene that is about to be drawn."""
        for kind, size, a, b, rgba in self._geoms:
            if scene.ngeom >= scene.maxgeom:
                raise ValueError(f"the picture is full: {scene.maxgeom} geoms; raise sim.max_visual_geom")
            geom = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(geom, kind, np.full(3, size), a, np.eye(3).ravel(), rgba)
            if b is not None:
                mujoco.mjv_connector(geom, kind, size, a, np.asarray(b, float))
            scene.ngeom += 1

    def clear(self) -> None:
        """Forget the marks."""
        self._geoms.clear()
