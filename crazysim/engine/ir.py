"""A program on single numbers: what one drone computes, as a graph of operations.

An engine does not see arrays. Every element of every small array is a value of its own, constants are folded, and
what is computed twice is there once. Three readers turn such a program into something that runs: XLA on lanes,
CUDA source, and symbolic expressions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

Element = Any
"""A ``Value``, or a NumPy scalar for a constant."""


class Value:
    """One number that is computed at run time."""

    __slots__ = ("args", "blocks", "dtype", "op", "params")

    def __init__(self, op: str, args: tuple[Element, ...], dtype: Any, params: tuple = (), blocks: tuple = ()):
        """Name an operation, its operands, its type, its settings and the blocks it contains."""
        self.op, self.args, self.dtype, self.params, self.blocks = op, args, np.dtype(dtype), params, blocks


class Block:
    """Operations in order, from inputs to outputs; an inner block sees the values of those around it."""

    def __init__(self, outer: Block | None = None):
        """Open an empty block inside another one."""
        self.outer = outer
        self.inputs: list[Value] = []
        self.values: list[Value] = []
        self.outputs: list[Element] = []
        self._known: dict[Any, Value] = {}

    def input(self, dtype: Any) -> Value:
        """Add an input."""
        value = Value("input", (), dtype)
        self.inputs.append(value)
        return value

    def add(
        self, op: str, args: tuple[Element, ...], dtype: Any, params: tuple = (), blocks: tuple[Block, ...] = ()
    ) -> Element:
        """Return the value of an operation: a new one, a known one, or a constant."""
        dtype = np.dtype(dtype)
        if not blocks:
            simple = simplify(op, args, dtype, params)
            if simple is not None:
                return simple
        key = (op, tuple(_key(a) for a in args), dtype, params, blocks)
        known = None if blocks else self._find(key)
        if known is not None:
            return known
        value = Value(op, args, dtype, params, blocks)
        self._known[key] = value
        self.values.append(value)
        return value

    def add_many(
        self, op: str, args: tuple[Element, ...], dtypes: Sequence[Any], params: tuple = (), blocks: tuple = ()
    ) -> list[Element]:
        """Return the results of an operation that has several."""
        operation = self.add(op, args, bool, params, blocks)
        return [self.add("item", (operation,), dtype, (("index", k),)) for k, dtype in enumerate(dtypes)]

    def barrier(self) -> None:
        """Mark a place before which everything that is used after it should be computed once."""
        if self.values and self.values[-1].op != "barrier":
            self.values.append(Value("barrier", (), bool))

    def finish(self, outputs: Sequence[Element]) -> Block:
        """Return the block, with these outputs."""
        self.outputs = list(outputs)
        return self

    def _find(self, key: Any) -> Value | None:
        block: Block | None = self
        while block is not None:
            if key in block._known:
                return block._known[key]
            block = block.outer
        return None

    def drop_unused(self) -> None:
        """Remove the operations that no output needs."""
        self._prune(set())

    def _prune(self, needed: set[int]) -> None:
        needed |= {id(x) for x in self.outputs if isinstance(x, Value)}
        kept = []
        for value in reversed(self.values):
            if id(value) in needed or value.op == "barrier":
                kept.append(value)
                needed |= {id(x) for x in value.args if isinstance(x, Value)}
                for block in value.blocks:
                    block._prune(needed)
        self.values = kept[::-1]

    def walk(self) -> Iterator[Value]:
        """Go through all operations, those of inner blocks included."""
        for value in self.values:
            yield value
            for block in value.blocks:
                yield from block.walk()


def constant(value: Any, dtype: Any) -> np.generic:
    """Return a constant element."""
    return np.dtype(dtype).type(value)


def is_constant(x: Element) -> bool:
    """Return whether an element is known before the program runs."""
    return isinstance(x, np.generic)


def _key(x: Element) -> Any:
    # NaN differs from itself, and -0.0 equals 0.0: constants are told apart by their bytes.
    return (x.dtype, x.tobytes()) if isinstance(x, np.generic) else id(x)


def simplify(op: str, args: tuple[Element, ...], dtype: np.dtype, params: tuple) -> Element | None:
    """Return what an operation comes to without computing it, or None.

    A product with a constant zero is zero, as the zeros of a diagonal inertia are meant; that a state which is
    infinite or NaN would give NaN is left to its other terms, which stay NaN.
    """
    if all(map(is_constant, args)):
        fold = FOLDS.get(op)
        if fold is not None:
            with np.errstate(all="ignore"):
                return dtype.type(fold(*args, **dict(params)))
        return None
    if op in ("add", "sub", "mul", "div") and dtype.kind == "f":
        a, b = args
        if op == "mul":
            if _equals(a, 0) or _equals(b, 0):
                return dtype.type(0)
            if _equals(a, 1):
                return b
            if _equals(b, 1):
                return a
        if op == "add" and _equals(a, 0):
            return b
        if op in ("add", "sub") and _equals(b, 0):
            return a
        if op == "div" and _equals(b, 1):
            return a
        if op == "div" and _equals(a, 0):
            return dtype.type(0)
    if op == "select_n":
        which, *cases = args
        if is_constant(which):
            return cases[int(which)]
        if all(c is cases[0] or (is_constant(c) and _key(c) == _key(cases[0])) for c in cases[1:]):
            return cases[0]
    if op == "convert_element_type" and args[0].dtype == dtype:
        return args[0]
    if op in ("and", "or") and dtype.kind == "b":
        for a, b in (args, args[::-1]):
            if is_constant(a):
                return b if bool(a) == (op == "and") else a
    return None


def _equals(x: Element, number: float) -> bool:
    return is_constant(x) and x == number


def _divide(a: Any, b: Any) -> Any:
    if np.asarray(a).dtype.kind == "f":
        return np.divide(a, b)
    return int(a) // int(b) if (a < 0) == (b < 0) else -(abs(int(a)) // abs(int(b)))  # towards zero


FOLDS: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": _divide,
    "rem": np.fmod,
    "neg": np.negative,
    "abs": np.abs,
    "sign": np.sign,
    "floor": np.floor,
    "ceil": np.ceil,
    "sqrt": np.sqrt,
    "max": np.maximum,
    "min": np.minimum,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "not": np.invert,
    "shift_left": np.left_shift,
    "is_finite": np.isfinite,
    "select_n": lambda which, *cases: cases[int(which)],
    "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high),
    "convert_element_type": lambda x: x,
}
"""Operations on constants that NumPy rounds as XLA does."""
