"""Circles: the flight of ``crazysim live`` without a pilot."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from crazysim.lab.live.loop import Live

HEIGHT = 1.0
"""Height of the circles above the initial positions, m."""
RADIUS = 0.3
"""Radius of the circles, m."""
CIRCLE_DURATION = 4.0
"""Duration of one circle, s."""
CLIMB_DURATION = 2.0
"""Time in which the drones rise to their circles, s."""


class Circles:
    """Process that makes the drones rise and fly circles that pass above their initial positions."""

    def __init__(self, live: Live, piloted: bool):
        self._initial_pos = np.asarray(live.sim.data.states.pos, float).copy()
        self._is_piloted = piloted

    def __call__(self, live: Live) -> None:
        command = circle_commands(self._initial_pos, live.time)
        if self._is_piloted:
            if live.time > CLIMB_DURATION:
                command[0, 0] = live.command[0, 0]
            else:
                command[0, 0, :2], command[0, 0, 3:9] = self._initial_pos[0, 0, :2], 0.0
        live.command[:] = command


def circle_commands(initial_pos: NDArray, time: float) -> NDArray:
    """Return state commands of drones that rise above positions while they circle. (n_worlds, n_drones, 16)

    Args:
        initial_pos: Initial positions, m. (n_worlds, n_drones, 3)
        time: Time since the start, s.
    """
    time_fraction = np.clip(time / CLIMB_DURATION, 0.0, 1.0)
    climb_fraction = time_fraction**2 * (3 - 2 * time_fraction)
    omega = 2 * np.pi / CIRCLE_DURATION
    c, s = np.cos(omega * time), np.sin(omega * time)
    command = np.zeros((*initial_pos.shape[:2], 16))
    command[..., :3] = initial_pos + climb_fraction * np.array([RADIUS * (c - 1), RADIUS * s, HEIGHT])
    command[..., 3:6] = climb_fraction * RADIUS * omega * np.array([-s, c, 0.0])
    command[..., 6:9] = climb_fraction * RADIUS * omega**2 * np.array([-c, -s, 0.0])
    command[..., 12] = 1.0
    return command
