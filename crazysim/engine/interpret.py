"""An interpreter: programs in NumPy, one operation after the other, with nothing compiled.

It is the meaning of the table of operations (``ops``), and slow. Passes, rules and other engines are tested against it,
and ``Sim(engine="interpret")`` steps with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.stage import with_leaves
from crazysim.engine import lanes, ops
from crazysim.engine.ir import Block, Operation, Value
from crazysim.engine.program import Program
from crazysim.jaxcompat import is_key

Env = dict[Value, np.ndarray]
"""Arrays by the values that they are."""

Observer = Callable[[Operation, Sequence[np.ndarray]], None]
"""Gets every operation with its results."""


def run(
    block: Block,
    inputs: Sequence[Any],
    shape: tuple[int, ...],
    env: Env | None = None,
    observe: Observer | None = None,
) -> list[np.ndarray]:
    """Return the outputs of a block.

    Args:
        block: The block.
        inputs: Its inputs, each of the lanes' shape, or a scalar that all lanes share, or a flat table.
        shape: Shape of the lanes.
        env: Values of the blocks around it.
        observe: Gets every operation with its results.

    Returns:
        Its outputs, of the lanes' shape.
    """
    env = dict(env or {})
    given = [np.asarray(x, v.dtype) for x, v in zip(inputs, block.inputs, strict=True)]
    lanes_of = (x if v.size else np.broadcast_to(x, shape) for x, v in zip(given, block.inputs, strict=True))
    env.update(zip(block.inputs, lanes_of, strict=True))
    with np.errstate(all="ignore"):
        for op in block.operations:
            args = [env[x] if isinstance(x, Value) else x for x in op.args]
            row = ops.TABLE[op.name]
            results = _structured(op, args, shape, env) if row.structured else [_number(op, row.numpy, args)]
            env.update(zip(op.results, results, strict=True))
            if observe is not None:
                observe(op, results)
    return [_broadcast(env[x] if isinstance(x, Value) else x, shape) for x in block.outputs]


def _broadcast(x: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return a value broadcast to all lanes; NumPy's own call takes as long as an operation."""
    return x if np.shape(x) == shape else np.broadcast_to(x, shape)


def _number(op: Operation, numpy: Callable[..., Any] | None, args: Sequence[Any]) -> Any:
    """Return the result of an operation that has one: of the lanes' shape, or a scalar."""
    if numpy is None:
        raise RuntimeError(f"operation {op.name!r} has no NumPy function; give it one in ops.TABLE")
    params = dict(op.params)
    if op.name in ("convert_element_type", "bitcast_convert_type"):
        params["dtype"] = op.dtype
    x = numpy(*args, **params)
    return x if x.dtype == op.dtype else np.asarray(x).astype(op.dtype)


def _structured(op: Operation, args: list[Any], shape: tuple[int, ...], env: Env) -> list[Any]:
    """Return the results of an operation that runs blocks, looks something up, or has several results."""
    match op.name:
        case "barrier":
            return []
        case "when":
            mask, *old = args
            new = run(op.blocks[0], [], shape, env) if mask.any() else old
            return [np.where(mask, x, y) for x, y in zip(new, old, strict=True)]
        case "loop":
            for _ in range(op.param("length")):
                args = run(op.blocks[0], args, shape, env)
            return args
        case "while":
            test, body = op.blocks
            while (mask := run(test, args, shape, env)[0]).any():
                args = [np.where(mask, x, y) for x, y in zip(run(body, args, shape, env), args, strict=True)]
            return args
        case "over_others":
            return _over_others(op, args, shape, env)
        case "custom_jvp":
            return run(op.blocks[0], args, shape, env)
        case "table":
            return [op.param("numbers").array]
        case "lookup":
            return [args[0][args[1] + op.param("offset")]]
        case "threefry2x32":
            return list(threefry2x32(*args))
    raise RuntimeError(
        f"expected a structured operation that is interpreted, got {op.name!r}; add a case to _structured"
    )


