"""Loops, branches, random numbers, and calls of the host."""

import ctypes
import math

import ffi
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal
from late_kernels import Late

from crazysim.engine import native
from crazysim.engine.interpret import threefry2x32
from numpy_jax.program import MissingError, TooLongError, is_number, left, prepare, shape_of


def scan(eqn):
    """Run a jaxpr for each row."""
    p = eqn.params
    body, n_consts, n_carry = prepare(p["jaxpr"]), p["num_consts"], p["num_carry"]
    order = range(p["length"])[::-1] if p["reverse"] else range(p["length"])
    rows = [v.aval for v in eqn.outvars[n_carry:]]
    rows = [(shape_of(x), x.dtype if is_number(x) else np.uint32) for x in rows]

    def fn(*args):
        if p["length"] * body.cost > left():
            raise TooLongError
        consts, carry, xs = args[:n_consts], args[n_consts : n_consts + n_carry], args[n_consts + n_carry :]
        ys = [np.empty(*row) for row in rows]
        for i in order:
            out = body.run(*consts, *carry, *[x[i] for x in xs])
            carry = out[:n_carry]
            for y, new in zip(ys, out[n_carry:], strict=True):
                y[i] = new
        return [*carry, *ys]

    return fn


def while_loop(eqn):
    """Run a jaxpr as long as another one says; where they are arrays, for the places for which it does."""
    p = eqn.params
    test, body, n, m = prepare(p["cond_jaxpr"]), prepare(p["body_jaxpr"]), p["cond_nconsts"], p["body_nconsts"]
    limits = counted(p["cond_jaxpr"].jaxpr)

    def fn(*args):
        of_test, of_body, carry = args[:n], args[n : n + m], args[n + m :]
        if limits is not None:
            count, end = ((*of_test, *carry)[k] if isinstance(k, int) else k.val for k in limits)
            if (int(end) - int(count)) * body.cost > left():
                raise TooLongError
        while (going := test.run(*of_test, *carry)[0]).any():
            new = body.run(*of_body, *carry)
            if np.ndim(going):
                spread = [going.reshape(going.shape + (1,) * (np.ndim(x) - going.ndim)) for x in carry]
                new = [np.where(k, x, y) for k, x, y in zip(spread, new, carry, strict=True)]
            carry = new
        return carry

    return fn


def counted(test):
    """Return the counter and its end, as places or literals, of a loop that ends at a number; None for others."""
    if test.constvars or [eqn.primitive.name for eqn in test.eqns] != ["lt"] or test.outvars[0].aval.shape:
        return None
    if test.eqns[0].invars[0].aval.dtype.kind not in "iu":
        return None
    return [x if isinstance(x, Literal) else test.invars.index(x) for x in test.eqns[0].invars]


def cond(eqn):
    """Run one of several jaxprs."""
    branches = [prepare(x) for x in eqn.params["branches"]]
    return lambda k, *args: branches[min(max(int(k), 0), len(branches) - 1)].run(*args)


def platform_index(eqn):
    """Return the number of the case for the host."""
    platforms = eqn.params["platforms"]
    k = next(k for k, names in enumerate(platforms) if names is None or "cpu" in names)
    return lambda: np.int32(k)


def random(eqn):
    """Make keys or draw numbers from them; a key is its two numbers."""
    name, p, first = eqn.primitive.name, eqn.params, eqn.invars[0].aval
    impl = p["impl"] if name == "random_seed" else first.dtype._impl
    if impl.name != "threefry2x32":
        raise MissingError(f"keys of {impl.name}")
    shape = np.broadcast_shapes(*(v.aval.shape for v in eqn.invars))
    one = {
        "random_bits": lambda key: impl.random_bits(key, p["bit_width"], p["shape"]),
        "random_fold_in": impl.fold_in,
        "random_seed": impl.seed,
        "random_split": lambda key: impl.split(key, p["shape"]),
    }[name]
    for _ in shape:
        one = jax.vmap(one)
    # A key and a number may be one for several of the other.
    types = [
        jax.ShapeDtypeStruct(shape, v.aval.dtype) if is_number(v.aval) else jax.ShapeDtypeStruct((*shape, 2), np.uint32)
        for v in eqn.invars
    ]
    program = prepare(jax.make_jaxpr(one)(*types))
    return lambda *xs: program.run(*(np.broadcast_to(x, t.shape) for x, t in zip(xs, types, strict=True)))[0]


def threefry(eqn):
    """Return the two numbers of 32 bits that Threefry makes."""
    return lambda *xs: list(threefry2x32(*xs))


def iota_2x32(eqn):
    """Return the high and low words of the numbers of a shape."""
    shape = eqn.params["shape"]
    n = np.arange(math.prod(shape), dtype=np.uint64).reshape(shape)
    words = [(n >> np.uint64(32)).astype(np.uint32), n.astype(np.uint32)]
    return lambda: list(words)


def callback(eqn):
    """Call a function of the host."""

    def fn(*xs):
        with np.errstate(all="warn"):
            found = eqn.params["callback"](*map(jnp.asarray, xs))
        return [np.asarray(y, v.aval.dtype) for y, v in zip(found, eqn.outvars, strict=True)]

    return fn


def kernel(eqn):
    """Call a kernel of the fused engine as XLA does."""
    library, aliases = native._LOADED.get(eqn.params["target_name"]), dict(eqn.params["input_output_aliases"])
    if library is None:
        raise MissingError("ffi_call of something else")
    types = [v.aval for v in eqn.outvars]

    def fn(*xs):
        out = [np.empty(x.shape, x.dtype) for x in types]
        for k, result in aliases.items():
            out[result][...] = xs[k]
        given = [out[aliases[k]] if k in aliases else np.ascontiguousarray(x) for k, x in enumerate(xs)]
        if isinstance(library, Late):
            library.call(given, out)
        else:
            library.crazysim_advance(ctypes.byref(ffi.frame(given, out)))
        return out

    return fn
