"""Small helpers for code around a simulation, under the names of Crazyflow."""

from __future__ import annotations

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.cache import enable_cache
from crazysim.core.data import grid_2d
from crazysim.core.settings import as_mask
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

    Raises:
        ConfigError: If the mask has another shape or type.
    """
    return record.replace(**{name: _selected(mask, new, getattr(record, name)) for name, new in changes.items()})


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

    Raises:
        ConfigError: If the mask has another shape or type.
    """
    return jax.tree.map(
        lambda old, new, is_batched: _selected(mask, new, old) if is_batched else old,
        tree,
        new_tree,
        batched,
    )


def _selected(mask: Any, new: Any, old: Any) -> Array:
    """Return new values in the worlds of a mask, and old ones elsewhere; the mask is checked."""
    new = jnp.asarray(new)
    n_worlds = np.broadcast_shapes(new.shape, np.shape(old))[:1]
    return select_worlds(as_mask(mask, n_worlds), new, old)