def _over_others(op: Operation, args: list[np.ndarray], shape: tuple[int, ...], env: Env) -> list[np.ndarray]:
    """Combine the results of a block for each drone of the world, one after the other."""
    n = op.param("n_members")
    own = np.arange(shape[0]) % n
    combine: list[Any] = [ops.TABLE[name].numpy for name in op.param("reduce")]
    found = [np.full(shape, ops.neutral(name, x.dtype)) for name, x in zip(op.param("reduce"), op.results, strict=True)]
    for j in range(n):
        other = [np.repeat(np.broadcast_to(x, shape).reshape(-1, n)[:, j], n) for x in args]
        new = run(op.blocks[0], [*other, own == j], shape, env)
        found = [fn(x, y) for fn, x, y in zip(combine, found, new, strict=True)]
    return found


ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
"""Bits that a round rotates by: J. K. Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC 2011, table 2."""


def threefry2x32(k0: np.ndarray, k1: np.ndarray, x0: np.ndarray, x1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the two integers of 32 bits that 20 rounds of Threefry make of two, under a key of two."""
    keys = (k0, k1, k0 ^ k1 ^ np.uint32(0x1BD11BDA))
    x0, x1 = x0 + keys[0], x1 + keys[1]
    for n in range(5):
        for r in ROTATIONS[n % 2]:
            x0 = x0 + x1
            x1 = (x1 << np.uint32(r)) | (x1 >> np.uint32(32 - r))
            x1 = x1 ^ x0
        x0, x1 = x0 + keys[(n + 1) % 3], x1 + keys[(n + 2) % 3] + np.uint32(n + 1)
    return x0, x1


def call(block: Block, inputs: Sequence[Any], shape: tuple[int, ...]) -> list[Array]:
    """Return what ``run`` does, inside a function that JAX traces or compiles; it has no derivative."""
    results = [jax.ShapeDtypeStruct(shape, x.dtype) for x in block.outputs]

    def of_arrays(*inputs: Any) -> list[np.ndarray]:
        return [np.array(x) for x in run(block, [np.asarray(x) for x in inputs], shape)]

    return list(jax.pure_callback(of_arrays, results, *inputs, vmap_method="sequential"))


def steps(program: Program, leaves: list[Any], n_steps: int | Array) -> tuple[list[Any], Any]:
    """Return what ``lanes.steps`` does, all in NumPy: at once, or in a callback where arguments are traced.

    If stages are not fused, only blocks are interpreted, and the rest runs in XLA.
    """
    if not program.fused:
        return lanes.steps(program, leaves, n_steps, call)
    n_worlds, _ = lanes.batch(program, leaves)
    given = [i for i, x in enumerate(leaves) if x is not None]
    written = [lanes.shape_of(program, i, n_worlds) for i in program.written]
    flagged = jax.ShapeDtypeStruct((n_worlds, 1), np.bool_)

    def of_arrays(n_steps: Any, *values: Any) -> tuple[list[np.ndarray], Any]:
        return _steps(program, with_leaves([None] * len(leaves), given, [np.asarray(x) for x in values]), int(n_steps))

    values = [jax.random.key_data(leaves[i]) if is_key(leaves[i]) else leaves[i] for i in given]
    if any(isinstance(x, jax.core.Tracer) for x in (n_steps, *values)):
        out, flags = jax.pure_callback(of_arrays, (written, flagged), n_steps, *values, vmap_method="sequential")
    else:
        out, flags = of_arrays(n_steps, *values)
    keys = [is_key(program.leaves[i]) for i in program.written]
    return [jax.random.wrap_key_data(jnp.asarray(x)) if key else x for x, key in zip(out, keys, strict=True)], flags


def _steps(program: Program, leaves: list[Any], n_steps: int) -> tuple[list[np.ndarray], Any]:
    now = lanes.Lanes(program, leaves, run, np)
    constants = lanes.prepare(program, now)
    for _ in range(n_steps):
        lanes.run(program, now, "each", constants)
    flagged = lanes.nonfinite(program, now)
    lanes.run(program, now, "last", {})
    return [np.ascontiguousarray(now.array(i)) for i in program.written], flagged
