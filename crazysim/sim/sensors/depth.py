"""Depth images as Crazyflow has them: distances along the ray, -1 where it meets nothing."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim.errors import ConfigError
from crazysim.sim.sim import Sim


def render_depth(
    sim: Sim, camera: int | str = 0, resolution: tuple[int, int] = (100, 100), include_drone: bool = False
) -> Array:
    """Return the depth image of one camera in every world, m. (n_worlds, height, width)

    ``sim.depth`` returns the images of all drones' cameras at once, and hides each drone from its own camera only.

    Args:
        sim: Simulation.
        camera: Id or name; 0 is ``track_cam:0``.
        resolution: Width and height, pixels.
        include_drone: True to show drones, including the one that carries the camera.

    Raises:
        ValueError: If the camera does not exist, the name means several cameras, or the resolution is invalid.
    """
    try:
        width, height = resolution
    except (TypeError, ValueError):
        raise ConfigError(f"expected a resolution of width and height, pixels, got {resolution!r}") from None
    depth = sim.depth(camera, width, height, drones=include_drone, hide_own=False, along="ray")
    if depth.shape[1] > 1:
        raise ConfigError(
            f"expected one camera, got {depth.shape[1]} for {camera!r}. Use one such as '{camera}:0', or sim.depth."
        )
    return jnp.where(jnp.isfinite(depth[:, 0]), depth[:, 0], -1.0)
