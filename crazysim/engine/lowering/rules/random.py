"""Rules for random numbers: JAX's default generator as integer arithmetic, with identical bits."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from crazysim.engine.ir.blocks import is_constant
from crazysim.engine.jaxcompat import JaxprEqn, bits_generator, threefry_prng_impl
from crazysim.engine.lowering.jaxprs import ElementArray, Lowering, UnsupportedError, as_elements, rule
from crazysim.engine.lowering.rules.movement import evaluate


@rule("random_wrap")
def _random_wrap(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    pairs = args[0].reshape(-1, 2)
    _check_generator(eqn.params["impl"])
    return [as_elements([(a, b) for a, b in pairs], args[0].shape[:-1])]


@rule("random_unwrap")
def _random_unwrap(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    return [_halves(args[0])]


def _halves(keys: ElementArray) -> ElementArray:
    return as_elements([half for key in keys.reshape(-1) for half in key], (*keys.shape, 2))


def _check_generator(impl: Any) -> None:
    if bits_generator(impl) != threefry_prng_impl.name:
        raise UnsupportedError(f"a random generator other than JAX's default, {threefry_prng_impl.name}: {impl}")


@rule("random_fold_in", "random_split", "random_bits", "random_seed")
def _random(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    name, params, impl = eqn.primitive.name, eqn.params, threefry_prng_impl
    takes_keys = name != "random_seed"
    if takes_keys:
        _check_generator(eqn.invars[0].aval.dtype._impl)
    random_function = {
        "random_fold_in": lambda key, data: impl.fold_in(key, data),
        "random_split": lambda key: impl.split(key, params["shape"]),
        "random_bits": lambda key: impl.random_bits(key, params["bit_width"], params["shape"]),
        "random_seed": lambda seed: impl.seed(seed),
    }[name]
    shape = np.broadcast_shapes(*(x.shape for x in args))
    columns = [np.broadcast_to(x, shape).reshape(-1) for x in args]
    outs = []
    for items in zip(*columns, strict=True):
        inputs = [as_elements(list(x), (2,)) if isinstance(x, tuple) else as_elements([x], ()) for x in items]
        avals = [jax.ShapeDtypeStruct(x.shape, x.reshape(-1)[0].dtype) for x in inputs]
        outs.append(ctx.lower(jax.make_jaxpr(random_function)(*avals), inputs)[0])
    aval = eqn.outvars[0].aval
    flat = [x for out in outs for x in out.reshape(-1)]
    if name == "random_bits":
        return [as_elements(flat, aval.shape)]
    return [as_elements(list(zip(flat[::2], flat[1::2], strict=True)), aval.shape)]


@rule("threefry2x32")
def _threefry(ctx: Lowering, eqn: JaxprEqn, args: list[ElementArray]) -> list[ElementArray]:
    shape = np.broadcast_shapes(*(x.shape for x in args))
    rows = [np.broadcast_to(x, shape).reshape(-1) for x in args]
    first, second = [], []
    for operands in zip(*rows, strict=True):
        if all(map(is_constant, operands)):
            a, b = (np.uint32(x) for x in evaluate(eqn, [np.asarray(w) for w in operands]))
        else:
            a, b = ctx.builder.add_many("threefry2x32", operands, (np.uint32, np.uint32))
        first.append(a)
        second.append(b)
    return [as_elements(first, shape), as_elements(second, shape)]
