"""Selection of worlds for images and recordings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, short_repr
from crazysim.sim.sim import Sim


def world_indices(sim: Sim, worlds: Sequence[int] | None) -> NDArray:
    """Return indices of worlds, after a check that they exist. (n,)

    Args:
        sim: Simulation.
        worlds: Indices; None for all worlds.
    """
    if worlds is not None and np.ndim(worlds) != 1:
        raise ConfigError(f"expected worlds as a list of indices, got {short_repr(worlds)}. Use [0] for the first.")
    indices = list(range(sim.n_worlds) if worlds is None else worlds)
    if not indices:
        raise ConfigError("expected at least one world, got none")
    for world in indices:
        require_world(sim, world)
    return np.array(indices)


def require_world(sim: Sim, world: int) -> None:
    """Raise ``ConfigError`` unless a world exists."""
    if not isinstance(world, (int, np.integer)) or world not in range(sim.n_worlds):
        raise ConfigError(f"expected a world from 0 to {sim.n_worlds - 1}, got {world!r}")
