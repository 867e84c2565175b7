"""Lowering of a jaxpr to a block of scalar operations.

JAX traces a function that is written for one drone, and its jaxpr is lowered equation by equation. An array becomes a
NumPy object array of elements (``ir``). A rule defines a primitive on elements. There are four kinds of rules, and most
primitives share a rule with others:

- element-wise: the same operation for every element;
- movement: nothing is computed, so the primitive is run once, on the elements themselves or on their indices;
- reduction: the operations are unrolled;
- structure: calls are inlined, branches become selections, and loops remain loops.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from crazysim.engine import jaxcompat
from crazysim.engine.errors import UnsupportedError
from crazysim.engine.ir import ops
from crazysim.engine.ir.algebra import known_zero
from crazysim.engine.ir.blocks import Block, Builder, Element, Value, constant
from crazysim.engine.jaxcompat import ClosedJaxpr, Literal, is_key

ElementArray = np.ndarray
"""An array of elements, of type object. A random key is a pair of elements."""

Rule = Callable[["Lowering", Any, list[ElementArray]], Sequence[ElementArray]]
"""Function that takes the lowering, an equation and its operands, and returns the results of the equation."""
RULES: dict[str, Rule] = {}
"""Rules by the name of the primitive."""

MAX_UNROLL = 64
"""Maximum number of iterations or elements that are unrolled. This is the maximum length of a scan with inputs or
outputs per iteration and of a sort, and the maximum range of a run-time index."""


def rule(*names: str) -> Callable[[Rule], Rule]:
    """Register a function as the rule of primitives."""

    def register(fn: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, fn))
        return fn

    return register


class TableEntry(NamedTuple):
    """Index of a number in a table: the sum of a computed base and a constant."""

    table: Value
    """The table."""
    base: Element
    """Computed part of the index; the constant 0 if there is none."""
    offset: int
    """Constant part."""
    aligned: bool = True
    """Whether the base is a multiple of four."""


class Lowering:
    """Lowering of jaxprs into a block of scalar operations."""

    def __init__(
        self, builder: Builder | None = None, entries: dict[Value, TableEntry] | None = None, n_members: int = 0
    ):
        self.builder = Builder() if builder is None else builder
        self.entries = {} if entries is None else entries
        self.n_members = n_members
        self.shared: set[Value] = set()
        """Inputs that are the same for all drones."""

    def lower(self, jaxpr: ClosedJaxpr, args: Sequence[ElementArray]) -> list[ElementArray]:
        """Return the results of a jaxpr for arrays of elements.

        Raises:
            UnsupportedError: If a primitive has no rule, or its rule does not support the parameters.
        """
        env: dict[Any, ElementArray] = {}

        def read(v: Any) -> ElementArray:
            return constants(v.val, v.aval.dtype) if isinstance(v, Literal) else env[v]

        inner = jaxpr.jaxpr
        env.update(zip(inner.constvars, (constants(x, x.dtype) for x in jaxpr.consts), strict=True))
        env.update(zip(inner.invars, args, strict=True))
        for eqn in inner.eqns:
            outs = self.lower_eqn(eqn, [read(v) for v in eqn.invars])
            env.update(zip(eqn.outvars, outs, strict=True))
        return [read(v) for v in inner.outvars]

    def lower_eqn(self, eqn: Any, args: list[ElementArray]) -> Sequence[ElementArray]:
        """Return the results of one equation of a jaxpr."""
        name = eqn.primitive.name
        if name not in RULES:
            raise UnsupportedError(f"primitive {name!r} has no rule", name)
        try:
            with jaxcompat.read_equation(eqn) as equation:
                return RULES[name](self, equation, args)
        except UnsupportedError as error:
            raise error.with_location(name) from None

    def elementwise(self, op: str, args: Sequence[ElementArray], dtype: Any, params: tuple = ()) -> ElementArray:
        """Return the results of an operation on every element; operands are broadcast."""
        shapes = {x.shape for x in args}
        shape = args[0].shape if len(shapes) == 1 else np.broadcast_shapes(*shapes)
        flat_args = [(x if x.shape == shape else np.broadcast_to(x, shape)).reshape(-1) for x in args]
        if not flat_args[-1].size:
            return np.empty(shape, object)
        first_operands = [x[0] for x in flat_args]
        if isinstance(first_operands[-1], tuple):  # a selection of random keys selects both halves
            columns = list(zip(*flat_args, strict=True))
            halves = [[self.scalar(op, mask, *(key[i] for key in keys)) for i in (0, 1)] for mask, *keys in columns]
            return as_elements([(a, b) for a, b in halves], shape)
        dtypes = [x.dtype for x in first_operands]
        if op in ops.BOOLEAN_FORM and dtypes[0].kind == "b":
            op, negated = ops.BOOLEAN_FORM[op]
            args = [self.elementwise("not", [x], bool) if k == negated else x for k, x in enumerate(args)]
            return self.elementwise(op, args, bool)
        error = ops.unsupported_error(op, dtypes, dtype)
        if error is not None:
            raise error
        columns = zip(*flat_args, strict=True)
        return as_elements([self.builder.add(op, column, dtype, params) for column in columns], shape)

    def scalar(self, op: str, *args: Element, dtype: Any = None) -> Element:
        """Return the result of an operation on single elements, by default of the type of the last operand."""
        return self.builder.add(op, args, args[-1].dtype if dtype is None else dtype)

    def make_inner(self) -> Lowering:
        return Lowering(Builder(self.builder), self.entries, self.n_members)

    def lookup(self, table: Value, base: Element, offset: int, aligned: bool) -> Element:
        """Return the entry of a table at ``base + offset``. The base is a multiple of four if ``aligned`` is True."""
        number = self.builder.add("lookup", (table, base), table.dtype, (("offset", offset), ("aligned", aligned)))
        self.entries[number] = TableEntry(table, base, offset, aligned)
        return number

    def finish(self, outputs: Sequence[ElementArray]) -> Block:
        return self.builder.finish(scalars(*outputs))


class TableRows:
    """A table in memory with any number of rows, from which a function reads whole rows (``table_row``)."""

    def __init__(self, builder: Builder, aval: Any):
        self._size = int(aval.shape[1])
        self._table = builder.input(aval.dtype, self._size)

    def row(self, ctx: Lowering, index: Element, sizes: Sequence[int]) -> ElementArray:
        """Return the row at an index, which must be in range. (1, row_size)"""
        if tuple(sizes) != (1, self._size):
            raise UnsupportedError(f"a part of shape {tuple(sizes)} of a table; only whole rows are read")
        base = ctx.scalar("mul", index, constant(self._size, np.int32))
        numbers = [ctx.lookup(self._table, base, k, self._size % 4 == 0) for k in range(self._size)]
        return as_elements(numbers, (1, self._size))


def as_elements(items: Sequence[Element], shape: tuple[int, ...]) -> ElementArray:
    """Return a flat sequence of elements as an array. NumPy must not convert them."""
    out = np.empty(len(items), dtype=object)
    for i, item in enumerate(items):
        out[i] = item
    return out.reshape(shape)


def scalars(*arrays: ElementArray) -> list[Element]:
    """Return the single elements of arrays, one after the other; a random key is two 32-bit integers."""
    items = [x for array in arrays for x in np.asarray(array, object).reshape(-1)]
    return [half for x in items for half in (x if isinstance(x, tuple) else (x,))]


def constants(x: Any, dtype: Any) -> ElementArray:
    """Return an array of numbers, or of random keys, as elements."""
    if jax.dtypes.issubdtype(dtype, jax.dtypes.prng_key):
        halves = np.asarray(jax.random.key_data(x)).reshape(-1, 2)
        return as_elements([(constant(a, np.uint32), constant(b, np.uint32)) for a, b in halves], np.shape(x))
    array = np.asarray(x)
    return as_elements([constant(item, dtype) for item in array.reshape(-1)], array.shape)


def inputs(builder: Builder, aval: Any, zeros: frozenset[int] = frozenset()) -> ElementArray:
    """Add inputs for an array to a block, and return them as an array of elements.

    Args:
        aval: Shape and type of the array.
        zeros: Flat indices of elements that are known to be zero; they become constants instead of inputs.
    """
    size = int(np.prod(aval.shape, dtype=int))
    if is_key(aval):
        return as_elements([(builder.input(np.uint32), builder.input(np.uint32)) for _ in range(size)], aval.shape)
    if aval.dtype not in ops.DTYPES:
        raise UnsupportedError(f"numbers of type {aval.dtype.name}")
    zero = known_zero(aval.dtype)
    items = [zero if k in zeros and zero is not None else builder.input(aval.dtype) for k in range(size)]
    return as_elements(items, aval.shape)


def lower_function(fn: Callable[..., Any], *avals: Any) -> Block:
    """Return the block of a function of small arrays.

    Args:
        fn: Function from arrays to any tree of arrays.
        avals: Shapes and types of the arguments.

    Raises:
        UnsupportedError: If a primitive has no rule, or its rule does not support the parameters.
    """
    lowering = Lowering()
    args = [inputs(lowering.builder, x) for x in jax.tree.leaves(avals)]
    return lowering.finish(lowering.lower(jax.make_jaxpr(fn)(*avals), args))
