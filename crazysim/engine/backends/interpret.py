"""An interpreter that runs programs in NumPy, one operation after the other, without compiling anything.

It defines what the operations of ``ops.TABLE`` mean, and it is slow. Passes, rules and other engines are tested against
it, and ``Sim(engine="interpret")`` steps with it.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import platform
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.engine.backends import Run, lanes
from crazysim.engine.ir import ops
from crazysim.engine.ir.blocks import Block, Operation, Value
from crazysim.engine.ir.program import Program
from crazysim.engine.jaxcompat import is_key
from crazysim.engine.pytree import replace_leaves
from crazysim.engine.sharding import Location

Observer = Callable[[Operation, Sequence[np.ndarray]], None]
"""Function that is called with every operation and its results."""
FloatEnvironment = ctypes.c_uint32 * 8
"""``fenv_t`` of x86-64 Linux."""
MXCSR_INDEX = 7
"""Index of the word of ``FloatEnvironment`` that controls the arithmetic of vector registers."""
FLUSH_BITS = 0x8040
"""Bits that flush subnormal results and operands to zero: Intel 64 manual, volume 1, section 10.2.3."""


def run_block(
    block: Block, inputs: Sequence[Any], shape: tuple[int, ...], observe: Observer | None = None
) -> list[np.ndarray]:
    """Return the outputs of a block.

    Args:
        inputs: Inputs of the block: arrays of the lanes' shape, scalars that all lanes share, or flat tables.
        shape: Shape of the lanes.
        observe: Function that is called with every operation and its results, or None.

    Returns:
        Its outputs, of the lanes' shape.
    """
    if block not in _PREPARED_BLOCKS:
        indices: dict[Any, int] = {}
        constants: list[Any] = []
        _PREPARED_BLOCKS[block] = _prepare_block(block, indices, constants), constants
    prepared, constants = _PREPARED_BLOCKS[block]
    arrays = [np.asarray(x, v.dtype) for x, v in zip(inputs, block.inputs, strict=True)]
    with np.errstate(all="ignore"):
        out = prepared.run(constants.copy(), arrays, shape, observe)
    return [_broadcast(x, shape) for x in out]


def _broadcast(x: Any, shape: tuple[int, ...]) -> np.ndarray:
    return x if np.shape(x) == shape else np.broadcast_to(x, shape)


class _Call(NamedTuple):
    """An operation of a prepared block."""

    op: Operation
    fn: Callable[..., Any] | None
    """NumPy's function; None for a structured operation."""
    args: list[int]
    """Indices of the operands."""
    results: list[int]
    """Indices of the results."""
    dtype: np.dtype
    """Type of the first result."""
    blocks: list[_PreparedBlock]
    """Blocks that it runs."""


class _PreparedBlock(NamedTuple):
    """A block whose values have indices in a list, with the function of each operation."""

    inputs: list[int]
    """Indices of the inputs."""
    calls: list[_Call]
    """Operations in order."""
    outputs: list[int]
    """Indices of the outputs."""

    def run(self, values: list[Any], inputs: Sequence[Any], shape: tuple[int, ...], observe: Observer | None) -> list:
        for i, x in zip(self.inputs, inputs, strict=True):
            values[i] = x
        for op, fn, args, results, dtype, blocks in self.calls:
            if fn is not None:
                x = fn(*[values[k] for k in args])
                values[results[0]] = x if x.dtype == dtype else np.asarray(x).astype(dtype)
            else:
                runs = [lambda inputs, block=block: block.run(values, inputs, shape, observe) for block in blocks]
                for i, x in zip(results, _run_structured(op, [values[k] for k in args], shape, runs), strict=True):
                    values[i] = x
            if observe is not None:
                observe(op, [values[k] for k in results])
        return [values[k] for k in self.outputs]


_BlockRun = Callable[[Sequence[Any]], list[Any]]
"""Function from the inputs of a block to its outputs."""

_PREPARED_BLOCKS: WeakKeyDictionary[Block, tuple[_PreparedBlock, list[Any]]] = WeakKeyDictionary()
"""Prepared blocks of earlier runs. The list has the constants at their indices, and None for all other values."""


