"""Where drones have been: the last seconds of their way, as lines that fade towards their beginning."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.errors import ConfigError
from crazysim.scene.overlays import Overlays

COLORS = np.array([[0.90, 0.30, 0.20, 1], [0.15, 0.50, 0.85, 1], [0.20, 0.65, 0.35, 1], [0.85, 0.60, 0.10, 1]])
"""Colours that tell drones apart, one after the other, rgba. (4, 4)"""
FAINTEST = 0.15
"""How much of a trail's beginning is seen, 0 to 1."""


def colors_of(n_drones: int, rgba: ArrayLike | None) -> NDArray:
    """Return a colour for each drone: the given one, those given for each, or else what tells them apart. (n, 4)"""
    return COLORS[np.arange(n_drones) % len(COLORS)] if rgba is None else np.broadcast_to(rgba, (n_drones, 4))


class Trail:
    """The way of the drones of some worlds over the last seconds.

    A world whose time goes back has been reset, and leaves its old way behind.
    """

    def __init__(self, seconds: float):
        """Begin without a past.

        Args:
            seconds: Time that is kept, s.

        Raises:
            ConfigError: If there is no such time.
        """
        if not np.isfinite(seconds) or seconds <= 0:
            raise ConfigError(f"a trail of {seconds} s cannot be; its time must be positive")
        self.seconds = float(seconds)
        self._past: deque[tuple[NDArray, NDArray]] = deque()

    def __len__(self) -> int:
        """Return how many moments are kept."""
        return len(self._past)

    def add(self, time: ArrayLike, pos: ArrayLike) -> None:
        """Keep where the drones are; a second call at the same time replaces the first.

        Args:
            time: Time of each world, s. (n_worlds,)
            pos: World frame, m. (n_worlds, n_drones, 3)

        Raises:
            ConfigError: If the shapes do not go together, or are not those of earlier calls.
        """
        now, places = np.array(time, float), np.array(pos, float)
        if places.ndim != 3 or places.shape[2] != 3 or now.shape != places.shape[:1]:
            raise ConfigError(
                f"a trail takes times (n_worlds,) and positions (n_worlds, n_drones, 3), got {now.shape} and "
                f"{places.shape}"
            )
        if self._past and self._past[-1][1].shape != places.shape:
            raise ConfigError(f"this trail has positions of shape {self._past[-1][1].shape}, got {places.shape}")
        if self._past and (self._past[-1][0] == now).all():
            self._past.pop()
        self._past.append((now, places))
        while all(self._gone(self._past[0][0], now)):
            self._past.popleft()

    def _gone(self, then: NDArray, now: NDArray) -> NDArray:
        return (then < now - self.seconds - 1e-6) | (then > now)

    def way(self, world: int) -> NDArray:
        """Return the way of the drones of a world since its last reset, oldest first, m. (n, n_drones, 3)

        Args:
            world: Which of the worlds that ``add`` gets, counted from 0.
        """
        way: list[NDArray] = []
        later = np.inf
        for then, places in reversed(self._past):
            if then[world] > later or then[world] < self._past[-1][0][world] - self.seconds - 1e-6:
                break
            later = then[world]
            way.append(places[world])
        return np.stack(way[::-1]) if way else np.zeros((0, 0, 3))

    def draw(self, overlays: Overlays, world: int = 0, rgba: ArrayLike | None = None, width: float = 3.0) -> None:
        """Add the lines to what is drawn into the next picture, ``sim.overlays``.

        Args:
            overlays: What they are added to.
            world: Which of the worlds that ``add`` gets, counted from 0.
            rgba: Colour, one or one per drone; None for colours that tell drones apart. (4,) or (n_drones, 4)
            width: Width at the drone, pixels.
        """
        way = self.way(world)
        if len(way) < 2:
            return
        fade = np.linspace(FAINTEST, 1.0, len(way) - 1)[:, None] ** [0, 0, 0, 1]
        for drone, color in enumerate(colors_of(way.shape[1], rgba)):
            overlays.line(way[:, drone], color * fade, 1.0, width)
