"""Small programs of JAX in NumPy, for the tests.

Outside of ``jit``, JAX compiles each operation once more for each shape: some 2,400 programs of 10 ms to 30 ms in one
run of the tests. A program that moves, compares and selects numbers gives the same bits in NumPy, and so does one with
a single sum or product; with two, XLA may round once instead of twice. Numbers below 1e-38 are the exception: XLA takes
them for zero.
"""

import functools
import math
import time
import weakref
from importlib.metadata import version

import jax
import numpy as np
from jax.extend.core import Literal

COMPILING = 0.015
"""Time of interpreting after which a program is compiled, s: as long as that takes."""


def interpret() -> None:
    """Interpret small programs in this process; releases of JAX from 0.11 on compile them."""
    if not version("jax").startswith("0.10."):
        return
    from jax._src import pjit

    compiled = pjit._pjit_call_impl_python

    @functools.wraps(compiled)
    def call(*args, **params):
        jaxpr = params["jaxpr"]
        if jaxpr not in _LEFT:
            _LEFT[jaxpr] = COMPILING if is_small(jaxpr) else 0.0
        device = _device(args, params) if _LEFT[jaxpr] > 0 else None
        if device is None:
            return compiled(*args, **params)
        begun = time.perf_counter()
        out = [jax.device_put(np.asarray(x), *device) for x in evaluate(jaxpr, [np.asarray(x) for x in args])]
        _LEFT[jaxpr] -= time.perf_counter() - begun
        return out, None, None, []

    pjit._pjit_call_impl_python = call


_LEFT = weakref.WeakKeyDictionary()
"""Time for which a program is still interpreted, s, by its jaxpr."""


def _device(args, params):
    """Return the device that the results are committed to, if any, in a tuple; None if the call must be compiled."""
    from jax._src.sharding_impls import UnspecifiedValue

    places = [params[name] for name in ("in_shardings", "out_shardings", "in_layouts", "out_layouts")]
    if any(not isinstance(x, UnspecifiedValue | None) for some in places for x in some):
        return None
    if any(params["donated_invars"]) or params["compiler_options_kvs"] or jax.config.jax_default_device is not None:
        return None
    arrays = [x for x in args if isinstance(x, jax.Array)]
    devices = {device for x in arrays for device in x.devices()}
    committed = any(x.committed for x in arrays)
    if jax.default_backend() != "cpu" or not devices <= {jax.devices()[0]}:
        return None
    return tuple(devices) if committed else ()


def is_small(closed) -> bool:
    """Return whether NumPy gives the bits that a compiled jaxpr gives, without effects and weak types."""
    types = [v.aval for v in (*closed.jaxpr.invars, *closed.jaxpr.constvars, *closed.jaxpr.outvars)]
    weak = any(x.weak_type for x in closed.out_avals)
    return not closed.effects and not weak and all(map(_is_number, types)) and _n_rounded(closed.jaxpr) <= 1


def _is_number(aval):
    return isinstance(getattr(aval, "dtype", None), np.dtype)


def _n_rounded(jaxpr):
    """Return how many operations round; infinitely many if there is one that NumPy does not have."""
    total = 0
    for eqn in jaxpr.eqns:
        name, inner = eqn.primitive.name, _called(eqn)
        if not all(_is_number(v.aval) for v in (*eqn.invars, *eqn.outvars)):
            return math.inf
        if inner is not None:
            total += _n_rounded(inner.jaxpr)
        elif name in ROUNDED and (name != "div" or eqn.outvars[0].aval.dtype.kind == "f"):
            total += eqn.outvars[0].aval.dtype.kind == "f"
        elif name not in EXACT or (name in CASES and not CASES[name](eqn)):
            return math.inf
    return total


def _called(eqn):
    """Return the jaxpr that an operation calls, if that is all it does."""
    return {"jit": eqn.params.get("jaxpr"), "custom_jvp_call": eqn.params.get("call_jaxpr")}.get(eqn.primitive.name)


def evaluate(closed, args) -> list[np.ndarray]:
    """Return the results of a jaxpr for which ``is_small`` is true."""
    jaxpr = closed.jaxpr
    env = dict(zip(jaxpr.constvars, map(np.asarray, closed.consts), strict=True))
    env.update(zip(jaxpr.invars, args, strict=True))

    def read(x):
        return np.asarray(x.val, x.aval.dtype) if isinstance(x, Literal) else env[x]

    with np.errstate(all="ignore"):
        for eqn in jaxpr.eqns:
            given, inner = [read(x) for x in eqn.invars], _called(eqn)
            if inner is not None:
                env.update(zip(eqn.outvars, evaluate(inner, given), strict=True))
            else:
                env[eqn.outvars[0]] = OPERATIONS[eqn.primitive.name](*given, eqn=eqn)
    return [read(x) for x in jaxpr.outvars]


