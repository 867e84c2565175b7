"""Rendering for the adapters to other libraries: images of some worlds, or a window."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from crazysim.envs.state import EnvState
from crazysim.errors import ConfigError
from crazysim.sim.sim import Sim

RENDER_MODES = ("rgb_array", "human")
"""Values of ``render_mode`` besides None."""


class Renderer:
    """Renders worlds of a simulation in a given state."""

    def __init__(self, sim: Sim, mode: str | None, worlds: Sequence[int] = (0,), size: tuple[int, int] = (640, 480)):
        """Take the simulation and the mode.

        Args:
            sim: The simulation of the states.
            mode: ``"rgb_array"`` for images, ``"human"`` for the first world in a window, None for no rendering.
            worlds: Worlds to render.
            size: Width and height of an image, pixels.

        Raises:
            ConfigError: If there is no such mode.
        """
        if mode not in (None, *RENDER_MODES):
            raise ConfigError(f"expected render_mode None, {' or '.join(RENDER_MODES)}, got {mode!r}")
        self.sim, self.mode, self.worlds, self.size = sim, mode, tuple(worlds), size

    def __call__(self, state: EnvState | None) -> list[np.ndarray]:
        """Return an image of each world, (height, width, 3), or an empty list after drawing into the window.

        Raises:
            ConfigError: If the environment was made without ``render_mode``, or was not reset.
            RenderError: If this machine cannot render.
        """
        if self.mode is None or state is None:
            raise ConfigError(
                "expected an environment with render_mode='rgb_array' or 'human' after its reset, got none. Make it so."
            )
        self.sim.data = state.data
        width, height = self.size
        if self.mode == "human":
            self.sim.render("human", self.worlds[0], width=width, height=height)
            return []
        return [np.asarray(self.sim.render("rgb_array", w, width=width, height=height)) for w in self.worlds]
