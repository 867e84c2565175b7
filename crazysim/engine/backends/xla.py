"""Blocks as XLA operations: a value is an array over lanes, a scalar that all lanes share, or a table."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from crazysim.engine import jaxcompat
from crazysim.engine.ir import ops
from crazysim.engine.ir.blocks import Block, Element, Operation, Value
from crazysim.engine.pair_reductions import safe_max, safe_min

Env = dict[Value, Any]
"""Array of each value."""


def run_block(block: Block, inputs: Sequence[Array], shape: tuple[int, ...], env: Env | None = None) -> list[Any]:
    """Return the outputs of a block.

    Args:
        inputs: Inputs of the block: arrays of the lanes' shape, scalars that all lanes share, or flat tables.
        shape: Shape of the lanes.
        env: Values of the enclosing blocks.

    Returns:
        Its outputs, of the lanes' shape or scalars.
    """
    env = dict(env or {})
    env.update(zip(block.inputs, inputs, strict=True))
    last_uses = _last_uses(block)
    for position, op in enumerate(block.operations):
        if op.name == "barrier":
            _add_barrier(env, block, position, last_uses)
        else:
            env.update(
                zip(op.results, _apply_operation(op, [_get_array(env, a) for a in op.args], shape, env), strict=True)
            )
    return [_get_array(env, x) for x in block.outputs]


def _get_array(env: Env, x: Element) -> Any:
    return env[x] if isinstance(x, Value) else x


def _last_uses(block: Block) -> dict[Value, int]:
    last_uses: dict[Value, int] = {}
    for position, op in enumerate(block.operations):
        used = {x for x in op.args if isinstance(x, Value)}.union(*(b.used_values() for b in op.blocks))
        last_uses.update(dict.fromkeys(used, position))
    last_uses.update((x, len(block.operations)) for x in block.outputs if isinstance(x, Value))
    return last_uses


def _add_barrier(env: Env, block: Block, position: int, last_uses: dict[Value, int]) -> None:
    results = [x for op in block.operations[:position] for x in op.results]
    live = [x for x in results if last_uses.get(x, -1) > position and not x.size and np.ndim(env[x])]
    env.update(zip(live, jaxcompat.barrier([env[x] for x in live]), strict=True))


def _apply_operation(op: Operation, args: list[Any], shape: tuple[int, ...], env: Env) -> Sequence[Any]:
    if op.name in STRUCTURED_RULES:
        return STRUCTURED_RULES[op.name](op, args, shape, env)
    if op.name in ("convert_element_type", "bitcast_convert_type"):
        return [getattr(lax, op.name)(args[0], op.dtype)]
    fn = ops.TABLE[op.name].xla or op.name
    return [(getattr(lax, fn) if isinstance(fn, str) else fn)(*_broadcast(args), **dict(op.params))]


def _broadcast(args: Sequence[Any]) -> list[Array]:
    shape = jnp.broadcast_shapes(*map(np.shape, args))
    return [x if isinstance(x, jax.Array) and x.shape == shape else jnp.full(shape, jnp.asarray(x)) for x in args]


def _loop(op: Operation, args: list[Any], shape: tuple[int, ...], env: Env) -> list[Any]:
    (body,) = op.blocks
    carry = [jnp.broadcast_to(x, shape) for x in args]

    def iterate(carry: list[Any], _: Any) -> tuple[list[Any], None]:
        return [jnp.broadcast_to(x, shape) for x in run_block(body, carry, shape, env)], None

    return lax.scan(iterate, carry, length=op.param("length"))[0]


def _while(op: Operation, args: list[Any], shape: tuple[int, ...], env: Env) -> list[Any]:
    test, body = op.blocks

    def is_continuing(carry: list[Any]) -> Array:
        return jnp.broadcast_to(run_block(test, carry, shape, env)[0], shape)

    def iterate(carry: list[Any]) -> list[Any]:
        mask = is_continuing(carry)
        new_values = run_block(body, carry, shape, env)
        return [jnp.where(mask, jnp.broadcast_to(new, shape), old) for new, old in zip(new_values, carry, strict=True)]

    return lax.while_loop(
        lambda carry: jnp.any(is_continuing(carry)), iterate, [jnp.broadcast_to(x, shape) for x in args]
    )


def _when(op: Operation, args: list[Any], shape: tuple[int, ...], env: Env) -> list[Any]:
    (body,) = op.blocks
    mask, old_values = args[0], [jnp.broadcast_to(x, shape) for x in args[1:]]

    def run_body(mask: Array, old_values: list[Array]) -> list[Array]:
        new_values = run_block(body, [], shape, env)
        return [
            jnp.where(mask, jnp.broadcast_to(new, shape), old) for new, old in zip(new_values, old_values, strict=True)
        ]

    return lax.cond(jnp.any(mask), run_body, lambda _, values: values, mask, old_values)


def _custom_jvp(op: Operation, args: list[Any], shape: tuple[int, ...], env: Env) -> list[Any]:
    (body,) = op.blocks
    derivative = op.param("derivative")

    @jax.custom_jvp
    def call(*args: Any) -> list[Any]:
        return run_block(body, args, shape, env)

    @call.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        outs = call(*primals)
        out_tangents = run_block(derivative(), [*primals, *tangents], shape)
        return outs, [jnp.broadcast_to(t, np.shape(o)) for t, o in zip(out_tangents, outs, strict=True)]

    return call(*(jnp.asarray(x) for x in args))


MAX_UNROLLED = 8
"""Maximum number of drones per world for which the loop over other drones is unrolled. For larger worlds, arrays get an
axis for the other drones."""


def _over_others(op: Operation, args: list[Any], shape: tuple[int, ...], env: Env) -> list[Any]:
    (block,), n = op.blocks, op.param("n_members")
    n_worlds = shape[0] // n
    used = [v for v in block.used_values() if v in env]
    lane_values = {v: env[v] for v in used if not v.size and np.ndim(env[v])}
    shared_values = {v: env[v] for v in used if v not in lane_values}
    rows = [jnp.reshape(x, (n_worlds, n)) if np.ndim(x) else x for x in args]
    if n <= MAX_UNROLLED:
        drone_number = lax.broadcasted_iota(np.int32, (n_worlds, n), 1)
        own_values = {v: jnp.reshape(x, (n_worlds, n)) for v, x in lane_values.items()}
        results_by_drone = []
        for j in range(n):
            other_numbers = [x[:, j : j + 1] if np.ndim(x) else x for x in rows]
            results_by_drone.append(
                run_block(block, [*other_numbers, drone_number == j], (n_worlds, n), shared_values | own_values)
            )
        combining_functions = [COMBINING_FUNCTIONS[name] for name in op.param("reduce")]
        reduced_results = [functools.reduce(fn, [jnp.broadcast_to(x, (n_worlds, n)) for x in results])
                   for fn, results in zip(combining_functions, zip(*results_by_drone, strict=True), strict=True)
                   ]  # fmt: skip
        return [jnp.reshape(x, shape) for x in reduced_results]
    columns = [jnp.reshape(x, (n_worlds, n)).T[..., None] for x in lane_values.values()]  # (n, n_worlds, 1)

    def reduce_for_drone(xs: tuple[Array, list[Array]]) -> list[Array]:
        i, column = xs
        own_values = dict(zip(lane_values, column, strict=True))
        outs = run_block(block, [*rows, jnp.arange(n)[None] == i], (n_worlds, n), shared_values | own_values)
        return [
            REDUCING_FUNCTIONS[name](jnp.broadcast_to(x, (n_worlds, n)), axis=1)
            for name, x in zip(op.param("reduce"), outs, strict=True)
        ]

    drone_indices = jnp.arange(n)
    if n_worlds * n * n <= MAX_PAIRS:
        reduced_results = jax.vmap(reduce_for_drone)((drone_indices, columns))
    else:
        batch_size = max(1, MAX_PAIRS // (n_worlds * n))
        reduced_results = lax.map(jax.checkpoint(reduce_for_drone), (drone_indices, columns), batch_size=batch_size)
    return [x.T.reshape(shape) for x in reduced_results]


COMBINING_FUNCTIONS: dict[str, Callable[..., Array]] = {
    "add": lax.add, "min": lax.min, "max": lax.max, "or": lax.bitwise_or, "and": lax.bitwise_and,
}  # fmt: skip
"""Operations on two numbers by which reductions combine results."""

REDUCING_FUNCTIONS: dict[str, Callable[..., Array]] = {
    "add": jnp.sum,
    "min": safe_min,
    "max": safe_max,
    "or": jnp.any,
    "and": jnp.all,
}
"""Reductions along an axis, by the name of the operation that combines two numbers."""

MAX_PAIRS = 2**24
"""Maximum number of pairs of drones, over all worlds, computed at once; the memory of a gradient grows with it."""


def _table(op: Operation, args: list[Any], shape: tuple[int, ...], env: Env) -> list[Any]:
    return [jnp.asarray(op.param("numbers").array)]


def _lookup(op: Operation, args: list[Any], shape: tuple[int, ...], env: Env) -> list[Any]:
    table, index = args
    return [jnp.asarray(table).at[index + op.param("offset")].get(mode="promise_in_bounds")]


def _any_lane(op: Operation, args: list[Any], shape: tuple[int, ...], env: Env) -> list[Any]:
    return args


def _threefry(op: Operation, args: list[Any], shape: tuple[int, ...], env: Env) -> list[Any]:
    return jaxcompat.threefry2x32_p.bind(*_broadcast(args))


STRUCTURED_RULES: dict[str, Callable[..., Any]] = {
    "loop": _loop,
    "while": _while,
    "when": _when,
    "custom_jvp": _custom_jvp,
    "over_others": _over_others,
    "table": _table,
    "lookup": _lookup,
    "threefry2x32": _threefry,
    "any_lane": _any_lane,
}
"""Functions that compute the results of structured operations, by name."""
