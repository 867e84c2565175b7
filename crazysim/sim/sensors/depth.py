"""Depth pictures as Crazyflow has them: distances along the ray, -1 where it meets nothing."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim.errors import ConfigError
from crazysim.sim.sim import Sim


def render_depth(
    sim: Sim, camera: int | str = 0, resolution: tuple[int, int] = (100, 100), include_drone: bool = False
) -> Array:
    """Return how far it is from one camera of every world along each pixel's ray, m. (n_worlds, height, width)

    ``sim.depth`` sees through the cameras of all drones at once, and hides each drone from its own camera only.

    Args:
        sim: The simulation.
        camera: Id or name; 0 is ``track_cam:0``. Its field of view is its own.
        resolution: Width and height, pixels.
        include_drone: Whether drones are seen, the camera's own too.

    Raises:
        ValueError: If the camera does not exist or is several, or the resolution cannot be.
    """
    try:
        width, height = resolution
    except (TypeError, ValueError):
        raise ConfigError(f"resolution is {resolution!r}; needed are a width and a height, pixels") from None
    depth = sim.depth(camera, width, height, drones=include_drone, hide_own=False, along="ray")
    if depth.shape[1] > 1:
        raise ConfigError(f"{camera!r} are {depth.shape[1]} cameras; name one, such as '{camera}:0', or use sim.depth")
    return jnp.where(jnp.isfinite(depth[:, 0]), depth[:, 0], -1.0)
