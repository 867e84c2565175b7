"""A plot over time in a corner of a window, drawn as a MuJoCo figure."""

from __future__ import annotations

import mujoco
import numpy as np

from crazysim.media.picture import Picture
from crazysim.media.trail import COLORS

MAX_SAMPLES = 400
"""Largest number of samples of a line."""
MAX_LINES = 6
"""Largest number of lines."""
PLOT_FRACTION = 0.3
"""Width and height of the plot, as a fraction of the width and height of the window."""


class Chart:
    """Plot of one quantity over time, with a line for each of its numbers."""

    def __init__(self, name: str):
        self._name, self._selected_drone = name, None
        self._times: list[float] = []
        self._values: list[np.ndarray] = []
        self._figure = figure = mujoco.MjvFigure()
        mujoco.mjv_defaultFigure(figure)
        figure.title, figure.flg_extend, figure.gridsize[:] = name, 1, (4, 4)
        figure.figurergba[3] = 0.5
        for k in range(MAX_LINES):
            figure.linergb[k] = COLORS[k % len(COLORS), :3]

    def add(self, picture: Picture) -> None:
        """Add the values of a picture; the chart restarts for another drone or after a jump back in time."""
        values = picture.plot[:MAX_LINES]
        must_restart = self._times and (picture.time < self._times[-1] or len(values) != len(self._values[-1]))
        if must_restart or picture.selected != self._selected_drone:
            self._times.clear()
            self._values.clear()
        self._selected_drone = picture.selected
        if len(values) and np.isfinite(values).all() and (not self._times or picture.time > self._times[-1]):
            self._times.append(picture.time)
            self._values.append(values)
            del self._times[:-MAX_SAMPLES], self._values[:-MAX_SAMPLES]

    def draw(self, window: mujoco.MjrRect, context: mujoco.MjrContext) -> None:
        """Draw the lines into the lower right corner of a window."""
        n = len(self._times)
        if n < 2:
            return
        lines = np.stack(self._values).T
        for k, line in enumerate(lines):
            self._figure.linepnt[k] = n
            self._figure.linedata[k, : 2 * n] = np.stack([self._times, line], axis=-1).ravel()
        low, high = float(lines.min()), float(lines.max())
        margin = max(0.05 * (high - low), 1e-3)
        self._figure.range[:] = (self._times[0], self._times[-1]), (low - margin, high + margin)
        width, height = int(PLOT_FRACTION * window.width), int(PLOT_FRACTION * window.height)
        corner = mujoco.MjrRect(window.left + window.width - width, window.bottom, width, height)
        mujoco.mjr_figure(corner, self._figure, context)
