"""How the environments of other libraries draw: pictures of some worlds, or a window."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from crazysim.envs.env import EnvState
from crazysim.errors import ConfigError
from crazysim.sim.sim import Sim

RENDER_MODES = ("rgb_array", "human")
"""What ``render_mode`` may be besides None."""


class Drawing:
    """Draws worlds of a simulation as a state has them."""

    def __init__(self, sim: Sim, mode: str | None, worlds: Sequence[int] = (0,), size: tuple[int, int] = (640, 480)):
        """Take what to draw.

        Args:
            sim: The simulation that the state is of.
            mode: ``"rgb_array"`` for pictures, ``"human"`` for the first world in a window, None for nothing.
            worlds: Which worlds are drawn.
            size: Width and height of a picture, pixels.

        Raises:
            ConfigError: If there is no such mode.
        """
        if mode not in (None, *RENDER_MODES):
            raise ConfigError(f"render_mode is {mode!r}; it must be None or one of {', '.join(RENDER_MODES)}")
        self.sim, self.mode, self.worlds, self.size = sim, mode, tuple(worlds), size

    def __call__(self, state: EnvState | None) -> list[np.ndarray]:
        """Return a picture of each world, (height, width, 3), or none after drawing into the window.

        Raises:
            ConfigError: If nothing was said of drawing when the environment was made, or it was not reset.
            RenderError: If this machine cannot draw.
        """
        if self.mode is None or state is None:
            raise ConfigError("to render, make the environment with render_mode='rgb_array' or 'human', and reset it")
        self.sim.data = state.data
        width, height = self.size
        if self.mode == "human":
            self.sim.render("human", self.worlds[0], width=width, height=height)
            return []
        return [np.asarray(self.sim.render("rgb_array", w, width=width, height=height)) for w in self.worlds]
