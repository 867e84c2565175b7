"""Rules for random numbers: JAX's default generator as integer arithmetic, bit for bit."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jax.extend.random import threefry_prng_impl

from crazysim.engine.ir import is_constant
from crazysim.engine.lower import Elements, Reader, UnsupportedError, pack, rule
from crazysim.engine.rules.movement import run_now


@rule("random_wrap")
def _random_wrap(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    words = args[0].reshape(-1, 2)
    _check_generator(eqn.params["impl"])
    return [pack([(a, b) for a, b in words], args[0].shape[:-1])]


@rule("random_unwrap")
def _random_unwrap(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    return [_words(args[0])]


def _words(keys: Elements) -> Elements:
    return pack([word for key in keys.reshape(-1) for word in key], (*keys.shape, 2))


def _check_generator(impl: Any) -> None:
    if getattr(impl, "name", str(impl)) != threefry_prng_impl.name:
        raise UnsupportedError(f"a random generator other than JAX's default, {threefry_prng_impl.name}: {impl}")


@rule("random_fold_in", "random_split", "random_bits", "random_seed")
def _random(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    """Follow what JAX's own generator does with the words of a key: integer arithmetic around one cipher."""
    name, p, impl = eqn.primitive.name, eqn.params, threefry_prng_impl
    keys = name != "random_seed"
    if keys:
        _check_generator(eqn.invars[0].aval.dtype._impl)
    single = {
        "random_fold_in": lambda key, data: impl.fold_in(key, data),
        "random_split": lambda key: impl.split(key, p["shape"]),
        "random_bits": lambda key: impl.random_bits(key, p["bit_width"], p["shape"]),
        "random_seed": lambda seed: impl.seed(seed),
    }[name]
    shape = np.broadcast_shapes(*(x.shape for x in args))
    columns = [np.broadcast_to(x, shape).reshape(-1) for x in args]
    outs = []
    for items in zip(*columns, strict=True):
        inputs = [pack(list(x), (2,)) if isinstance(x, tuple) else pack([x], ()) for x in items]
        avals = [jax.ShapeDtypeStruct(x.shape, x.reshape(-1)[0].dtype) for x in inputs]
        outs.append(r.read(jax.make_jaxpr(single)(*avals), inputs)[0])
    aval = eqn.outvars[0].aval
    flat = [x for out in outs for x in out.reshape(-1)]
    if name == "random_bits":
        return [pack(flat, aval.shape)]
    return [pack(list(zip(flat[::2], flat[1::2], strict=True)), aval.shape)]


@rule("threefry2x32")
def _threefry(r: Reader, eqn: Any, args: list[Elements]) -> list[Elements]:
    shape = np.broadcast_shapes(*(x.shape for x in args))
    rows = [np.broadcast_to(x, shape).reshape(-1) for x in args]
    first, second = [], []
    for words in zip(*rows, strict=True):
        if all(map(is_constant, words)):
            a, b = (np.uint32(x) for x in run_now(eqn, [np.asarray(w) for w in words]))
        else:
            both = r.block.add("threefry2x32", words, np.uint32)
            a, b = (r.block.add("item", (both,), np.uint32, (("index", i),)) for i in (0, 1))
        first.append(a)
        second.append(b)
    return [pack(first, shape), pack(second, shape)]
