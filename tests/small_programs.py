"""Programs of JAX in NumPy, for the tests: many are called once, and compiling them takes longer.

Outside of ``jit``, JAX compiles each operation once more for each shape: some 2,400 programs of 10 ms to 30 ms in one
run of the tests. A program that moves, compares and selects numbers gives the same bits in NumPy, and so does one with
a single sum or product; with two, XLA may round once instead of twice. Such programs are interpreted in all tests,
others in tests whose subject is not the compiler, until they have been run for as long as compiling them takes.
"""

import functools
import math
import weakref
from importlib.metadata import version

import jax
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Literal
from jax.sharding import SingleDeviceSharding
from numpy_jax.program import CALLS, MissingError, TooLongError, called, data, is_known, is_number, prepare
from numpy_jax.table import EXACT, ROUNDED

BUDGET, BUDGET_EACH = 2500, 80
"""Operations that NumPy runs in about half the time in which XLA compiles a program: always, and more for each."""
CALL = 30
"""Operations that take as long as a call does besides its operations."""
TRANSFERS = ("host_to_device", "device_to_device", "device_to_host")
"""Kinds of transfers that JAX can watch for."""

patience = 1
"""Factor by which a test lets programs be interpreted for longer."""
active = False
"""True while a test runs whose subject is not the compiler."""


def interpret() -> None:
    """Interpret programs in this process; releases of JAX from 0.11 on compile them."""
    if not version("jax").startswith("0.10."):
        return
    from jax._src import pjit

    compiled = pjit._pjit_call_impl_python

    @functools.wraps(compiled)
    def call(*args, **params):
        jaxpr = params["jaxpr"]
        if jaxpr not in _KNOWN:
            _KNOWN[jaxpr] = Known(jaxpr)
        out = _KNOWN[jaxpr].call(args, params)
        return compiled(*args, **params) if out is None else (out, None, None, [])

    pjit._pjit_call_impl_python = call


class Known:
    """A program that was called, and for how many operations it is still interpreted."""

    def __init__(self, closed):
        """Take its jaxpr."""
        self.given, self.results = [v.aval for v in closed.jaxpr.invars], closed.out_avals
        self.possible = not closed.effects and all(map(is_known, (*self.given, *self.results)))
        self.exact = self.possible and is_exact(closed.jaxpr)
        self.program, self.budget, self.done = None, BUDGET, 0.0

    def call(self, args, params):
        """Return the results of a call; None if it must be compiled."""
        if not (self.possible and (active or self.exact)):
            return None
        place = _place(args, params)
        if place is None:
            return None
        if self.program is None:
            try:
                self.program = prepare(params["jaxpr"])
            except MissingError:
                self.possible = False
                return None
            self.budget = BUDGET + BUDGET_EACH * self.program.size
        try:
            left = patience * self.budget - self.done - CALL
            found, done = self.program.run_within(left, map(_read, args, self.given))
        except TooLongError:
            self.possible = False
            return None
        self.done += CALL + done
        return [_put(x, aval, *place) for x, aval in zip(found, self.results, strict=True)]


_KNOWN = weakref.WeakKeyDictionary()
"""Programs that were called, by their jaxprs."""


def _read(x, aval):
    """Return an operand in NumPy."""
    return np.asarray(x, aval.dtype) if is_number(aval) else data(x)


def _place(args, params):
    """Return the device of the results, and whether they are committed to it; None if the call must be compiled."""
    from jax._src.sharding_impls import UnspecifiedValue

    requested = [params[name] for name in ("in_shardings", "out_shardings", "in_layouts", "out_layouts")]
    if any(not isinstance(x, UnspecifiedValue | None) for some in requested for x in some):
        return None
    if any(params["donated_invars"]) or params["compiler_options_kvs"]:
        return None
    if jax.config.jax_debug_nans or jax.config.jax_debug_infs or _is_guarded():
        return None
    first, *_ = jax.devices()
    arrays = [x for x in args if isinstance(x, jax.Array)]
    known = {device for x in arrays for device in x.devices()} | {jax.config.jax_default_device or first}
    return (first, any(x.committed for x in arrays)) if known == {first} and first.platform == "cpu" else None


def _is_guarded():
    """Return whether a test watches for transfers between host and device: a compiled call has none."""
    names = ("jax_transfer_guard", *(f"jax_transfer_guard_{way}" for way in TRANSFERS))
    return any(getattr(jax.config, name, None) not in (None, "allow") for name in names)


def _put(x, aval, device, committed):
    """Return a result in JAX, in memory of its own."""
    from jax._src.interpreters import pxla

    if not is_number(aval):
        return jax.random.wrap_key_data(_put(x, ShapedArray(np.shape(x), x.dtype), device, committed))
    return pxla.batched_device_put(aval, SingleDeviceSharding(device), [np.array(x)], [device], committed)


def is_exact(jaxpr) -> bool:
    """Return whether NumPy gives the bits that a compiled jaxpr gives: if at most one operation rounds."""
    return _n_rounded(jaxpr) <= 1


def _n_rounded(jaxpr):
    """Return how many operations round; infinitely many if there is one whose bits differ in NumPy."""
    total = 0
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if name in CALLS:
            total += _n_rounded(called(eqn)[0])
        elif name in ROUNDED and eqn.outvars[0].aval.dtype.kind == "f":
            total += 1
        elif name not in EXACT and name not in ROUNDED:
            return math.inf
    constant = any(isinstance(x, Literal) and x.aval.dtype.kind == "f" for eqn in jaxpr.eqns for x in eqn.invars)
    return math.inf if total and constant else total  # XLA multiplies by the reciprocal, and drops a sum with zero
