"""A reader of programs (``ir``) that gives them to XLA: every value is a vector over drones, a lane each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend.random import threefry2x32_p

from crazysim.engine.ir import Block, Element, Value
from crazysim.engine.rules.elementwise import ELEMENTWISE


def run(block: Block, inputs: Sequence[Array], shape: tuple[int, ...], env: dict[int, Any] | None = None) -> list[Any]:
    """Return the outputs of a block.

    Args:
        block: The program.
        inputs: Its inputs, each of the lanes' shape, or a scalar that all lanes share.
        shape: Shape of the lanes.
        env: Values of the blocks around it.

    Returns:
        Its outputs, of the lanes' shape or scalars.
    """
    env = dict(env or {})
    env.update(zip(map(id, block.inputs), inputs, strict=True))
    last_use = _last_uses(block)
    for position, value in enumerate(block.values):
        if value.op == "barrier":
            _settle(env, block, position, last_use)
        else:
            env[id(value)] = _apply(value, [_get(env, a) for a in value.args], shape, env)
    return [_get(env, x) for x in block.outputs]


def _get(env: dict[int, Any], x: Element) -> Any:
    return env[id(x)] if isinstance(x, Value) else x


def _last_uses(block: Block) -> dict[int, int]:
    """Return where each value is used last; an output is used after the end."""
    last: dict[int, int] = {}
    for position, value in enumerate(block.values):
        inner = [x for b in value.blocks for v in b.walk() for x in v.args]
        inner += [x for b in value.blocks for x in _all_outputs(b)]
        for x in (*value.args, *inner):
            last[id(x)] = position
    last.update((id(x), len(block.values)) for x in block.outputs)
    return last


def _all_outputs(block: Block) -> list[Element]:
    return [*block.outputs, *(x for v in block.values for b in v.blocks for x in _all_outputs(b))]


def _settle(env: dict[int, Any], block: Block, position: int, last_use: dict[int, int]) -> None:
    """Compute once what is used beyond this point: XLA's CPU backend repeats shared arithmetic for every result."""
    live = [id(v) for v in block.values[:position] if last_use.get(id(v), -1) > position and np.ndim(env[id(v)])]
    env.update(zip(live, lax.optimization_barrier([env[i] for i in live]), strict=True))


def _apply(value: Value, args: list[Any], shape: tuple[int, ...], env: dict[int, Any]) -> Any:
    if value.op in STRUCTURE:
        return STRUCTURE[value.op](value, args, shape, env)
    if value.op == "item":
        return args[0][dict(value.params)["index"]]
    if value.op == "convert_element_type":
        return lax.convert_element_type(args[0], value.dtype)
    if value.op == "bitcast_convert_type":
        return lax.bitcast_convert_type(args[0], value.dtype)
    return FUNCTIONS[value.op](*_broadcast(args), **dict(value.params))


def _broadcast(args: Sequence[Any]) -> list[Array]:
    shape = jnp.broadcast_shapes(*map(np.shape, args))
    return [x if isinstance(x, jax.Array) and x.shape == shape else jnp.full(shape, jnp.asarray(x)) for x in args]


def _lanes(x: Any, shape: tuple[int, ...]) -> Array:
    return jnp.broadcast_to(x, shape)


def _loop(value: Value, args: list[Any], shape: tuple[int, ...], env: dict[int, Any]) -> list[Any]:
    (body,) = value.blocks
    carry = [_lanes(x, shape) for x in args]

    def turn(carry: list[Any], _: Any) -> tuple[list[Any], None]:
        return [_lanes(x, shape) for x in run(body, carry, shape, env)], None

    return lax.scan(turn, carry, length=dict(value.params)["length"])[0]


def _while(value: Value, args: list[Any], shape: tuple[int, ...], env: dict[int, Any]) -> list[Any]:
    """Go on while any lane does; the others keep what they have."""
    test, body = value.blocks

    def goes_on(carry: list[Any]) -> Array:
        return _lanes(run(test, carry, shape, env)[0], shape)

    def turn(carry: list[Any]) -> list[Any]:
        mask = goes_on(carry)
        new = run(body, carry, shape, env)
        return [jnp.where(mask, _lanes(x, shape), old) for x, old in zip(new, carry, strict=True)]

    return lax.while_loop(lambda carry: jnp.any(goes_on(carry)), turn, [_lanes(x, shape) for x in args])


def _when(value: Value, args: list[Any], shape: tuple[int, ...], env: dict[int, Any]) -> list[Any]:
    """Compute a block only if some lane needs it."""
    (body,) = value.blocks
    mask, old = args[0], [_lanes(x, shape) for x in args[1:]]

    def act(mask: Array, old: list[Array]) -> list[Array]:
        new = run(body, [], shape, env)
        return [jnp.where(mask, _lanes(x, shape), o) for x, o in zip(new, old, strict=True)]

    return lax.cond(jnp.any(mask), act, lambda _, old: old, mask, old)


def _custom_jvp(value: Value, args: list[Any], shape: tuple[int, ...], env: dict[int, Any]) -> list[Any]:
    (body,) = value.blocks
    slope = dict(value.params)["slope"]

    @jax.custom_jvp
    def call(*args: Any) -> list[Any]:
        return run(body, args, shape, env)

    @call.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        outs = call(*primals)
        changes = run(slope(), [*primals, *tangents], shape)
        return outs, [_lanes(t, np.shape(o)) for t, o in zip(changes, outs, strict=True)]

    return call(*(jnp.asarray(x) for x in args))


def _threefry(value: Value, args: list[Any], shape: tuple[int, ...], env: dict[int, Any]) -> list[Any]:
    return threefry2x32_p.bind(*_broadcast(args))


STRUCTURE: dict[str, Callable[..., Any]] = {
    "loop": _loop,
    "while": _while,
    "when": _when,
    "custom_jvp": _custom_jvp,
    "threefry2x32": _threefry,
}

OTHER_NAMES = {"and": "bitwise_and", "or": "bitwise_or", "xor": "bitwise_xor", "not": "bitwise_not"}
FUNCTIONS: dict[str, Callable[..., Any]] = {
    name: getattr(lax, OTHER_NAMES.get(name, name))
    for name in ELEMENTWISE
    if name != "square"  # is written as a product
}