def _each(fn):
    return lambda *args, eqn: np.asarray(fn(*args), eqn.outvars[0].aval.dtype)


def _along(fn):
    return lambda x, eqn: fn(x, axis=tuple(eqn.params["axes"]))


def _broadcast_in_dim(x, eqn):
    shape = [1] * len(eqn.params["shape"])
    for axis, n in zip(eqn.params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = n
    return np.broadcast_to(x.reshape(shape), eqn.params["shape"])


def _window(x, sizes, starts):
    """Return the index of a window, which XLA moves inside."""
    begins = [min(max(int(k), 0), n - size) for k, n, size in zip(starts, x.shape, sizes, strict=True)]
    return tuple(slice(k, k + size) for k, size in zip(begins, sizes, strict=True))


def _dynamic_update_slice(x, update, *starts, eqn):
    out = np.array(x)
    out[_window(x, update.shape, starts)] = update
    return out


def _slice(x, eqn):
    p = eqn.params
    return x[tuple(map(slice, p["start_indices"], p["limit_indices"], p["strides"] or [1] * x.ndim))]


def _iota(eqn):
    p = eqn.params
    shape = [1] * len(p["shape"])
    shape[p["dimension"]] = -1
    return np.broadcast_to(np.arange(p["shape"][p["dimension"]], dtype=p["dtype"]).reshape(shape), p["shape"])


def _same(x, eqn):
    return x


EXACT = {
    "and": _each(np.bitwise_and),
    "broadcast_in_dim": _broadcast_in_dim,
    "concatenate": lambda *xs, eqn: np.concatenate(xs, eqn.params["dimension"]),
    "convert_element_type": lambda x, eqn: x.astype(eqn.params["new_dtype"]),
    "copy": _same,
    "dynamic_slice": lambda x, *starts, eqn: x[_window(x, eqn.params["slice_sizes"], starts)],
    "dynamic_update_slice": _dynamic_update_slice,
    "eq": _each(np.equal),
    "ge": _each(np.greater_equal),
    "gt": _each(np.greater),
    "iota": _iota,
    "is_finite": _each(np.isfinite),
    "le": _each(np.less_equal),
    "lt": _each(np.less),
    "max": _each(np.maximum),
    "min": _each(np.minimum),
    "ne": _each(np.not_equal),
    "neg": _each(np.negative),
    "not": _each(np.invert),
    "or": _each(np.bitwise_or),
    "reduce_and": _along(np.all),
    "reduce_max": _along(np.max),
    "reduce_min": _along(np.min),
    "reduce_or": _along(np.any),
    "reshape": lambda x, eqn: x.reshape(eqn.params["new_sizes"]),
    "rev": lambda x, eqn: np.flip(x, eqn.params["dimensions"]),
    "select_n": lambda which, *cases, eqn: np.where(which, *cases[::-1]),
    "slice": _slice,
    "squeeze": lambda x, eqn: x.reshape(eqn.outvars[0].aval.shape),
    "stage": _same,
    "transpose": lambda x, eqn: np.transpose(x, eqn.params["permutation"]),
}
"""Operations of which NumPy has the same bits."""

CASES = {
    "broadcast_in_dim": lambda eqn: len(eqn.invars) == 1,
    # A float becomes the nearest integer that there is in XLA, and any in NumPy.
    "convert_element_type": lambda eqn: eqn.invars[0].aval.dtype.kind != "f" or eqn.outvars[0].aval.dtype.kind in "fb",
    "iota": lambda eqn: not eqn.invars,
    "reduce_and": lambda eqn: eqn.invars[0].aval.dtype == bool,
    "reduce_or": lambda eqn: eqn.invars[0].aval.dtype == bool,
    "reshape": lambda eqn: eqn.params["dimensions"] is None and len(eqn.invars) == 1,
    "select_n": lambda eqn: eqn.invars[0].aval.dtype == bool and len(eqn.invars) == 3,
}
"""Those for which that is true in some cases alone."""

ROUNDED = {
    "add": _each(np.add),
    "div": _each(np.divide),
    "mul": _each(np.multiply),
    "sqrt": _each(np.sqrt),
    "sub": _each(np.subtract),
}
"""Operations that round as IEEE 754 says."""

OPERATIONS = EXACT | ROUNDED
