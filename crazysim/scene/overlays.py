"""Overlays that a user draws into the next picture: lines, points, capsules, labels and text."""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.errors import ConfigError, UnknownNameError

RED = (1.0, 0.0, 0.0, 1.0)

CORNERS = {
    "top left": mujoco.mjtGridPos.mjGRID_TOPLEFT,
    "top right": mujoco.mjtGridPos.mjGRID_TOPRIGHT,
    "bottom left": mujoco.mjtGridPos.mjGRID_BOTTOMLEFT,
    "bottom right": mujoco.mjtGridPos.mjGRID_BOTTOMRIGHT,
}
"""Where text may stand."""
LONGEST_LABEL = 99
"""Letters that MuJoCo keeps of a label."""


@dataclass
class Overlays:
    """What is drawn over the scene in the next picture only."""

    limit: int = 10_000
    """Most overlays that one picture takes."""
    _geoms: list[tuple] = field(default_factory=list)
    _texts: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return how many overlays wait for the next picture, text aside."""
        return len(self._geoms)

    def line(self, points: NDArray, rgba: ArrayLike, start_size: float, end_size: float) -> None:
        """Add a line through points (n, 3), its width in pixels going from one size to the other.

        Its colour is one for all of it, (4,), or one for each piece, (n - 1, 4).
        """
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

    def label(self, text: str, point: NDArray) -> None:
        """Add a line of text that is seen at a point (3,), in front of everything."""
        self._add([(mujoco.mjtGeom.mjGEOM_LABEL, 0.0, point, _readable(text, LONGEST_LABEL))], (1, 1, 1, 1))

    def text(self, text: str, corner: str) -> None:
        """Add text to a corner of the picture, below what is there already."""
        if corner not in CORNERS:
            raise UnknownNameError(f"a picture has no corner {corner!r}; its corners are {', '.join(CORNERS)}")
        above = self._texts.get(corner)
        self._texts[corner] = _readable(text) if above is None else f"{above}\n{_readable(text)}"

    def _add(self, geoms: list[tuple], rgba: ArrayLike) -> None:
        if len(self) + len(geoms) > self.limit:
            raise ValueError(
                f"a picture takes {self.limit} overlays at most; draw fewer, or raise sim.max_visual_geom before drawing"
            )
        colors = np.broadcast_to(np.asarray(rgba, np.float32), (len(geoms), 4))
        self._geoms += [(*geom, color) for geom, color in zip(geoms, colors, strict=True)]

    def write(self, scene: mujoco.MjvScene) -> None:
        """Append the overlays to a scene that is about to be drawn."""
        for kind, size, a, b, rgba in self._geoms:
            if scene.ngeom >= scene.maxgeom:
                raise ValueError(f"the picture is full: {scene.maxgeom} geoms; raise sim.max_visual_geom")
            geom = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(geom, kind, np.full(3, size), a, np.eye(3).ravel(), rgba)
            if isinstance(b, str):
                geom.label = b
            elif b is not None:
                mujoco.mjv_connector(geom, kind, size, a, np.asarray(b, float))
            scene.ngeom += 1

    @property
    def has_text(self) -> bool:
        """Whether there is text in a corner."""
        return bool(self._texts)

    def write_text(self, pixels: mujoco.MjrRect, context: mujoco.MjrContext) -> None:
        """Write the text of the corners over a picture that has just been drawn."""
        for corner, text in self._texts.items():
            mujoco.mjr_overlay(mujoco.mjtFont.mjFONT_NORMAL, CORNERS[corner], pixels, text, "", context)

    def clear(self) -> None:
        """Forget the overlays."""
        self._geoms.clear()
        self._texts.clear()

    def copy(self) -> Overlays:
        """Return overlays of their own that are the same."""
        return Overlays(self.limit, list(self._geoms), dict(self._texts))

    def restore(self, overlays: Overlays) -> None:
        """Have these overlays instead of what is there, as they were when ``copy`` was asked."""
        self._geoms[:], self._texts = overlays._geoms, dict(overlays._texts)


def _readable(text: str, longest: int | None = None) -> str:
    """Return text that MuJoCo's font can show.

    Raises:
        ConfigError: If it cannot.
    """
    if not isinstance(text, str) or not text:
        raise ConfigError(f"text must be a string with something in it, not {text!r}")
    strange = sorted({letter for letter in text if letter != "\n" and not 32 <= ord(letter) < 127})
    if strange:
        raise ConfigError(f"pictures have ASCII letters only; {text!r} has {''.join(strange)!r}")
    if longest is not None and (len(text) > longest or "\n" in text):
        raise ConfigError(f"a label is one line of {longest} letters at most, got {len(text)} letters: {text!r}")
    return text
