"""Caches that make flattening ``SimData`` to a list of arrays cheap."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.engine.ir.program import Zeros
from crazysim.pytree import numbered, scopes, sparse_leaves


class PackCache:
    """Shared parameters concatenated to one array, which is made again only after one of them was replaced.

    On a CPU the first array is made without a compiled program, which would take 20 ms for each set of shapes; most
    simulations need no second array. Those are made by a program, in a sixth of the time.
    """

    def __init__(self) -> None:
        self._arrays: Sequence[Any] = ()
        self._packed: Any = None

    def __call__(self, arrays: list[Any]) -> Array:
        """Return the arrays as one."""
        if any(isinstance(x, jax.core.Tracer) for x in arrays):
            return _concatenated(arrays)
        if not _same(arrays, self._arrays):
            with jax.ensure_compile_time_eval():  # inside a user's trace too: a cached value must be an array
                is_first = self._packed is None
                self._packed = _joined(arrays) if is_first and _on_one_cpu(arrays) else _compiled(arrays)
                self._arrays = arrays
        return self._packed


def _on_one_cpu(arrays: list[Any]) -> bool:
    """Return True if all arrays are on one device, and that is a processor of the host."""
    devices = {device for x in arrays if isinstance(x, jax.Array) for device in x.devices()}
    return len(devices) <= 1 and all(device.platform == "cpu" for device in devices)


def _joined(arrays: list[Any]) -> Array:
    """Return arrays of one device as one there, committed if one of them is."""
    committed = next((x.sharding for x in arrays if isinstance(x, jax.Array) and x.committed), None)
    return jax.device_put(np.concatenate([np.ravel(x) for x in arrays]), committed)


def _concatenated(arrays: list[Any]) -> Array:
    return jnp.concatenate([x.ravel() for x in arrays])


_compiled = jax.jit(_concatenated)


class ZerosCache:
    """Elements of shared parameters that are zero: an inertia without products, a force without a component.

    These are parameters of drones and controllers, and those of plugins that are declared sparse.

    Values are read once for each array. Under a trace they are unknown, and no element counts as zero.
    """

    def __init__(self) -> None:
        self._arrays: Sequence[Any] = ()
        self._found: Zeros = ()
        self._shared: dict[Any, list[int]] = {}

    def __call__(self, data: SimData, leaves: list[Any]) -> Zeros:
        """Return the elements of a simulation's data."""
        places = self._indices(data, leaves)
        arrays = [leaves[i] for i in places]
        if _same(arrays, self._arrays):
            return self._found
        if any(isinstance(x, jax.core.Tracer) for x in arrays):
            return ()
        found = {i: frozenset(np.flatnonzero(np.asarray(x) == 0).tolist()) for i, x in zip(places, arrays, strict=True)}
        self._arrays, self._found = arrays, tuple((i, zeros) for i, zeros in found.items() if zeros)
        return self._found

    def _indices(self, data: SimData, leaves: list[Any]) -> list[int]:
        key = tuple([x.ndim for x in leaves])
        if key not in self._shared:
            numbers = numbered(data)
            parameters = set(jax.tree.leaves((numbers.params, numbers.controls)))
            rows = zip(jax.tree.leaves(scopes(data)), jax.tree.leaves(sparse_leaves(data)), leaves, strict=True)
            self._shared[key] = [
                i
                for i, (scope, is_sparse, x) in enumerate(rows)
                if scope == "shared" and (is_sparse or i in parameters) and jnp.issubdtype(x.dtype, jnp.floating)
            ]
        return self._shared[key]


def _same(some: Sequence[Any], others: Sequence[Any]) -> bool:
    """Return whether two lists hold the very same arrays."""
    return len(some) == len(others) and all(map(_is, some, others))


def _is(a: Any, b: Any) -> bool:
    return a is b
