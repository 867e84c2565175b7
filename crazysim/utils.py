"""Small helpers for code around a simulation, under the names of Crazyflow."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.core.data import grid_2d
from crazysim.pytree import CORE_NDIM_KEY, PyTree, n_batch_axes, scopes, select_worlds

__all__ = ["CORE_NDIM_KEY", "enable_cache", "grid_2d", "leaf_replace", "pytree_replace", "world_mask"]

Record = TypeVar("Record", bound=PyTree)
Tree = TypeVar("Tree")


def leaf_replace(record: Record, mask: Array | None = None, **changes: Array) -> Record:
    """Return a copy of a record with fields replaced in the worlds of a mask.

    Args:
        record: Record whose named fields begin with an axis over worlds, or broadcast to one.
        mask: True in the worlds to change; None for all. (n_worlds,)
        **changes: New values. (n_worlds, ...)
    """
    return record.replace(**{name: select_worlds(mask, new, getattr(record, name)) for name, new in changes.items()})


def world_mask(tree: Tree) -> Tree:
    """Return the tree with True in place of every leaf that has an axis over worlds, False in place of others."""
    return jax.tree.map(lambda scope: n_batch_axes(scope) > 0, scopes(tree))


def pytree_replace(tree: Tree, new_tree: Tree, batched: Any, mask: Array | None = None) -> Tree:
    """Return a tree whose batched leaves are those of another tree in the worlds of a mask.

    Args:
        tree: Tree to change.
        new_tree: Tree of the same structure with the new values.
        batched: Tree of bools, True for the leaves to replace, such as ``world_mask`` returns.
        mask: True in the worlds to change; None for all. (n_worlds,)
    """
    return jax.tree.map(
        lambda old, new, is_batched: select_worlds(mask, jnp.asarray(new), old) if is_batched else old,
        tree,
        new_tree,
        batched,
    )


def enable_cache(
    cache_path: str | Path | None = None,
    min_entry_size_bytes: int = -1,
    min_compile_time_secs: float = 0.0,
    enable_xla_caches: bool = False,
) -> Path:
    """Keep compiled programs on disk from now on, and return the folder.

    Args:
        cache_path: Folder; None for ``crazysim/jax`` in the user's cache folder.
        min_entry_size_bytes: Smallest program to keep; -1 for all.
        min_compile_time_secs: Shortest compilation whose program is kept, s.
        enable_xla_caches: True to let XLA keep files of its own beside JAX's.
    """
    path = Path.home() / ".cache" / "crazysim" / "jax" if cache_path is None else Path(cache_path)
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", min_entry_size_bytes)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", min_compile_time_secs)
    if enable_xla_caches:
        jax.config.update("jax_persistent_cache_enable_xla_caches", "all")
    return path
