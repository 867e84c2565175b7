"""Steps on the host without XLA: compiled kernels are called on the memory of arrays.

A call of a compiled JAX function takes about 30 us, mostly to convert its operands and results. A loop of commands,
steps and reads needs few of these as JAX arrays, so a JAX array is made only when a leaf is read.

Memory that a kernel has read or written does not change afterwards. A kernel reads JAX arrays through NumPy views; as
long as a view exists, JAX copies the buffer instead of reusing it for a donated array. It also reads commands, which
are copies, and results of earlier calls. It writes into new memory, which is never written again.
"""

from __future__ import annotations

import ctypes
import functools
import math
import struct
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim.engine import jaxcompat
from crazysim.engine.backends.fused import Kernels

ALIGNMENT_BYTES = 64
"""Alignment of memory that JAX takes over without a copy, bytes."""
MAX_SHARED_BYTES = 1 << 16
"""Total size of the results of a call up to which they share one piece of memory, bytes."""


class HostLeaves:
    """Leaves of a simulation at one moment: JAX arrays, commands on the host, or results of a kernel.

    Indexing returns a leaf as a JAX array, which is made once.
    """

    __slots__ = ("_jax_arrays", "_sharding", "_views", "addresses", "items")

    def __init__(self, items: list[Any], addresses: list[int], views: Any, sharding: Any):
        self.items, self.addresses, self._views, self._sharding = items, addresses, views, sharding
        self._jax_arrays: dict[int, Array] = {}

    def __getitem__(self, i: int) -> Array:
        x = self.items[i]
        if isinstance(x, jax.Array):
            return x
        if i not in self._jax_arrays:
            self._jax_arrays.setdefault(
                i, jaxcompat.put_host_array(self.array(i), self._sharding)
            )  # if another thread makes the array too, the first array stays
        return self._jax_arrays[i]

    def array(self, i: int) -> NDArray:
        """Return a leaf as a NumPy array, which must not be written to."""
        x = self.items[i]
        return x.array(i) if isinstance(x, CallResults) else np.asarray(x)

    def replace(self, indices: Iterable[int], arrays: Iterable[Any]) -> HostLeaves:
        """Return the leaves with some replaced by ``arrays``, which must not change afterwards."""
        arrays = [np.asarray(x, order="C") for x in arrays]
        return self.replace_items(indices, arrays, [_address(x) for x in arrays])

    def replace_items(self, indices: Iterable[int], items: Iterable[Any], addresses: Iterable[int]) -> HostLeaves:
        """Return the leaves with some replaced by ``items`` at the given addresses."""
        leaves = HostLeaves(list(self.items), list(self.addresses), self._views, self._sharding)
        leaves._jax_arrays = dict(self._jax_arrays)
        for i, x, address in zip(indices, items, addresses, strict=True):
            leaves.items[i], leaves.addresses[i] = x, address
            leaves._jax_arrays.pop(i, None)
        return leaves


def _address(x: NDArray) -> int:
    return ctypes.addressof(ctypes.c_char.from_buffer(x)) if x.flags.writeable else x.ctypes.data  # type: ignore[arg-type]


class _ArrayPlace(NamedTuple):
    """Place of an array in the memory of a call."""

    piece: int
    """Index of the piece of memory."""
    offset: int
    """Offset in the piece, bytes."""
    shape: tuple[int, ...]
    dtype: np.dtype


