"""Faster tracing, which takes two fifths of the tests' time: operators of traced arrays call ``lax`` directly.

``x * y`` calls ``jnp.multiply``, a jitted function that JAX looks up, binds and inlines. What is traced is one ``mul``,
in two to four times as long as ``lax.mul`` takes. Operators of floating-point arrays and indices of integers and slices
call ``lax`` here and trace to the same equations; for all else they call JAX's own methods.
"""

from importlib.metadata import version

import numpy as np
from jax import lax
from jax.core import ShapedArray

OPERATORS = {
    "mul": lax.mul, "add": lax.add, "sub": lax.sub, "truediv": lax.div,
    "lt": lax.lt, "le": lax.le, "gt": lax.gt, "ge": lax.ge,
}  # fmt: skip
"""Functions of ``lax`` by the name of the operator."""
REFLECTED = ("mul", "add", "sub", "truediv")
"""Operators that have a second method, for an array on the right."""
FLOATS = (np.dtype(np.float32), np.dtype(np.float64))
"""Types of arrays whose operators call ``lax``."""
NUMBERS = (float, int)
"""Types of numbers that are converted to the type of the array."""
LARGEST = 2**24
"""Bound of their magnitude: below it no number overflows float32, and integers are exact in it."""

enabled = True
"""True where operators call ``lax``; tests set it to False to compare."""


def install():
    """Replace the operators of traced arrays in this process, on the release of JAX that most of the tests run on."""
    if not version("jax").startswith("0.10."):
        return
    from jax._src import source_info_util, traceback_util
    from jax._src.core import Tracer

    for name, function in OPERATORS.items():
        for prefix in ("__", "__r") if name in REFLECTED else ("__",):
            method = f"{prefix}{name}__"
            setattr(Tracer, method, make_operator(function, getattr(Tracer, method), prefix == "__r"))
    Tracer.__getitem__ = make_getitem(Tracer.__getitem__)
    # Messages of JAX name the line that has the operator, not this file.
    source_info_util.register_exclusion(__file__)
    traceback_util.register_exclusion(__file__)


def make_operator(function, original, reflected):
    """Return the method of an operator: a function of ``lax`` where the arguments allow it, else JAX's own method."""

    def method(self, other):
        value = operand(self, other) if enabled and is_traced_float(self) else None
        if value is None:
            return original(self, other)
        return function(value, self) if reflected else function(self, value)

    return method


def make_getitem(original):
    """Return the method for ``x[index]``: a slice of ``lax`` where the index allows it, else JAX's own method."""

    def method(self, index):
        part = basic_index(self.aval.shape, index) if enabled and is_traced_float(self) else None
        if part is None:
            return original(self, index)
        starts, ends, dropped = part
        whole = not any(starts) and tuple(ends) == self.aval.shape
        found = self if whole else lax.slice(self, starts, ends)
        return lax.squeeze(found, dropped) if dropped else found

    return method


def is_traced_float(x):
    """Return whether this is a float array, not weakly typed, that ``jit`` traces, or ``vmap`` within ``jit``.

    Under differentiation the jitted functions are quicker: JAX keeps their derivatives.
    """
    base = x
    while type(base).__name__ == "BatchTracer":
        base = base.val
    if type(base).__name__ != "DynamicJaxprTracer":
        return False
    aval = x.aval
    return type(aval) is ShapedArray and aval.dtype in FLOATS and not aval.weak_type


def operand(x, other):
    """Return the other operand as ``lax`` takes it together with ``x``; None if it does not, or converts it."""
    if type(other) in NUMBERS:
        return x.aval.dtype.type(other) if abs(other) < LARGEST else None
    if not is_traced_float(other):
        return None
    a, b = x.aval, other.aval
    return other if a.dtype == b.dtype and (len(a.shape) == len(b.shape) or not a.shape or not b.shape) else None


def basic_index(shape, index):
    """Return where the part that an index takes begins and ends on each axis, and the axes that it drops.

    None for an empty part, steps, new axes, arrays, booleans, NumPy's integers, what is out of bounds, and for an array
    whose lengths are symbols.
    """
    index = index if type(index) is tuple else (index,)
    n_rest = len(shape) - sum(key is not Ellipsis for key in index)
    if n_rest < 0 or sum(key is Ellipsis for key in index) > 1 or any(type(length) is not int for length in shape):
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
