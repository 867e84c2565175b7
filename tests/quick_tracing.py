"""Operators of traced arrays without the jitted functions of ``jax.numpy``: two fifths of the tests' time is tracing.

``x * y`` calls ``jnp.multiply``, a function under ``jit`` that JAX looks up, binds and inlines: the one equation of
``lax.mul`` in two to four times the time. Operators of floating-point arrays and basic indexing go straight to ``lax``
here, where they trace to the same equations; everything else goes the way it always goes.
"""

from importlib.metadata import version

import numpy as np
from jax import lax
from jax.core import ShapedArray

OPERATORS = {
    "mul": lax.mul, "add": lax.add, "sub": lax.sub, "truediv": lax.div,
    "lt": lax.lt, "le": lax.le, "gt": lax.gt, "ge": lax.ge,
}  # fmt: skip
"""Operators by name, and what they trace to."""
REFLECTED = ("mul", "add", "sub", "truediv")
"""Those that have a second method, for an array on the right."""
EXACT = 2**24
"""Numbers below have no overflow in either type, and whole ones are exact."""

quick = True
"""False where operators go the way they always go."""


def install():
    """Replace the operators of traced arrays in this process; releases of JAX from 0.11 on keep theirs."""
    if not version("jax").startswith("0.10."):
        return
    from jax._src.core import Tracer

    for name, operator in OPERATORS.items():
        for prefix in ("__", "__r") if name in REFLECTED else ("__",):
            method = f"{prefix}{name}__"
            setattr(Tracer, method, binary(operator, getattr(Tracer, method), prefix == "__r"))
    Tracer.__getitem__ = item(Tracer.__getitem__)


def binary(operator, slow, reflected):
    """Return the method of an operator, which calls the one that was there before for arguments of other kinds."""

    def method(self, other):
        if quick and type(other) in NUMBERS and abs(other) < EXACT and is_plain(self):
            number = self.aval.dtype.type(other)
            return operator(number, self) if reflected else operator(self, number)
        if quick and not reflected and is_plain(self) and is_plain(other) and match(self.aval, other.aval):
            return operator(self, other)
        return slow(self, other)

    return method


NUMBERS = (float, int)
"""Types of numbers that take the type of the array."""
FLOATS = (np.dtype(np.float32), np.dtype(np.float64))
"""Types of arrays whose operators are quick."""


def is_plain(x):
    """Return whether an array is traced by ``jit`` or ``vmap``, and of floating-point numbers of a declared type.

    Under differentiation the jitted functions are quicker: JAX keeps what it derived of them.
    """
    kind = type(x).__name__
    if kind == "BatchTracer":
        kind = type(x.val).__name__
        if kind not in ("BatchTracer", "DynamicJaxprTracer"):
            return False
    elif kind != "DynamicJaxprTracer":
        return False
    aval = x.aval
    return type(aval) is ShapedArray and aval.dtype in FLOATS and not aval.weak_type


def match(a, b):
    """Return whether ``lax`` takes arrays of these types together."""
    return a.dtype == b.dtype and (len(a.shape) == len(b.shape) or not a.shape or not b.shape)


def item(slow):
    """Return the method for ``x[index]``, which calls the one that was there before for other indices."""

    def method(self, index):
        bounds = basic(self.aval.shape, index) if quick and is_plain(self) else None
        if bounds is None:
            return slow(self, index)
        starts, ends, dropped = bounds
        whole = not any(starts) and tuple(ends) == self.aval.shape
        part = self if whole else lax.slice(self, starts, ends)
        return lax.squeeze(part, dropped) if dropped else part

    return method


def basic(shape, index):
    """Return where the part of an index begins and ends on each axis, and the axes that it drops.

    None for a part that is empty, for a step, a new axis, an array or an index out of bounds.
    """
    index = index if type(index) is tuple else (index,)
    n_rest = len(shape) - sum(key is not Ellipsis for key in index)
    if n_rest < 0 or sum(key is Ellipsis for key in index) > 1:
        return None
    starts, ends, dropped = [], [], []
    for key in index if any(key is Ellipsis for key in index) else (*index, Ellipsis):
        axis = len(starts)
        if key is Ellipsis:
            starts += [0] * n_rest
            ends += shape[axis : axis + n_rest]
        elif type(key) is int and -shape[axis] <= key < shape[axis]:
            starts.append(key % shape[axis])
            ends.append(starts[-1] + 1)
            dropped.append(axis)
        elif type(key) is slice and key.step is None and {type(key.start), type(key.stop)} <= {int, type(None)}:
            start, end, _ = key.indices(shape[axis])
            starts.append(start)
            ends.append(end)
        else:
            return None
    return (starts, ends, dropped) if all(start < end for start, end in zip(starts, ends, strict=True)) else None
