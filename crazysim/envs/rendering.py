"""Views of environments, and rendering for the adapters to other libraries: images of chosen worlds, or a window."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from crazysim.core.settings import check_image_size
from crazysim.envs.env import Env
from crazysim.envs.state import EnvState
from crazysim.errors import expect, require
from crazysim.media import View
from crazysim.sim.sim import Sim

RENDER_MODES = ("rgb_array", "human")
"""Values of ``render_mode`` besides None."""
RING_WIDTH = 25
"""Least width of a drone or the ring around it, pixels."""


def view_of(env: Env, read_state: Callable[[], EnvState], **options: Any) -> View:
    """Return a view of an environment: the camera, marks and hoops of its task, and rings around small drones.

    Args:
        env: The environment.
        read_state: Function that returns the state to draw.
        options: Further fields of the view, such as ``worlds``.
    """

    def reader(method: Callable[[EnvState], Any], size: int) -> Callable[[Sim, int], np.ndarray]:
        compiled = jax.jit(method)

        def read(_: Sim, world: int) -> np.ndarray:
            values = compiled(read_state())
            return np.zeros((0, size)) if values is None else np.asarray(values[world]).reshape(-1, size)

        return read

    marks, subjects, hoops = reader(env.target, 3), reader(env.subjects, 3), reader(env.rings, 7)
    camera = dict(env.task.camera(env.sim.n_drones) or {"elevation": -20})

    def points_in_view(sim: Sim, world: int) -> np.ndarray:
        return np.concatenate([marks(sim, world), subjects(sim, world), hoops(sim, world)[:, :3]])

    return View(
        cam_config=camera,
        follow=camera.pop("follow", None),
        hold=None if "distance" in camera else points_in_view,
        marks=marks,
        hoops=hoops,
        ring_width=RING_WIDTH,
        **options,
    )


class Renderer:
    """Renderer of environment states: images of chosen worlds, or a window."""

    def __init__(
        self, env: Env, mode: str | None, worlds: Sequence[int] | None = (0,), size: tuple[int, int] = (640, 480)
    ):
        n_worlds = env.sim.n_worlds
        require(
            mode is None or (isinstance(mode, str) and mode in RENDER_MODES),
            f"expected render_mode None, {' or '.join(RENDER_MODES)}, got {mode!r}",
        )
        indices = np.arange(n_worlds) if worlds is None else np.asarray(worlds)
        is_index = indices.ndim == 1 and indices.size and np.issubdtype(indices.dtype, np.integer)
        expect(
            is_index and np.all((indices >= 0) & (indices < n_worlds)),
            f"render_worlds as a list of worlds from 0 to {n_worlds - 1}",
            worlds,
            "Use [0], or None for all.",
        )
        expect(
            isinstance(size, (tuple, list)) and len(size) == 2,
            "render_size as width and height in pixels",
            size,
            "Use (640, 480).",
        )
        width, height = check_image_size(*size)
        self.sim, self.mode = env.sim, mode
        self._state: Any = None
        shown = [] if mode is None else indices[:1] if mode == "human" else indices
        lag = 0.6 if mode == "rgb_array" else 1e9  # a window's camera stands still, for the mouse to move it
        self._views = [
            view_of(env, lambda: self._state, worlds=(int(world),), width=width, height=height, lag=lag)
            for world in shown
        ]

    def __call__(self, state: EnvState | None) -> list[np.ndarray]:
        require(
            self.mode is not None and state is not None,
            "expected an environment with render_mode='rgb_array' or 'human' after its reset, got none. "
            "Pass render_mode when you make it.",
        )
        self._state, self.sim.data = state, state.data
        if self.mode == "human":
            self._views[0].show(self.sim)
            return []
        return [view.render(self.sim) for view in self._views]
