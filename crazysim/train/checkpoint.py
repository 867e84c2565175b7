"""Trees of arrays in files: what is loaded is what was saved, bit for bit."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from crazysim.errors import ConfigError

T = TypeVar("T")
META = "meta"
"""Name of the entry that says what the arrays belong to."""


def save(path: str | Path, tree: Any, meta: dict[str, Any]) -> None:
    """Write a tree's arrays and what they belong to; a file that is there is exchanged as a whole, or not at all.

    Args:
        path: An ``.npz``.
        tree: Any tree of arrays, random keys included.
        meta: What JSON can hold.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {name: np.asarray(_plain(x)) for name, x in _named(tree)}
    unfinished = path.with_name(path.name + ".part")
    with open(unfinished, "wb") as file:
        np.savez(file, allow_pickle=False, **{META: np.array(json.dumps(meta))}, **arrays)
    os.replace(unfinished, path)


def read_meta(path: str | Path) -> dict[str, Any]:
    """Return what the arrays of a file belong to.

    Raises:
        ConfigError: If there is no such file, or it is no checkpoint.
    """
    path = Path(path)
    if not path.exists():
        raise ConfigError(f"there is no checkpoint {path}; 'crazysim train TASK --out {path.parent}' makes one")
    try:
        with np.load(path) as file:
            return json.loads(str(file[META]))
    except (OSError, KeyError, ValueError) as error:
        raise ConfigError(f"{path} is no checkpoint of crazysim: {error}") from None


def load(path: str | Path, like: T) -> T:
    """Return the tree that a file holds.

    Args:
        path: What ``save`` has written.
        like: A tree of the same structure and shapes; arrays or what ``jax.eval_shape`` gives.

    Raises:
        ConfigError: If there is no such file, or its arrays are others, as those of another version are.
    """
    read_meta(path)
    leaves = []
    with np.load(path) as file:
        named = list(_named(like))
        if others := {name for name, _ in named} ^ (set(file.files) - {META}):
            raise ConfigError(f"{path} holds other arrays, of another task or version: {', '.join(sorted(others)[:5])}")
        for name, x in named:
            is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
            value = jax.random.wrap_key_data(jnp.asarray(file[name])) if is_key else jnp.asarray(file[name])
            if value.shape != x.shape or value.dtype != x.dtype:
                raise ConfigError(
                    f"{path} holds {name} as {value.dtype} {value.shape}; needed is {x.dtype} {x.shape}: it was saved "
                    f"with other settings"
                )
            leaves.append(value)
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _named(tree: Any) -> list[tuple[str, Any]]:
    return [(jax.tree_util.keystr(path), x) for path, x in jax.tree_util.tree_leaves_with_path(tree)]


def _plain(x: Any) -> Any:
    return jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
