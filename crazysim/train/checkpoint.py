"""Pytrees of arrays in ``.npz`` files, restored bit for bit."""

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
"""Name of the entry that holds the metadata as JSON."""


def save(path: str | Path, tree: Any, meta: dict[str, Any]) -> None:
    """Write the arrays of a pytree and its metadata; an existing file is replaced atomically.

    Args:
        path: File to write, ``.npz``.
        tree: Any pytree of arrays, including random keys.
        meta: Metadata that JSON can represent.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {name: np.asarray(_plain(x)) for name, x in _named(tree)}
    unfinished = path.with_name(path.name + ".part")
    with open(unfinished, "wb") as file:
        np.savez(file, allow_pickle=False, **{META: np.array(json.dumps(meta))}, **arrays)
    os.replace(unfinished, path)


def read_meta(path: str | Path) -> dict[str, Any]:
    """Return the metadata of a checkpoint.

    Raises:
        ConfigError: If the file does not exist or is not a checkpoint.
    """
    path = Path(path)
    if not path.exists():
        raise ConfigError(
            f"expected a checkpoint at {path}, got no file; run 'crazysim train TASK --out {path.parent}'"
        )
    try:
        with np.load(path) as file:
            return json.loads(str(file[META]))
    except (OSError, KeyError, ValueError) as error:
        raise ConfigError(
            f"expected a checkpoint of crazysim at {path}, got an unreadable file ({error}); choose another folder"
        ) from None


def load(path: str | Path, like: T) -> T:
    """Return the pytree stored in a file.

    Args:
        path: File written by ``save``.
        like: Pytree of the same structure and shapes, of arrays or of ``jax.ShapeDtypeStruct``.

    Raises:
        ConfigError: If the file does not exist, or holds arrays of other names, shapes or types.
    """
    read_meta(path)
    leaves = []
    with np.load(path) as file:
        named = list(_named(like))
        if others := {name for name, _ in named} ^ (set(file.files) - {META}):
            raise ConfigError(
                f"expected the arrays of this task and version in {path}, got others: {', '.join(sorted(others)[:5])}. "
                f"Use the settings it was saved with, or another folder."
            )
        for name, x in named:
            is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
            value = jax.device_put(file[name])
            value = jax.random.wrap_key_data(value) if is_key else value
            if value.shape != x.shape or value.dtype != x.dtype:
                raise ConfigError(
                    f"expected {name} in {path} as {x.dtype} {x.shape}, got {value.dtype} {value.shape}; use the "
                    f"settings it was saved with, or another folder"
                )
            leaves.append(value)
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _named(tree: Any) -> list[tuple[str, Any]]:
    return [(jax.tree_util.keystr(path), x) for path, x in jax.tree_util.tree_leaves_with_path(tree)]


def _plain(x: Any) -> Any:
    return jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
