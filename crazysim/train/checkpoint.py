"""Pytrees of arrays in ``.npz`` files, restored bit for bit."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, require
from crazysim.storage import open_file, open_replacement, read_arrays, wrap_read_errors

T = TypeVar("T")
META_ENTRY = "meta"
"""Name of the entry that holds the metadata as JSON."""


def save(path: str | Path, tree: Any, meta: dict[str, Any]) -> None:
    """Write the arrays of a pytree and its metadata; an existing file is replaced atomically.

    Args:
        path: File to write, ``.npz``, in an existing folder.
        tree: Any pytree of arrays, including random keys.
        meta: Metadata that JSON can represent.

    Raises:
        ConfigError: If the file cannot be written; no partial file is left.
    """
    arrays = {name: np.asarray(_key_data(x)) for name, x in _named_leaves(tree)}
    with open_replacement(path) as file:
        np.savez(file, allow_pickle=False, **{META_ENTRY: np.array(json.dumps(meta))}, **arrays)


def read(path: str | Path) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """Return the arrays and the metadata of a file written by ``save``.

    Raises:
        ConfigError: If the file does not exist.
        DamagedFileError: If it is damaged or not a checkpoint.
    """
    with wrap_checkpoint_errors(path), open_file(path) as file:
        arrays = read_arrays(file, str(path))
        return arrays, dict(json.loads(str(arrays.pop(META_ENTRY))))


def wrap_checkpoint_errors(path: str | Path) -> AbstractContextManager[None]:
    """Return a context manager that converts errors of reading a checkpoint, as ``wrap_read_errors`` does."""
    remedy = "Use the folder of an intact run, or train again: crazysim train TASK --out FOLDER."
    return wrap_read_errors(path, "a checkpoint of crazysim", remedy)


def restore(path: str | Path, arrays: Mapping[str, NDArray], template: T) -> T:
    """Return a pytree with the arrays of a file.

    Args:
        path: The file, for messages.
        arrays: Arrays of the file, from ``read``.
        template: Pytree of the same structure and shapes, of arrays or of ``jax.ShapeDtypeStruct``.
    """
    named_leaves = _named_leaves(template)
    if mismatches := {name for name, _ in named_leaves} ^ set(arrays):
        raise ConfigError(
            f"expected the arrays of this task and version in {path}, got others: {', '.join(sorted(mismatches)[:5])}. "
            f"Use the settings it was saved with, or another folder."
        )
    leaves = []
    for name, x in named_leaves:
        is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        with wrap_checkpoint_errors(path):
            value = jax.device_put(arrays[name])
            value = jax.random.wrap_key_data(value) if is_key else value
        require(
            value.shape == x.shape and value.dtype == x.dtype,
            f"expected {name} in {path} as {x.dtype} {x.shape}, got {value.dtype} {value.shape}; use the "
            f"settings it was saved with, or another folder",
        )
        leaves.append(value)
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def _named_leaves(tree: Any) -> list[tuple[str, Any]]:
    return [(jax.tree_util.keystr(path), x) for path, x in jax.tree_util.tree_leaves_with_path(tree)]


def _key_data(x: Any) -> Any:
    return jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
