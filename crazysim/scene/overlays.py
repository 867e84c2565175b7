"""Overlays of the next image: lines, points, capsules, labels and text."""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.core.settings import as_rgba
from crazysim.errors import UnknownNameError, require

DEFAULT_COLOR = (1.0, 0.0, 0.0, 1.0)
"""Default colour of overlays, RGBA."""

IMAGE_CORNERS = {
    "top left": mujoco.mjtGridPos.mjGRID_TOPLEFT,
    "top right": mujoco.mjtGridPos.mjGRID_TOPRIGHT,
    "bottom left": mujoco.mjtGridPos.mjGRID_BOTTOMLEFT,
    "bottom right": mujoco.mjtGridPos.mjGRID_BOTTOMRIGHT,
}
"""Corners of an image for text."""
MAX_LABEL_LENGTH = 99
"""Largest number of characters of a label; MuJoCo cuts off longer labels."""


@dataclass
class Overlays:
    """Geoms and text that are drawn over the scene in the next image only."""

    limit: int = 10_000
    """Largest number of geoms in one image."""
    _geoms: list[tuple] = field(default_factory=list)
    _texts: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self._geoms)

    def line(self, points: NDArray, rgba: ArrayLike, start_size: float, end_size: float) -> None:
        """Add a line through points.

        Args:
            points: World frame, m. (n, 3)
            rgba: Colour of all segments, or one colour per segment. (4,) or (n - 1, 4)
            start_size: Width at the first point, pixels.
            end_size: Width at the last point, pixels.
        """
        widths = np.linspace(start_size, end_size, max(len(points) - 1, 1))
        segments = zip(points[:-1], points[1:], widths, strict=False)
        self._add([(mujoco.mjtGeom.mjGEOM_LINE, width, a, b) for a, b, width in segments], rgba)

    def points(self, points: NDArray, rgba: ArrayLike, size: float, emission: float = 0.0) -> None:
        """Add spheres of radius ``size``, m, at points, world frame, m, with an emission from 0 to 1. (n, 3)"""
        self._add([(mujoco.mjtGeom.mjGEOM_SPHERE, size, point, None) for point in points], rgba, emission)

    def capsule(self, p1: NDArray, p2: NDArray, radius: float, rgba: ArrayLike, cylinder: bool) -> None:
        """Add a capsule or cylinder between two points, world frame, m. (3,)"""
        kind = mujoco.mjtGeom.mjGEOM_CYLINDER if cylinder else mujoco.mjtGeom.mjGEOM_CAPSULE
        self._add([(kind, radius, p1, p2)], rgba)

    def label(self, text: str, point: NDArray) -> None:
        """Add a line of text at a point, world frame, m, in front of everything. (3,)"""
        self._add([(mujoco.mjtGeom.mjGEOM_LABEL, 0.0, point, _printable_text(text, MAX_LABEL_LENGTH))], (1, 1, 1, 1))

    def text(self, text: str, corner: str) -> None:
        """Add text to a corner of the image, below earlier text."""
        require(
            isinstance(corner, str) and corner in IMAGE_CORNERS,
            f"expected corner {' or '.join(map(repr, IMAGE_CORNERS))}, got {corner!r}",
            UnknownNameError,
        )
        texts_above = self._texts.get(corner)
        self._texts[corner] = (
            _printable_text(text) if texts_above is None else f"{texts_above}\n{_printable_text(text)}"
        )

    def _add(self, geoms: list[tuple], rgba: ArrayLike, emission: float = 0.0) -> None:
        require(
            len(self) + len(geoms) <= self.limit,
            f"expected at most {self.limit} overlays in one image, got {len(self) + len(geoms)}. Increase "
            f"sim.max_visual_geom before drawing.",
            ValueError,
        )
        colors = np.broadcast_to(as_rgba(rgba, len(geoms)).astype(np.float32), (len(geoms), 4))
        self._geoms += [(*geom, color, emission) for geom, color in zip(geoms, colors, strict=True)]

    def write(self, scene: mujoco.MjvScene) -> None:
        """Append the geoms to MuJoCo's scene before it is drawn."""
        for kind, size, start, end_or_label, rgba, emission in self._geoms:
            require(
                scene.ngeom < scene.maxgeom,
                f"expected at most {scene.maxgeom} geoms in one image, got more. Increase sim.max_visual_geom.",
                ValueError,
            )
            geom = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(geom, kind, np.full(3, size), start, np.eye(3).ravel(), rgba)
            geom.emission = emission
            if isinstance(end_or_label, str):
                geom.label = end_or_label
            elif end_or_label is not None:
                mujoco.mjv_connector(geom, kind, size, start, np.asarray(end_or_label, float))
            scene.ngeom += 1

    @property
    def has_text(self) -> bool:
        return bool(self._texts)

    def write_text(self, rectangle: mujoco.MjrRect, context: mujoco.MjrContext) -> None:
        """Draw the text of the corners over an image that has been drawn in a rectangle, pixels."""
        for corner, text in self._texts.items():
            mujoco.mjr_overlay(mujoco.mjtFont.mjFONT_NORMAL, IMAGE_CORNERS[corner], rectangle, text, "", context)

    def clear(self) -> None:
        self._geoms.clear()
        self._texts.clear()

    def copy(self) -> Overlays:
        """Return a copy that later changes do not affect."""
        return Overlays(self.limit, list(self._geoms), dict(self._texts))

    def restore(self, overlays: Overlays) -> None:
        """Replace geoms and text by the contents of a copy."""
        self._geoms[:], self._texts = overlays._geoms, dict(overlays._texts)


def _printable_text(text: str, max_length: int | None = None) -> str:
    require(isinstance(text, str) and text, f"expected a string that is not empty as text, got {text!r}")
    unprintable = sorted({character for character in text if character != "\n" and not 32 <= ord(character) < 127})
    require(not unprintable, f"expected ASCII text, got {text!r} with {''.join(unprintable)!r}")
    require(
        max_length is None or (len(text) <= max_length and "\n" not in text),
        f"expected a label of one line and at most {max_length} characters, got {len(text)}: {text!r}",
    )
    return text
