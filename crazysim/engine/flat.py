"""Caches that make flattening a record to a list of arrays cheap."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.engine.ir.program import Zeros


class PackCache:
    """Shared parameters concatenated to one array. It is made again only after one of the parameters was replaced.

    On a CPU the first array is made by NumPy: compiling a program would take 20 ms for each set of shapes, and most
    simulations need no second array. Later arrays are made by a compiled program, in a sixth of the time.
    """

    def __init__(self) -> None:
        self._cached: tuple[Sequence[Any], Array | None] = (), None  # one tuple: threads replace both at once

    def __call__(self, arrays: list[Any]) -> Array:
        if any(isinstance(x, jax.core.Tracer) for x in arrays):
            return _concatenate(arrays)
        cached_arrays, packed = self._cached
        if packed is None or not _are_same(arrays, cached_arrays):
            with jax.ensure_compile_time_eval():  # inside a user's trace too, the cached value must not be a tracer
                packed = (
                    _concatenate_in_numpy(arrays)
                    if packed is None and _are_on_one_cpu(arrays)
                    else _compiled_concatenate(arrays)
                )
            self._cached = _without_numpy(arrays), packed
        return packed


def _are_on_one_cpu(arrays: list[Any]) -> bool:
    devices = {device for x in arrays if isinstance(x, jax.Array) for device in x.devices()}
    return len(devices) <= 1 and all(device.platform == "cpu" for device in devices)


def _concatenate_in_numpy(arrays: list[Any]) -> Array:
    committed_sharding = next((x.sharding for x in arrays if isinstance(x, jax.Array) and x.committed), None)
    return jax.device_put(np.concatenate([np.ravel(x) for x in arrays]), committed_sharding)


def _concatenate(arrays: list[Any]) -> Array:
    return jnp.concatenate([x.ravel() for x in arrays])


_compiled_concatenate = jax.jit(_concatenate)


class ZerosCache:
    """Elements of shared parameters that are zero, such as the products of inertia.

    Values are read again only after one of the arrays was replaced. Under a trace, and in shapes, the values are
    unknown, and the result is empty.
    """

    def __init__(self) -> None:
        self._cached: tuple[Sequence[Any], Zeros] = (), ()  # one tuple: threads replace both at once

    def __call__(self, indices: Sequence[int], leaves: Sequence[Any]) -> Zeros:
        arrays = [leaves[i] for i in indices]
        cached_arrays, zeros = self._cached
        if _are_same(arrays, cached_arrays):
            return zeros
        if any(isinstance(x, jax.core.Tracer | jax.ShapeDtypeStruct) for x in arrays):
            return ()
        zeros_by_leaf = [
            (i, frozenset(np.flatnonzero(np.asarray(x) == 0).tolist())) for i, x in zip(indices, arrays, strict=True)
        ]
        zeros = tuple([(i, indices_of_zeros) for i, indices_of_zeros in zeros_by_leaf if indices_of_zeros])
        self._cached = _without_numpy(arrays), zeros
        return zeros


def _without_numpy(arrays: list[Any]) -> list[Any]:
    return [x if isinstance(x, jax.Array) else None for x in arrays]


def _are_same(arrays: Sequence[Any], others: Sequence[Any]) -> bool:
    return len(arrays) == len(others) and all(map(_is_same, arrays, others))


def _is_same(a: Any, b: Any) -> bool:
    return a is b
