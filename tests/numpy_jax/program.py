"""A jaxpr in NumPy: prepared once, and then run without a compiler."""

import math
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jax._src import core
from jax.extend.core import Literal


class MissingError(Exception):
    """An operation has no NumPy function."""


class TooLongError(Exception):
    """More operations would be run than may be."""


OPERATIONS: dict[str, Callable[[Any], Callable[..., Any]]] = {}
"""Functions from an equation to a function of its operands, by the name of the operation; ``table`` fills it."""
CALLS = {
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_vmap_call": "call",
    "jit": "jaxpr",
    "remat2": "jaxpr",
}
"""Operations that call a jaxpr and do nothing else, and the parameter that has it."""
OF_KEYS = ("broadcast_in_dim", "concatenate", "cond", "scan", "select_n", "slice", "squeeze", "stack", "while") + tuple(
    f"random_{name}" for name in ("bits", "fold_in", "seed", "split", "unwrap", "wrap")
)
"""Operations that take random keys as they are here: their two numbers, along a last axis."""
_budget = threading.local()
"""Operations that this thread may still run, as ``left``."""
ELEMENTS = 500
"""Numbers that take as long as an operation does besides them."""


class Call(NamedTuple):
    """An operation whose operands and results have places."""

    fn: Callable[..., Any]
    args: list[int]
    result: int | list[int]
    dtype: np.dtype | None
    """Type of its only result."""


class Program:
    """A jaxpr, with those that it calls written out, whose values have places in a list."""

    def __init__(self, jaxpr, consts=()):
        """Prepare a jaxpr with its constants; raise ``MissingError`` if there is an operation without a function."""
        self.values, self.calls = [], []
        self.cost, self.size = 0.0, 0  # operations that a run takes without loops, and as they are written
        places = {}
        for v, x in zip(jaxpr.constvars, consts, strict=True):
            places[v] = self.place(data(x))
        self.inputs = [places.setdefault(v, self.place()) for v in jaxpr.invars]
        self.outputs = self.add(jaxpr, places)

    def place(self, value=None):
        """Return the place of a new value."""
        self.values.append(value)
        return len(self.values) - 1

    def add(self, jaxpr, places):
        """Add the operations of a jaxpr; return the places of its results."""

        def read(x):
            return self.place(np.asarray(x.val, x.aval.dtype)) if isinstance(x, Literal) else places[x]

        for eqn in jaxpr.eqns:
            name, args = eqn.primitive.name, [read(x) for x in eqn.invars]
            if name in CALLS:
                inner, consts = called(eqn)
                consts = [self.place(data(x)) for x in consts]
                known = dict(zip((*inner.constvars, *inner.invars), (*consts, *args), strict=True))
                places.update(zip(eqn.outvars, self.add(inner, known), strict=True))
                continue
            types = [v.aval for v in (*eqn.invars, *eqn.outvars)]
            if name not in OPERATIONS or not all(map(is_number if name not in OF_KEYS else is_known, types)):
                raise MissingError(name)
            fn = OPERATIONS[name](eqn)
            results = [self.place() for _ in eqn.outvars]
            places.update(zip(eqn.outvars, results, strict=True))
            one = not eqn.primitive.multiple_results
            dtype = eqn.outvars[0].aval.dtype if one and is_number(eqn.outvars[0].aval) else None
            self.calls.append(Call(fn, args, results[0] if one else results, dtype))
            self.size += n_operations(eqn)
            self.cost += 1 + sum(math.prod(v.aval.shape) for v in eqn.outvars) / ELEMENTS
        return [read(x) for x in jaxpr.outvars]

    def run_within(self, limit, args) -> tuple[list[Any], float]:
        """Return the results for some operands, and how many operations that took; raise beyond a limit."""
        before, _budget.left = left(), limit
        try:
            with np.errstate(all="ignore"):
                return self.run(*args), limit - left()
        finally:
            _budget.left = before  # a function of the host may run programs too

    def run(self, *args) -> list[Any]:
        """Return the results for some operands."""
        _budget.left = left() - self.cost
        if left() < 0:
            raise TooLongError
        values = self.values.copy()
        for place, x in zip(self.inputs, args, strict=True):
            values[place] = x
        for fn, places, result, dtype in self.calls:
            x = fn(*[values[k] for k in places])
            if isinstance(result, list):
                for place, y in zip(result, x, strict=True):
                    values[place] = y
            else:
                values[result] = x if dtype is None or x.dtype == dtype else np.asarray(x).astype(dtype)
        return [values[k] for k in self.outputs]


def called(eqn):
    """Return the jaxpr that an operation of ``CALLS`` calls, and its constants."""
    inner = eqn.params[CALLS[eqn.primitive.name]]
    return getattr(inner, "jaxpr", inner), getattr(inner, "consts", ())


def n_operations(eqn) -> int:
    """Return the number of operations of an equation and of the jaxprs in it, as they are written."""
    return 1 + sum(n_operations(inner) for jaxpr in core.jaxprs_in_params(eqn.params) for inner in jaxpr.eqns)


def left() -> float:
    """Return how many operations this thread may still run."""
    return getattr(_budget, "left", math.inf)


def prepare(closed) -> Program:
    """Return a closed jaxpr as a program."""
    return Program(closed.jaxpr, closed.consts)


def evaluate(closed, args) -> list[Any]:
    """Return the results of a closed jaxpr."""
    return prepare(closed).run_within(math.inf, args)[0]


def is_number(aval):
    """Return whether values of a type are numbers of NumPy: bools, integers, or floats of IEEE 754."""
    dtype = getattr(aval, "dtype", None)
    return isinstance(dtype, np.dtype) and dtype.kind in "biuf"


def is_known(aval):
    """Return whether values of a type are such numbers or random keys."""
    return is_number(aval) or jax.dtypes.issubdtype(getattr(aval, "dtype", np.complex64), jax.dtypes.prng_key)


def shape_of(aval):
    """Return the shape of values of a type here."""
    return aval.shape if is_number(aval) else (*aval.shape, 2)


def data(x):
    """Return an array in NumPy; of keys their numbers."""
    is_key = jax.dtypes.issubdtype(getattr(x, "dtype", np.float32), jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(x) if is_key else x)