class _Layout:
    """Pieces of memory that a call writes, and the places of its results in them."""

    def __init__(self, results: Sequence[tuple[Any, tuple[int, ...], np.dtype]]):
        self.places: list[_ArrayPlace] = []
        self.piece_sizes: list[int] = []
        """Size of each piece, bytes."""
        rounded_sizes = [
            -(-math.prod(shape) * dtype.itemsize // ALIGNMENT_BYTES) * ALIGNMENT_BYTES for _, shape, dtype in results
        ]
        self.shares_memory = sum(rounded_sizes) <= MAX_SHARED_BYTES
        for (_, shape, dtype), size in zip(results, rounded_sizes, strict=True):
            if self.shares_memory and self.piece_sizes:
                self.places.append(_ArrayPlace(0, self.piece_sizes[0], shape, dtype))
                self.piece_sizes[0] += size
            else:
                self.places.append(_ArrayPlace(len(self.piece_sizes), 0, shape, dtype))
                self.piece_sizes.append(size)
        self.place_by_key = dict(zip((key for key, _, _ in results), self.places, strict=True))
        self.piece_offsets = [(x.piece, x.offset) for x in self.places]
        """Piece of each result, and offset in that piece, bytes."""


class CallResults:
    """Arrays that one call wrote."""

    __slots__ = ("_layout", "_memory", "_paddings", "addresses")

    def __init__(self, layout: _Layout):
        self._layout = layout
        self._memory = [np.empty(size + ALIGNMENT_BYTES, np.uint8) for size in layout.piece_sizes]
        addresses = [_address(x) for x in self._memory]
        self._paddings = [-address % ALIGNMENT_BYTES for address in addresses]
        aligned_addresses = [address + padding for address, padding in zip(addresses, self._paddings, strict=True)]
        self.addresses = [aligned_addresses[piece] + offset for piece, offset in layout.piece_offsets]

    def array(self, key: Any) -> NDArray:
        """Return the array of a key: a copy if arrays share memory, so that it does not keep the other arrays alive."""
        piece, offset, shape, dtype = self._layout.place_by_key[key]
        x = np.ndarray(shape, dtype, self._memory[piece], self._paddings[piece] + offset)
        return x.copy() if self._layout.shares_memory else x


class _Launch(NamedTuple):
    """Prepared call of a kernel."""

    kernel: Any
    """The kernel, from ``HostLaunch.memory_function``."""
    n_lanes: int
    """Number of drones or members in all worlds."""
    inputs: tuple[int, ...]
    """Indices of the leaves that the kernel reads."""
    outputs: slice
    """Positions of its results among the results of all kernels."""
    address_format: struct.Struct
    """Format in which the addresses of inputs and outputs are packed."""


class HostCall:
    """Function that runs the steps of a plan: one host kernel for each of its programs."""

    def __init__(self, kernels: Sequence[Kernels], owned: Sequence[Any], leaves: Sequence[Any], nonfinite: int):
        self.was_called = False
        """True after the first call."""
        self._nonfinite = nonfinite
        self._views_by_leaf: dict[int, tuple[Any, NDArray]] = {}
        self._launches: list[_Launch] = []
        results: list[tuple[Any, tuple[int, ...], np.dtype]] = []
        n_worlds = leaves[nonfinite].shape[0]
        for k, (kernel, owned_leaves) in enumerate(zip(kernels, owned, strict=True)):
            first_result, n_drones = len(results), kernel.program.n_drones
            for i in kernel.outputs:
                key = i if owned_leaves is None or i in owned_leaves else (k, i)  # (k, i) is not read
                results.append((key, leaves[i].shape, np.dtype(leaves[i].dtype)))
            results.append((("flags", k), (n_worlds, n_drones), np.dtype(bool)))
            outputs = slice(first_result, len(results))
            address_format = struct.Struct(f"{len(kernel.inputs) + len(results) - first_result}P")
            self._launches.append(
                _Launch(
                    kernel.get_launch("cpu").memory_function(),
                    n_worlds * n_drones,
                    kernel.inputs,
                    outputs,
                    address_format,
                )
            )
        self._flag_keys = [key for key, _, _ in results if isinstance(key, tuple) and key[0] == "flags"]
        if self._flag_keys == [("flags", 0)] and results[-1][1][1] == 1:  # flags (n_worlds, 1) need no reduction
            results[-1] = (nonfinite, *results[-1][1:])
            self._flag_keys = []
        self._layout = _Layout(results)
        written_pairs = [(i, k) for k, (i, _, _) in enumerate(results) if isinstance(i, int)]
        self._written_leaves, self._result_positions = [i for i, _ in written_pairs], [k for _, k in written_pairs]
        self._read_leaves = sorted({i for launch in self._launches for i in launch.inputs})

    def make_host_leaves(self, leaves: Sequence[Any], sharding: Any) -> HostLeaves:
        """Return leaves that can be stepped.

        Args:
            leaves: Leaves of the data on the device, followed by the leaves that passes add.
            sharding: The device.
        """
        items = list(leaves)
        views = {i: self._view(i, items[i]) for i in self._read_leaves}
        addresses = [0] * len(items)
        for i, view in views.items():
            addresses[i] = view.ctypes.data
        return HostLeaves(items, addresses, views, sharding)

    def _view(self, i: int, x: Any) -> NDArray:
        entry = self._views_by_leaf.get(i)
        if entry is None or entry[0] is not x:
            key_data = jax.random.key_data(x) if jaxcompat.is_key(x) else x
            entry = self._views_by_leaf[i] = x, np.ascontiguousarray(key_data)
        return entry[1]

    def __call__(self, leaves: HostLeaves, n_steps: int) -> HostLeaves:
        self.was_called = True
        results, addresses = CallResults(self._layout), leaves.addresses
        for kernel, n_lanes, inputs, outputs, address_format in self._launches:
            packed_addresses = address_format.pack(*[addresses[i] for i in inputs], *results.addresses[outputs])
            if not kernel(n_lanes, n_steps, packed_addresses, len(inputs)):
                raise MemoryError("there is no memory for a step")
        result_addresses = [results.addresses[k] for k in self._result_positions]
        leaves_after = leaves.replace_items(self._written_leaves, [results] * len(result_addresses), result_addresses)
        if not self._flag_keys:
            return leaves_after
        flagged = functools.reduce(
            np.logical_or, (results.array(k).any(axis=1, keepdims=True) for k in self._flag_keys)
        )
        return leaves_after.replace([self._nonfinite], [flagged])


def is_host_call_possible(kernels: Sequence[Kernels]) -> bool:
    """Whether kernels can be called without XLA.

    Each must check its results and write them into new memory, not into rows in place. None may write random keys.
    """
    return not jaxcompat.FALLBACKS and all(
        kernel.program.check_segment is not None
        and not kernel.program.rows
        and not any(jaxcompat.is_key(kernel.program.leaves[i]) for i in kernel.outputs)
        for kernel in kernels
    )
