"""Small helpers for code around a simulation, under the names that users of Crazyflow know."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import jax
from jax import Array

from crazysim.core.data import grid_2d
from crazysim.pytree import CORE_NDIM_KEY, PyTree, select_worlds

__all__ = ["CORE_NDIM_KEY", "enable_cache", "grid_2d", "leaf_replace"]

Record = TypeVar("Record", bound=PyTree)


def leaf_replace(record: Record, mask: Array | None = None, **changes: Array) -> Record:
    """Return a copy of a record with fields exchanged in the worlds of a mask.

    Args:
        record: Any record whose named fields begin with an axis of worlds, or broadcast to one.
        mask: Which worlds; None for all. (n_worlds,)
        **changes: New values. (n_worlds, ...)
    """
    return record.replace(**{name: select_worlds(mask, new, getattr(record, name)) for name, new in changes.items()})


def enable_cache(path: str | Path | None = None, **settings: Any) -> Path:
    """Keep compiled programs on disk from now on, and return where: what was compiled once starts at once.

    Args:
        path: Folder; by default ``crazysim/jax`` in the user's cache folder.
        **settings: Further settings of JAX whose names begin with ``jax_persistent_cache_``, without that part.
    """
    path = Path.home() / ".cache" / "crazysim" / "jax" if path is None else Path(path)
    settings = {"min_entry_size_bytes": -1, "min_compile_time_secs": 0.0} | settings
    jax.config.update("jax_compilation_cache_dir", str(path))
    for name, value in settings.items():
        jax.config.update(f"jax_persistent_cache_{name}", value)
    return path
