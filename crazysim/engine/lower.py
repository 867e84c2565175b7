"""From a function written for one drone to a program on single numbers.

The function is traced by JAX, and its jaxpr read operation by operation. An array is a NumPy object array of
elements (``ir``). What a primitive means for elements is a rule; there are four kinds, and most primitives need no
rule of their own:

- element-wise: the same operation for every element;
- movement: nothing is computed, so the primitive is run once on the numbers of the elements;
- reduction: unrolled;
- structure: calls are followed, branches become selections, loops stay loops.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend import core

from crazysim.engine.ir import Block, Element, constant

Elements = np.ndarray
"""An array of elements: of type object, whatever the elements are."""

LOGIC = {
    "lt": ("and", 0),
    "gt": ("and", 1),
    "le": ("or", 0),
    "ge": ("or", 1),
    "max": ("or", None),
    "min": ("and", None),
}
"""Order of truth values as logic, and which operand is negated for it."""

Rule = Callable[["Lowering", Any, list[Elements]], Sequence[Elements]]
RULES: dict[str, Rule] = {}

MAX_UNROLL = 64
"""Longest scan with inputs or outputs per iteration, and largest range of a run-time index, that is unrolled."""


class UnsupportedError(Exception):
    """A primitive, or a use of one, that cannot be read; the message names it."""


def rule(*names: str) -> Callable[[Rule], Rule]:
    """Register a function as the rule of primitives."""

    def register(fn: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, fn))
        return fn

    return register


class Lowering:
    """Lowers jaxprs into a block of scalar operations."""

    def __init__(self, builder: Block):
        """Add operations to a block."""
        self.builder = builder

    def lower(self, jaxpr: core.ClosedJaxpr, args: Sequence[Elements]) -> list[Elements]:
        """Return the results of a jaxpr for arrays of elements.

        Raises:
            UnsupportedError: If it has a primitive without a rule.
        """
        env: dict[Any, Elements] = {}

        def value(v: Any) -> Elements:
            return constants(v.val, v.aval.dtype) if isinstance(v, core.Literal) else env[v]

        inner = jaxpr.jaxpr
        env.update(zip(inner.constvars, (constants(x, x.dtype) for x in jaxpr.consts), strict=True))
        env.update(zip(inner.invars, args, strict=True))
        for eqn in inner.eqns:
            outs = self.lower_eqn(eqn, [value(v) for v in eqn.invars])
            env.update(zip(eqn.outvars, outs, strict=True))
        return [value(v) for v in inner.outvars]

    def lower_eqn(self, eqn: Any, args: list[Elements]) -> Sequence[Elements]:
        """Return the results of one equation of a jaxpr."""
        name = eqn.primitive.name
        if name not in RULES:
            raise UnsupportedError(f"primitive {name!r} has no rule")
        return RULES[name](self, eqn, args)

    def elementwise(self, op: str, args: Sequence[Elements], dtype: Any, params: tuple = ()) -> Elements:
        """Return an operation on every element; scalars stand for arrays of any shape."""
        if op in LOGIC and args[0].size and args[0].reshape(-1)[0].dtype == bool:
            op, negated = LOGIC[op]
            args = [self.elementwise("not", [x], bool) if k == negated else x for k, x in enumerate(args)]
        shape = np.broadcast_shapes(*(x.shape for x in args))
        rows = [np.broadcast_to(x, shape).reshape(-1) for x in args]
        if rows[-1].size and isinstance(rows[-1][0], tuple):  # keys: both halves alike
            pairs = [[self.scalar(op, c[0], *(k[i] for k in c[1:])) for i in (0, 1)] for c in zip(*rows, strict=True)]
            return as_elements([(a, b) for a, b in pairs], shape)
        return as_elements([self.builder.add(op, column, dtype, params) for column in zip(*rows, strict=True)], shape)

    def scalar(self, op: str, *args: Element, dtype: Any = None) -> Element:
        """Return an operation on single elements; of the last operand's type, unless another is given."""
        return self.builder.add(op, args, args[-1].dtype if dtype is None else dtype)

    def inner(self) -> Lowering:
        """Return a lowering into a new block inside this one."""
        return Lowering(Block(self.builder))

    def finish(self, outputs: Sequence[Elements]) -> Block:
        """Return the block, with these outputs."""
        return self.builder.finish(scalars(*outputs))


def as_elements(items: Sequence[Element], shape: tuple[int, ...]) -> Elements:
    """Return a flat sequence of elements as an array. NumPy must not convert them."""
    out = np.empty(len(items), dtype=object)
    for i, item in enumerate(items):
        out[i] = item
    return out.reshape(shape)


def scalars(*arrays: Elements) -> list[Element]:
    """Return the single elements of arrays, one after the other; a random key is two 32-bit integers."""
    items = [x for array in arrays for x in np.asarray(array, object).reshape(-1)]
    return [half for x in items for half in (x if isinstance(x, tuple) else (x,))]


def constants(x: Any, dtype: Any) -> Elements:
    """Return an array of numbers, or of random keys, as elements."""
    if jax.dtypes.issubdtype(dtype, jax.dtypes.prng_key):
        halves = np.asarray(jax.random.key_data(x)).reshape(-1, 2)
        return as_elements([(constant(a, np.uint32), constant(b, np.uint32)) for a, b in halves], np.shape(x))
    array = np.asarray(x)
    return as_elements([constant(item, dtype) for item in array.reshape(-1)], array.shape)
