"""Comparison of the results of two engines, which must be equal or differ only by rounding.

Numbers that were rounded may differ by a few units in the last place: XLA and the host's library approximate functions
differently, and compilers contract a product and a sum. A larger difference must come from an ill-conditioned
function. The function is then computed primitive by primitive, with every result disturbed by a few units in the last
place, and the range of its results must include both numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

EPS = float(np.finfo(np.float32).eps)
TINY = float(np.finfo(np.float32).tiny)
ULP_TOLERANCE = 16
"""Units in the last place by which functions of two libraries may differ."""
N_SAMPLES = 24
"""Number of disturbed computations for each value that is examined."""
GAMMA_ERROR = 2.5e-7
"""Absolute error of XLA's float32 ``lgamma`` and ``digamma`` for a disturbance of one unit. Both add large
terms, so near their zeros, for ``lgamma`` 1 and 2, their relative error has no bound: XLA gives 4.8e-7 for
``lgamma(1)``, and is off by 4e-7 at 1.489."""

SIGN_PRESERVING_PRIMITIVES = frozenset(
    "neg abs sign select_n copy convert_element_type bitcast_convert_type reshape squeeze broadcast_in_dim transpose "
    "rev slice concatenate gather scatter pad dynamic_slice dynamic_update_slice jit pjit stop_gradient iota lt ge gt "
    "le eq ne and or not clamp split stack unstack tile sqrt ceil floor round".split()
)
"""Primitives that preserve the sign of zero on every engine. Sums, products and library functions do not."""


def keeps_sign_of_zero(fn, avals: Sequence) -> bool:
    """Return True where a function of values of these shapes and types only moves, selects and compares numbers."""
    return all(name in SIGN_PRESERVING_PRIMITIVES for name in _primitives(_inlined(fn, avals).jaxpr))


def _primitives(jaxpr) -> Iterator[str]:
    for eqn in jaxpr.eqns:
        yield eqn.primitive.name
        for x in jax.tree.leaves(
            list(eqn.params.values()), is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")
        ):
            if hasattr(x, "eqns") or hasattr(x, "jaxpr"):
                yield from _primitives(getattr(x, "jaxpr", x))


def _inlined(fn, args: Sequence):
    try:
        with jax.disable_jit():
            return jax.make_jaxpr(fn)(*args)
    except Exception:  # without jit, JAX sees concrete values and refuses some conversions of them
        return jax.make_jaxpr(fn)(*args)


def is_close(a: np.ndarray, b: np.ndarray, signed: bool) -> np.ndarray:
    """Return True where values are equal, or floats within a few units in the last place.

    If ``signed``, zeros must have the same sign.
    """
    if not jnp.issubdtype(a.dtype, jnp.floating):
        return a == b
    eps = max(EPS, float(jnp.finfo(a.dtype).eps))
    a, b = a.astype(np.float64), b.astype(np.float64)
    with np.errstate(all="ignore"):
        is_near = np.abs(a - b) <= ULP_TOLERANCE * eps * np.maximum(np.abs(a), np.abs(b))
        is_near |= (np.abs(a) <= TINY) & (np.abs(b) <= TINY)  # XLA flushes smaller numbers to zero
    zeros = np.full(a.shape, True) if not signed else (a != 0) | (b != 0) | (np.signbit(a) == np.signbit(b))
    return ((a == b) & zeros) | (np.isnan(a) & np.isnan(b)) | (is_near & zeros & np.isfinite(a) & np.isfinite(b))


def are_within_rounding(fn, values: list[np.ndarray], actual: np.ndarray, signed: bool) -> np.ndarray:
    """Return True for the lanes in which a value is the result of a function for its operands, within rounding.

    The function is computed primitive by primitive, many times. Every result of arithmetic is disturbed by a few units
    in the last place, or replaced by one of its alternatives (``find_alternatives``).
    """
    results = np.asarray(_disturbed_results(fn, values, len(actual)))
    if not jnp.issubdtype(results.dtype, jnp.floating):
        ok = (results == actual).any(0)
        return ok.reshape(len(ok), -1).all(1)
    r, f = results.astype(np.float64), actual.astype(np.float64)
    eps = max(EPS, float(jnp.finfo(results.dtype).eps))
    with np.errstate(all="ignore"):
        low, high = np.min(np.where(np.isnan(r), np.inf, r), 0), np.max(np.where(np.isnan(r), -np.inf, r), 0)
        slack = ULP_TOLERANCE * eps * np.maximum(np.abs(low), np.abs(high)) + (high - low) + TINY
        slack = np.where(np.isfinite(slack), slack, 0)
        is_within = (f >= low - slack) & (f <= high + slack)
        if signed:
            is_within &= ~((f == 0) & (r == 0).all(0) & (np.signbit(f) != np.signbit(r[0])))
        ok = is_within | (np.isnan(f) & np.isnan(r).any(0)) | (f == r).any(0) & ((f != 0) | is_within)
    return ok.reshape(len(ok), -1).all(1)


UNDISTURBED_PRIMITIVES = SIGN_PRESERVING_PRIMITIVES | {
    "max",
    "min",
    "sort",
    "while",
    "scan",
    "cond",
    "reduce_max",
    "reduce_min",
    "clamp",
    "random_bits",
}
"""Primitives whose results are not disturbed: they do not round, or they consist of other primitives."""


def _abs_finite(x):
    return jnp.where(jnp.isfinite(x), jnp.abs(x), 1)


def _product_leaves_range(eqn, x):
    size = jnp.where(np.asarray(x) == 0, 1, _abs_finite(x))
    (largest,), (smallest,) = _apply(eqn, [jnp.maximum(size, 1)]), _apply(eqn, [jnp.minimum(size, 1)])
    return jnp.isinf(largest) | (smallest < TINY)


def _sum_leaves_range(eqn, *args: Any):
    return jnp.isinf(_apply(eqn, [_abs_finite(x) for x in args])[0])


def _denormal_divisor(eqn, x, y):
    y = np.asarray(y)  # in NumPy, which does not flush denormal numbers
    return np.broadcast_to((y != 0) & (np.abs(y) < TINY), np.broadcast_shapes(np.shape(x), y.shape))


ANY_NUMBER = (np.inf, -np.inf, np.nan, 0.0)
"""Numbers that span all numbers."""

ALTERNATIVES: dict[tuple[str, str], tuple[Callable, tuple[float, ...]]] = {
    # Where a product overflows before it is added, a contracted multiply-add has a finite sum, or another infinity.
    ("mul", "f"): (_sum_leaves_range, ANY_NUMBER),
    ("dot_general", "f"): (_sum_leaves_range, ANY_NUMBER),
    # Engines add and multiply in different orders.
    ("reduce_sum", "f"): (_sum_leaves_range, ANY_NUMBER),
    ("cumsum", "f"): (_sum_leaves_range, ANY_NUMBER),
    ("reduce_prod", "f"): (_product_leaves_range, ANY_NUMBER),
    ("cumprod", "f"): (_product_leaves_range, ANY_NUMBER),
    # XLA may flush denormal numbers to zero, which decides whether a division is by zero.
    ("rem", "f"): (_denormal_divisor, (np.nan, 0.0)),
    ("div", "f"): (_denormal_divisor, (np.nan, np.inf, -np.inf, 0.0)),
    # XLA's result of 0 / 0 is -1, but its compilers fold x / x to 1.
    ("div", "i"): (lambda eqn, x, y: (x == 0) & (y == 0), (1, 0)),
    ("div", "u"): (lambda eqn, x, y: (x == 0) & (y == 0), (1, 0)),
}
"""By primitive and kind of number: a function that returns where the result is not determined to a few units, and
numbers that span the possible results there."""


LARGEST_ANGLE = 1e12
"""Angle beyond which kernels on a GPU do not reduce it, rad."""


def allow_gpu_results() -> None:
    def is_large(eqn, x):
        del eqn
        return jnp.abs(x) > LARGEST_ANGLE

    for name, numbers in {"sin": (-1.0, 1.0), "cos": (-1.0, 1.0), "tan": ANY_NUMBER}.items():
        ALTERNATIVES[name, "f"] = is_large, numbers


def find_alternatives(eqn, args: Sequence, out) -> tuple[Any, tuple[float, ...]] | None:
    where, numbers = ALTERNATIVES.get((eqn.primitive.name, np.dtype(out.dtype).kind), (None, ()))
    return None if where is None else (where(eqn, *args), numbers)


def _disturbed_results(fn, values: list[np.ndarray], n_lanes: int):
    rng = np.random.default_rng(0)
    samples = [jnp.broadcast_to(x, (N_SAMPLES, *x.shape)) for x in values]
    batched_fn = jax.vmap(fn, axis_size=n_lanes)
    jaxpr = _inlined(jax.vmap(batched_fn, axis_size=N_SAMPLES), samples)
    strength = np.linspace(0, 4, N_SAMPLES)  # the first is not disturbed

    def is_sampled(x) -> bool:
        return not jax.dtypes.issubdtype(x.dtype, jax.dtypes.extended) and x.shape[:2] == (N_SAMPLES, n_lanes)

    def disturb(x, absolute: float = 0.0):
        if not is_sampled(x) or not jnp.issubdtype(x.dtype, jnp.floating):
            return x
        unit = (rng.uniform(-1, 1, x.shape) * strength.reshape(-1, *[1] * (x.ndim - 1))).astype(np.float32)
        x32 = x.astype(np.float32)
        disturbed = x32 * (1 + float(jnp.finfo(x.dtype).eps) * unit)
        disturbed = (disturbed + absolute * unit if absolute else disturbed).astype(x.dtype)  # keeps the sign of zero
        exact = np.asarray(x32)  # XLA may flush denormal numbers here too
        denormal = (exact != 0) & (np.abs(exact) < TINY)
        flushed = np.arange(N_SAMPLES).reshape(-1, *[1] * (x.ndim - 1)) % 2 == 1
        undisturbed = jnp.where(denormal & flushed, jnp.zeros_like(x), x)
        return jnp.where(jnp.isfinite(disturbed) & ~denormal, disturbed, undisturbed)

    def any_alternative(eqn, args: list, out):
        result = find_alternatives(eqn, args, out) if is_sampled(out) else None
        if result is None:
            return out
        where, numbers = result
        choices = rng.integers(len(numbers) + 1, size=out.shape)
        choices[0] = len(numbers)  # the first is not disturbed
        for k, number in enumerate(numbers):
            out = jnp.where(where & (choices == k), jnp.asarray(number, out.dtype), out)
        return out

    env: dict = dict(zip(jaxpr.jaxpr.constvars, jaxpr.consts, strict=True))
    env.update(zip(jaxpr.jaxpr.invars, map(disturb, samples), strict=True))
    for eqn in jaxpr.jaxpr.eqns:
        args = [v.val if hasattr(v, "val") else env[v] for v in eqn.invars]
        outs, name = _apply(eqn, args), eqn.primitive.name
        if name not in UNDISTURBED_PRIMITIVES:
            outs = [disturb(x, GAMMA_ERROR if name in ("lgamma", "digamma") else 0.0) for x in outs]
            outs = [any_alternative(eqn, args, x) for x in outs]
        env.update(zip(eqn.outvars, outs, strict=True))
    (out,) = jaxpr.jaxpr.outvars
    return out.val if hasattr(out, "val") else env[out]


def _apply(eqn, args: list) -> list:
    out = eqn.primitive.bind(*args, **eqn.primitive.get_bind_params(eqn.params))
    return list(out) if eqn.primitive.multiple_results else [out]