def _prepare_block(block: Block, indices: dict[Any, int], constants: list[Any]) -> _PreparedBlock:
    def get_index(x: Any) -> int:
        if isinstance(x, Value):
            if x not in indices:
                indices[x] = len(constants)
                constants.append(None)
            return indices[x]
        constants.append(x)
        return len(constants) - 1

    inputs = [get_index(x) for x in block.inputs]
    calls = []
    for op in block.operations:
        args = [get_index(x) for x in op.args]
        blocks = [_prepare_block(inner, indices, constants) for inner in op.blocks]
        results = [get_index(x) for x in op.results]
        dtype = op.dtype if op.results else np.dtype(bool)
        calls.append(_Call(op, _numpy_function(op), args, results, dtype, blocks))
    return _PreparedBlock(inputs, calls, [get_index(x) for x in block.outputs])


def _numpy_function(op: Operation) -> Callable[..., Any] | None:
    row = ops.TABLE[op.name]
    if row.structured:
        return None
    if row.numpy is None:
        raise RuntimeError(f"operation {op.name!r} has no NumPy function; give it one in ops.TABLE")
    params = dict(op.params)
    if op.name in ("convert_element_type", "bitcast_convert_type"):
        params["dtype"] = op.dtype
    return functools.partial(row.numpy, **params) if params else row.numpy


def _run_structured(op: Operation, args: list[Any], shape: tuple[int, ...], runs: Sequence[_BlockRun]) -> list[Any]:
    match op.name:
        case "barrier":
            return []
        case "when":
            mask, *old_values = args
            new_values = runs[0]([]) if mask.any() else old_values
            return [np.where(mask, new, old) for new, old in zip(new_values, old_values, strict=True)]
        case "loop":
            for _ in range(op.param("length")):
                args = runs[0](args)
            return args
        case "while":
            test, body = runs
            while (mask := test(args)[0]).any():
                args = [np.where(mask, new, old) for new, old in zip(body(args), args, strict=True)]
            return args
        case "over_others":
            return _over_others(op, args, shape, runs[0])
        case "custom_jvp":
            return runs[0](args)
        case "table":
            return [op.param("numbers").array]
        case "lookup":
            return [args[0][args[1] + op.param("offset")]]
        case "any_lane":
            return args
        case "threefry2x32":
            return list(threefry2x32(*args))
    raise RuntimeError(
        f"expected a structured operation that is interpreted, got {op.name!r}; add a case to _run_structured"
    )


def _over_others(op: Operation, args: list[np.ndarray], shape: tuple[int, ...], run: _BlockRun) -> list[np.ndarray]:
    n = op.param("n_members")
    member_number = np.arange(shape[0]) % n
    combining_functions: list[Any] = [ops.TABLE[name].numpy for name in op.param("reduce")]
    reduced_results = [
        np.full(shape, ops.neutral_number(name, x.dtype))
        for name, x in zip(op.param("reduce"), op.results, strict=True)
    ]
    for j in range(n):
        other_numbers = [np.repeat(np.broadcast_to(x, shape).reshape(-1, n)[:, j], n) for x in args]
        results = run([*other_numbers, member_number == j])
        reduced_results = [fn(x, y) for fn, x, y in zip(combining_functions, reduced_results, results, strict=True)]
    return reduced_results


THREEFRY_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
"""Bits of each rotation: J. K. Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC 2011, table 2."""


