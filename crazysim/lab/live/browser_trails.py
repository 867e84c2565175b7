"""Trails in a browser, drawn as one set of line segments."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.media.trail import MIN_ALPHA

TRAIL_PERIOD = 0.05
"""Time between two samples of a trail, s."""
FLOOR_GREY = 0.8
"""Grey that trails fade to, 0 to 1."""


class Trails:
    """The recent positions of all bodies, as one set of a fixed number of line segments."""

    def __init__(self, scene: Any, pos: NDArray, colors: NDArray, seconds: float):
        self._length = max(round(seconds / TRAIL_PERIOD), 1)
        self._samples: deque[NDArray] = deque(maxlen=self._length)
        self._last_time = -np.inf
        pos = finite_rows(pos)
        # Lines are opaque, so they fade to the grey of the floor.
        fade = np.linspace(MIN_ALPHA, 1.0, self._length)[:, None, None]
        shades = np.round(255 * (FLOOR_GREY - fade * (FLOOR_GREY - colors))).astype(np.uint8)
        self._handle = scene.add_line_segments(
            "/world/trails", self._make_segments(pos), np.repeat(shades.reshape(-1, 1, 3), 2, axis=1), thickness=2.0,
            thickness_units="screen",
        )  # fmt: skip

    def update(self, time: float, pos: NDArray, visible: bool) -> None:
        """Add a sample and redraw the trails if a sample is due; a jump back in time clears them."""
        self._handle.visible = visible
        if time < self._last_time:
            self._samples.clear()
            self._last_time = -np.inf
        if time - self._last_time < TRAIL_PERIOD:
            return
        self._samples.append(pos)
        self._last_time = time
        if visible:
            self._handle.points = self._make_segments(pos)

    def _make_segments(self, pos: NDArray) -> NDArray:
        path = [*self._samples, pos]
        path = [path[0]] * (self._length + 1 - len(path)) + path
        points = np.stack(path[-self._length - 1 :])
        return np.stack([points[:-1], points[1:]], axis=2).reshape(-1, 2, 3).astype(np.float32)


def finite_rows(values: NDArray, fill_value: ArrayLike = 0.0) -> NDArray:
    """Return rows of numbers, (..., k), with rows that are not finite replaced by ``fill_value``, () or (k,)."""
    is_invalid = ~np.isfinite(values).all(-1, keepdims=True)
    return np.where(is_invalid, np.asarray(fill_value, float), values)
