"""Pictures: everything that a viewer draws at one moment, whether of a live simulation or of a recorded flight."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

LIGHT_RADIUS = 0.06
"""Radius of the glow around a lit drone, m."""
LIGHT_ALPHA = 0.6
"""Opacity of that glow, 0 to 1."""
SETPOINT_RADIUS = 0.02
"""Radius of a setpoint's sphere, m."""
WIND_COLOR = (0.35, 0.6, 0.8, 0.9)
"""Colour of the arrows of the wind, rgba."""
WIND_RADIUS = 0.006
"""Radius of these arrows, m."""


class Spheres(NamedTuple):
    """Spheres of one kind, in every world that is shown."""

    pos: NDArray
    """Positions, world frame, m. (n, k, 3)"""
    is_shown: NDArray
    """Whether a sphere is shown. (n, k)"""
    rgba: NDArray
    """Colours, 0 to 1. (n, k, 4)"""
    radius: float
    """Radius, m."""
    emission: float = 0.0
    """Emission, 0 to 1."""


class Focus(NamedTuple):
    """The body that viewers mark and follow."""

    shown_index: int
    """Index of its world among the worlds that are shown."""
    pos: NDArray
    """Position, world frame, m. (3,)"""
    radius: float
    """Radius of its mark, m."""
    name: str
    """Name."""


@dataclass(frozen=True, eq=False)
class Picture:
    """Everything that a viewer draws of the worlds that it shows, at one moment."""

    worlds: NDArray
    """Indices of the worlds that are shown. (n,)"""
    time: float
    """Simulated time since the last reset, s."""
    pos: NDArray
    """Positions of all mocap bodies, world frame, m. (n, n_mocap, 3)"""
    quat: NDArray
    """Attitudes of all mocap bodies, body to world, xyzw. (n, n_mocap, 4)"""
    spheres: dict[str, Spheres]
    """Setpoints, contacts, lights and the mark of the followed body, by name."""
    lights: NDArray
    """Colours of the drones' LEDs, 0 to 1; zero for off. (n, n_drones, 3)"""
    wind: NDArray = field(default_factory=lambda: np.zeros((0, 0, 2, 3)))
    """Start and end of an arrow along the wind at every drone, world frame, m. (n, n_drones or 0, 2, 3)"""
    trail: NDArray = field(default_factory=lambda: np.zeros((0, 0, 0, 3)))
    """Positions of the bodies that have trails at equal intervals, oldest first, m. (length, n, k, 3)"""
    focus: Focus | None = None
    """The followed body; None if there is none, or its world is not shown."""
    status: str = ""
    """Time, speed, pause and recording as text."""
    selected: tuple[int, int] | None = None
    """World and index of the selected drone; None if no drone is selected."""
    widget_lines: tuple[str, ...] = ()
    """Lines of text that list the buttons and sliders of the loop, for viewers without a panel."""
    plot: NDArray = field(default_factory=lambda: np.zeros(0))
    """Values of the plotted quantity; empty if nothing is plotted. (k,)"""


def light_spheres(pos: NDArray, colors: NDArray) -> Spheres:
    """Return the glow around drones, (n, n_drones, 3), whose LEDs have colours from 0 to 1, (n, n_drones, 3)."""
    return Spheres(pos, colors.max(-1) > 0, np.insert(colors, 3, LIGHT_ALPHA, axis=-1), LIGHT_RADIUS, emission=1.0)


def setpoint_spheres(pos: NDArray, colors: NDArray) -> Spheres:
    """Return spheres at setpoints, (n, n_drones, 3), in the colours of the drones, (n_drones, 4)."""
    rgba = np.broadcast_to(colors[: pos.shape[1]], (*pos.shape[:2], 4))
    return Spheres(pos, np.ones(pos.shape[:2], bool), rgba, SETPOINT_RADIUS)