def threefry2x32(k0: np.ndarray, k1: np.ndarray, x0: np.ndarray, x1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Encrypt two 32-bit integers with 20 rounds of Threefry, under a key of two 32-bit integers."""
    keys = (k0, k1, k0 ^ k1 ^ np.uint32(0x1BD11BDA))
    x0, x1 = x0 + keys[0], x1 + keys[1]
    for n in range(5):
        for r in THREEFRY_ROTATIONS[n % 2]:
            x0 = x0 + x1
            x1 = (x1 << np.uint32(r)) | (x1 >> np.uint32(32 - r))
            x1 = x1 ^ x0
        x0, x1 = x0 + keys[(n + 1) % 3], x1 + keys[(n + 2) % 3] + np.uint32(n + 1)
    return x0, x1


def run_block_in_callback(block: Block, inputs: Sequence[Any], shape: tuple[int, ...]) -> list[Array]:
    """Run a block as ``run_block`` does, inside a function that JAX traces or compiles, without a derivative."""
    results = [jax.ShapeDtypeStruct(shape, x.dtype) for x in block.outputs]

    def run_arrays(*inputs: Any) -> list[np.ndarray]:
        return [np.array(x) for x in run_block(block, [np.asarray(x) for x in inputs], shape)]

    return list(jax.pure_callback(run_arrays, results, *inputs, vmap_method="sequential"))


def build(program: Program, location: Location) -> Run:
    return functools.partial(run_steps, program, on_cpu=location.platform == "cpu")


def run_steps(program: Program, leaves: list[Any], n_steps: int | Array, on_cpu: bool = True) -> tuple[list[Any], Any]:
    """Run steps as ``lanes.run_steps`` does, but in NumPy: immediately, or in a callback if arguments are traced.

    If the program has unfused stages, its blocks are interpreted, and the unfused stages run in XLA.

    Args:
        leaves: Leaves of all worlds.
        on_cpu: Whether to treat subnormal numbers as zero, as XLA does on a CPU but not on a GPU.
    """
    if not program.fused:
        return lanes.run_steps(program, leaves, n_steps, run_block_in_callback)
    n_worlds, _ = lanes.batch_counts(program, leaves)
    array_leaves = [i for i, x in enumerate(leaves) if x is not None]
    written_shapes = [lanes.leaf_shape(program, i, n_worlds) for i in program.written_leaves]
    flag_shape = jax.ShapeDtypeStruct((n_worlds, 1), np.bool_)

    def run_arrays(n_steps: Any, *values: Any) -> tuple[list[np.ndarray], Any]:
        arrays = replace_leaves([None] * len(leaves), array_leaves, [np.asarray(x) for x in values])
        with flush_subnormals() if on_cpu else contextlib.nullcontext():
            return _run_steps(program, arrays, int(n_steps))

    values = [jax.random.key_data(leaves[i]) if is_key(leaves[i]) else leaves[i] for i in array_leaves]
    if any(isinstance(x, jax.core.Tracer) for x in (n_steps, *values)):
        out, flags = jax.pure_callback(
            run_arrays, (written_shapes, flag_shape), n_steps, *values, vmap_method="sequential"
        )
    else:
        out, flags = run_arrays(n_steps, *values)
    are_random_keys = [is_key(program.leaves[i]) for i in program.written_leaves]
    return [
        jax.random.wrap_key_data(jnp.asarray(x)) if is_random_key else x
        for x, is_random_key in zip(out, are_random_keys, strict=True)
    ], flags


def _run_steps(program: Program, leaves: list[Any], n_steps: int) -> tuple[list[np.ndarray], Any]:
    values = lanes.LeafValues(program, leaves, run_block, np)
    hoisted_results = lanes.prepare_steps(program, values)
    for _ in range(n_steps):
        lanes.run_phase(program, values, "each", hoisted_results)
    flagged = lanes.nonfinite_worlds(program, values)
    lanes.run_phase(program, values, "after", {})
    return [np.ascontiguousarray(values.array(i)) for i in program.written_leaves], flagged


@contextlib.contextmanager
def flush_subnormals() -> Iterator[None]:
    """Treat subnormal numbers as zero in this thread inside a ``with`` block, on x86-64 Linux; elsewhere do nothing."""
    library = _c_library()
    if library is None:
        yield
        return
    saved_environment = FloatEnvironment()
    library.fegetenv(saved_environment)
    flushing_environment = FloatEnvironment(*saved_environment)
    flushing_environment[MXCSR_INDEX] |= FLUSH_BITS
    library.fesetenv(flushing_environment)
    try:
        yield
    finally:
        library.fesetenv(saved_environment)


@functools.cache
def _c_library() -> ctypes.CDLL | None:
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return None
    for dtype in (np.float32, np.float64):
        np.finfo(dtype)  # NumPy computes the smallest numbers at the first call, and would get zero later
    return ctypes.CDLL(None)
