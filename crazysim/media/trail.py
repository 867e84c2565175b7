"""Trails: the recent positions of drones, as lines that fade towards their beginning."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.core.settings import as_rgba
from crazysim.errors import ConfigError, require
from crazysim.scene.overlays import Overlays

COLORS = np.array([[0.90, 0.30, 0.20, 1], [0.15, 0.50, 0.85, 1], [0.20, 0.65, 0.35, 1], [0.85, 0.60, 0.10, 1]])
"""Default colours of drones, repeated in this order, rgba. (4, 4)"""
MIN_ALPHA = 0.15
"""Opacity of a trail's beginning, 0 to 1."""


def choose_drone_colors(n_drones: int, rgba: ArrayLike | None) -> NDArray:
    """Return a colour for each drone: ``rgba``, or the colours ``COLORS`` if it is None. (n_drones, 4)"""
    if rgba is None:
        return COLORS[np.arange(n_drones) % len(COLORS)]
    return np.broadcast_to(as_rgba(rgba, n_drones), (n_drones, 4))


class Trail:
    """Positions of the drones of some worlds over the last seconds.

    A world whose time decreases has been reset, and its trail begins again.
    """

    def __init__(self, seconds: float):
        require(
            isinstance(seconds, (int, float, np.number)) and 0 < seconds < np.inf,
            f"expected a positive duration of a trail, s, got {seconds!r}",
        )
        self.seconds = float(seconds)
        self._samples: deque[tuple[NDArray, NDArray]] = deque()

    def __len__(self) -> int:
        return len(self._samples)

    def add(self, time: ArrayLike, pos: ArrayLike) -> None:
        """Add a sample. A second sample at the same time replaces the first.

        Args:
            time: Time of each world, s. (n_worlds,)
            pos: Positions of the drones, world frame, m. (n_worlds, n_drones, 3)
        """
        times, pos = np.array(time, float), np.array(pos, float)
        require(
            pos.ndim == 3 and pos.shape[2] == 3 and times.shape == pos.shape[:1],
            f"expected times of shape (n_worlds,) and positions of shape (n_worlds, n_drones, 3), got "
            f"{times.shape} and {pos.shape}",
        )
        if self._samples and self._samples[-1][1].shape != pos.shape:
            raise ConfigError(f"expected positions of shape {self._samples[-1][1].shape}, as before, got {pos.shape}")
        if self._samples and (self._samples[-1][0] == times).all():
            self._samples.pop()
        self._samples.append((times, pos))
        while all(self._has_expired(self._samples[0][0], times)):
            self._samples.popleft()

    def _has_expired(self, sample_time: NDArray, time: NDArray) -> NDArray:
        return (sample_time < time - self.seconds - 1e-6) | (sample_time > time)

    def path(self, world: int) -> NDArray:
        """Return the positions of the drones of a world, oldest first, m. (n, n_drones, 3)

        They begin ``seconds`` before the last sample, or at the last reset of the world if that is later.

        Args:
            world: Index of the world in the arrays that ``add`` receives.
        """
        path: list[NDArray] = []
        next_time = np.inf
        for time, pos in reversed(self._samples):
            if time[world] > next_time or time[world] < self._samples[-1][0][world] - self.seconds - 1e-6:
                break
            next_time = time[world]
            path.append(pos[world])
        return np.stack(path[::-1]) if path else np.zeros((0, 0, 3))

    def draw(self, overlays: Overlays, world: int = 0, rgba: ArrayLike | None = None, width: float = 3.0) -> None:
        """Add the trails of a world to overlays.

        Args:
            overlays: Overlays of the next image, ``sim.overlays``.
            world: Index of the world in the arrays that ``add`` receives.
            rgba: Colour, one or one per drone; None for ``COLORS``. (4,) or (n_drones, 4)
            width: Width at the drone, pixels.
        """
        draw_paths(overlays, self.path(world), rgba, width)


def draw_paths(overlays: Overlays, path: NDArray, rgba: ArrayLike | None = None, width: float = 3.0) -> None:
    """Add lines through successive positions of drones, which fade towards their beginning, to overlays.

    Args:
        overlays: Overlays of the next image.
        path: Positions, oldest first, m. (n, n_drones, 3)
        rgba: Colour, one or one per drone; None for ``COLORS``. (4,) or (n_drones, 4)
        width: Width at the drone, pixels.
    """
    if len(path) < 2:
        return
    fade = np.linspace(MIN_ALPHA, 1.0, len(path) - 1)[:, None] ** [0, 0, 0, 1]
    is_moving = (np.ptp(path, axis=0) > 0).any(-1)
    colors = choose_drone_colors(path.shape[1], rgba)
    for drone in np.flatnonzero(is_moving):
        overlays.line(path[:, drone], colors[drone] * fade, 1.0, width)
