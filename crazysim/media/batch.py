"""Images of many worlds as one array."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazysim.core.settings import positive_integer
from crazysim.errors import require
from crazysim.media.view import View
from crazysim.media.worlds import world_indices
from crazysim.scene import batch_render
from crazysim.sim.sim import Sim

RENDERERS = ("auto", "warp", "plain")
"""Renderers of many worlds."""


def render_worlds(
    sim: Sim,
    worlds: Sequence[int] | None = None,
    camera: int | str = -1,
    cam_config: Mapping[str, Any] | None = None,
    width: int = 320,
    height: int = 240,
    renderer: str = "auto",
) -> NDArray:
    """Render an image of each of several worlds. (n, height, width, 3), uint8

    On a GPU, if ``warp-lang`` is installed, MuJoCo Warp ray-traces a camera of the scene in all worlds at once.
    Otherwise MuJoCo's renderer draws one world after the other. A call with the same camera, size and number of worlds
    as the last call needs no preparation.

    Args:
        worlds: Indices of worlds, in the order of the images; None for all.
        camera: Name or id of a camera; -1 is the free camera.
        cam_config: Settings of the free camera.
        width: Width of each image, pixels.
        height: Height of each image, pixels.
        renderer: ``"warp"``, which draws neither overlays nor the free camera; ``"plain"``; or ``"auto"`` for the
            faster renderer that can draw everything.

    Raises:
        ImportError: If ``renderer="warp"`` and MuJoCo Warp is not installed.
        RenderError: If this machine cannot draw.
    """
    require(
        isinstance(renderer, str) and renderer in RENDERERS,
        f"expected renderer {' or '.join(map(repr, RENDERERS))}, got {renderer!r}",
    )
    indices = world_indices(sim, worlds)
    can_use_warp = (
        camera != -1 and not len(sim.overlays) and sim.device.platform == "gpu" and batch_render.is_installed()
    )
    if renderer == "warp" or (renderer == "auto" and can_use_warp):
        return np.asarray(sim.scene.render_worlds(sim.data, indices, camera, width, height))
    total_height = positive_integer("height", height) * len(indices)
    column = View(indices.tolist(), width, total_height, camera, cam_config, columns=1, border=0)
    return column.render(sim).reshape(-1, height, width, 3)
