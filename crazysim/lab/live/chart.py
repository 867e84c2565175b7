"""A plot over time in a corner of a window, drawn as a MuJoCo figure."""

from __future__ import annotations

import mujoco
import numpy as np

from crazysim.lab.live.picture import PlotSamples
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
        self._name, self._samples = name, PlotSamples(MAX_SAMPLES)
        self._figure = figure = mujoco.MjvFigure()
        mujoco.mjv_defaultFigure(figure)
        figure.title, figure.flg_extend, figure.gridsize[:] = name, 1, (4, 4)
        figure.figurergba[3] = 0.5
        for k in range(MAX_LINES):
            figure.linergb[k] = COLORS[k % len(COLORS), :3]

    def add(self, picture: Picture) -> None:
        self._samples.add(picture, self._name, MAX_LINES)

    def draw(self, window: mujoco.MjrRect, context: mujoco.MjrContext) -> None:
        """Draw the lines into the lower right corner of a window."""
        n = len(self._samples)
        if n < 2:
            return
        times, lines = self._samples.arrays()
        for k, line in enumerate(lines):
            self._figure.linepnt[k] = n
            self._figure.linedata[k, : 2 * n] = np.stack([times, line], axis=-1).ravel()
        low, high = float(lines.min()), float(lines.max())
        margin = max(0.05 * (high - low), 1e-3)
        self._figure.range[:] = (times[0], times[-1]), (low - margin, high + margin)
        width, height = int(PLOT_FRACTION * window.width), int(PLOT_FRACTION * window.height)
        corner = mujoco.MjrRect(window.left + window.width - width, window.bottom, width, height)
        mujoco.mjr_figure(corner, self._figure, context)
