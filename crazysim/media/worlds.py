"""Selection of worlds for images and recordings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import expect, require
from crazysim.sim.sim import Sim


def world_indices(sim: Sim, worlds: Sequence[int] | None) -> NDArray:
    """Return indices of worlds, after a check that they exist. (n,)

    Args:
        worlds: Indices; None for all worlds.
    """
    expect(worlds is None or np.ndim(worlds) == 1, "worlds as a list of indices", worlds, "Use [0] for the first.")
    indices = list(range(sim.n_worlds) if worlds is None else worlds)
    require(indices, "expected at least one world, got none")
    for world in indices:
        require_world(sim, world)
    return np.array(indices)


def require_world(sim: Sim, world: int) -> None:
    """Raise ``ConfigError`` unless a world exists."""
    require(
        isinstance(world, (int, np.integer)) and world in range(sim.n_worlds),
        f"expected a world from 0 to {sim.n_worlds - 1}, got {world!r}",
    )
