"""When two engines agree: equality, and what rounding explains.

Numbers that were rounded may differ by a few units in the last place: XLA and the host's library approximate functions
differently, and compilers contract a product and a sum. A larger difference must be that of an ill-conditioned
function: computed primitive by primitive, with every result disturbed by a few units in the last place, it must spread
over both numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

EPS = float(np.finfo(np.float32).eps)
TINY = float(np.finfo(np.float32).tiny)
UNITS = 16
"""Units in the last place by which functions of two libraries may differ."""
SAMPLES = 24
"""Disturbed computations for each value that is looked at again."""

MOVES_ONLY = frozenset(
    "neg abs sign select_n copy convert_element_type bitcast_convert_type reshape squeeze broadcast_in_dim transpose "
    "rev slice concatenate gather scatter pad dynamic_slice dynamic_update_slice jit pjit stop_gradient iota lt ge gt "
    "le eq ne and or not clamp split stack unstack tile sqrt ceil floor round".split()
)
"""Primitives that keep the sign of zero on every engine. XLA does not in sums and products, nor do libraries of
functions."""


def keeps_sign_of_zero(fn: Any, avals: Sequence[Any]) -> bool:
    """Return True where a function of values of these shapes and types only moves, selects and compares numbers."""
    return all(name in MOVES_ONLY for name in _primitives(_inlined(fn, avals).jaxpr))


def _primitives(jaxpr: Any) -> Iterator[str]:
    for eqn in jaxpr.eqns:
        yield eqn.primitive.name
        for x in jax.tree.leaves(
            list(eqn.params.values()), is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")
        ):
            if hasattr(x, "eqns") or hasattr(x, "jaxpr"):
                yield from _primitives(getattr(x, "jaxpr", x))


def _inlined(fn: Any, args: Sequence[Any]) -> Any:
    """Return the jaxpr of a function, with the functions that it calls inlined if JAX can do that."""
    try:
        with jax.disable_jit():
            return jax.make_jaxpr(fn)(*args)
    except Exception:  # without jit, JAX sees concrete values and refuses some conversions of them
        return jax.make_jaxpr(fn)(*args)


def close(a: np.ndarray, b: np.ndarray, signed: bool) -> np.ndarray:
    """Return where values are equal, or numbers to a few units in the last place, the sign of zero if asked for."""
    if not jnp.issubdtype(a.dtype, jnp.floating):
        return a == b
    eps = max(EPS, float(jnp.finfo(a.dtype).eps))
    a, b = a.astype(np.float64), b.astype(np.float64)
    with np.errstate(all="ignore"):
        near = np.abs(a - b) <= UNITS * eps * np.maximum(np.abs(a), np.abs(b))
        near |= (np.abs(a) <= TINY) & (np.abs(b) <= TINY)  # below is zero to XLA, whose threads flush
    zeros = np.full(a.shape, True) if not signed else (a != 0) | (b != 0) | (np.signbit(a) == np.signbit(b))
    return ((a == b) & zeros) | (np.isnan(a) & np.isnan(b)) | (near & zeros & np.isfinite(a) & np.isfinite(b))


def explained(fn: Any, values: list[np.ndarray], found: np.ndarray, signed: bool) -> np.ndarray:
    """Return for which lanes a value is what a function gives for its operands, within rounding.

    The function is computed primitive by primitive, many times, and every result of arithmetic disturbed by a few units
    in the last place.
    """
    results = np.asarray(_disturbed(fn, values, len(found)))
    if not jnp.issubdtype(results.dtype, jnp.floating):
        ok = (results == found).any(0)
        return ok.reshape(len(ok), -1).all(1)
    r, f = results.astype(np.float64), found.astype(np.float64)
    eps = max(EPS, float(jnp.finfo(results.dtype).eps))
    with np.errstate(all="ignore"):
        low, high = np.min(np.where(np.isnan(r), np.inf, r), 0), np.max(np.where(np.isnan(r), -np.inf, r), 0)
        slack = UNITS * eps * np.maximum(np.abs(low), np.abs(high)) + (high - low) + TINY
        slack = np.where(np.isfinite(slack), slack, 0)
        within = (f >= low - slack) & (f <= high + slack)
        if signed:
            within &= ~((f == 0) & (r == 0).all(0) & (np.signbit(f) != np.signbit(r[0])))
        ok = within | (np.isnan(f) & np.isnan(r).any(0)) | (f == r).any(0) & ((f != 0) | within)
    return ok.reshape(len(ok), -1).all(1)


EXACT = MOVES_ONLY | {"max", "min", "sort", "while", "scan", "cond", "reduce_max", "reduce_min", "clamp", "random_bits"}
"""Primitives whose results are not disturbed: they do not round, or consist of others."""


def _disturbed(fn: Any, values: list[np.ndarray], n_lanes: int) -> Any:
    """Return a function's value with disturbed arithmetic. (SAMPLES, n_lanes, ...)"""
    rng = np.random.default_rng(0)
    samples = [jnp.broadcast_to(x, (SAMPLES, *x.shape)) for x in values]
    each = jax.vmap(fn, axis_size=n_lanes)
    jaxpr = _inlined(jax.vmap(each, axis_size=SAMPLES), samples)
    strength = np.linspace(0, 4, SAMPLES)  # the first is not disturbed

    def noisy(x: Any) -> Any:
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.extended) or not jnp.issubdtype(x.dtype, jnp.floating):
            return x
        if x.shape[:2] != (SAMPLES, n_lanes):
            return x
        noise = rng.uniform(-1, 1, x.shape) * strength.reshape(-1, *[1] * (x.ndim - 1)) * float(jnp.finfo(x.dtype).eps)
        disturbed = (x.astype(np.float32) * (1 + noise.astype(np.float32))).astype(x.dtype)
        return jnp.where(jnp.isfinite(disturbed), disturbed, x)

    env: dict[Any, Any] = dict(zip(jaxpr.jaxpr.constvars, jaxpr.consts, strict=True))
    env.update(zip(jaxpr.jaxpr.invars, map(noisy, samples), strict=True))
    for eqn in jaxpr.jaxpr.eqns:
        outs = _apply(eqn, [v.val if hasattr(v, "val") else env[v] for v in eqn.invars])
        exact = eqn.primitive.name in EXACT
        env.update(zip(eqn.outvars, outs if exact else map(noisy, outs), strict=True))
    (out,) = jaxpr.jaxpr.outvars
    return out.val if hasattr(out, "val") else env[out]


def _apply(eqn: Any, args: list[Any]) -> list[Any]:
    out = eqn.primitive.bind(*args, **eqn.primitive.get_bind_params(eqn.params))
    return list(out) if eqn.primitive.multiple_results else [out]
