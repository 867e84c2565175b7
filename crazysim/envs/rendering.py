"""Rendering for the adapters to other libraries: images of chosen worlds, or a window."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from crazysim.core.settings import check_image_size
from crazysim.envs.state import EnvState
from crazysim.errors import expect, require
from crazysim.sim.sim import Sim

RENDER_MODES = ("rgb_array", "human")
"""Values of ``render_mode`` besides None."""


class Renderer:
    """Renderer of environment states: images of chosen worlds, or a window."""

    def __init__(
        self, sim: Sim, mode: str | None, worlds: Sequence[int] | None = (0,), size: tuple[int, int] = (640, 480)
    ):
        require(
            mode is None or (isinstance(mode, str) and mode in RENDER_MODES),
            f"expected render_mode None, {' or '.join(RENDER_MODES)}, got {mode!r}",
        )
        indices = np.arange(sim.n_worlds) if worlds is None else np.asarray(worlds)
        is_index = indices.ndim == 1 and indices.size and np.issubdtype(indices.dtype, np.integer)
        expect(
            is_index and np.all((indices >= 0) & (indices < sim.n_worlds)),
            f"render_worlds as a list of worlds from 0 to {sim.n_worlds - 1}",
            worlds,
            "Use [0], or None for all.",
        )
        expect(
            isinstance(size, (tuple, list)) and len(size) == 2,
            "render_size as width and height in pixels",
            size,
            "Use (640, 480).",
        )
        self.sim, self.mode, self.worlds, self.size = sim, mode, indices.tolist(), check_image_size(*size)

    def __call__(self, state: EnvState | None) -> list[np.ndarray]:
        require(
            self.mode is not None and state is not None,
            "expected an environment with render_mode='rgb_array' or 'human' after its reset, got none. "
            "Pass render_mode when you make it.",
        )
        self.sim.data = state.data
        width, height = self.size
        if self.mode == "human":
            self.sim.render("human", self.worlds[0], width=width, height=height)
            return []
        return [np.asarray(self.sim.render("rgb_array", world, width=width, height=height)) for world in self.worlds]
