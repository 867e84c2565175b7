"""A reader of programs (``ir``) that writes them down as source, for CUDA and for the host's C++ compiler alike.

A value is a variable that is assigned once, an operation a call of an inline function. What the functions and types
are, a preamble of each target says (``targets/``); what is written here is the same for both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from crazysim.engine.ir import Block, Element, Value, is_constant
from crazysim.engine.lower import UnsupportedError

TYPES = {"float32": "f32", "float64": "f64", "int32": "i32", "uint32": "u32", "bool": "b1"}

OPERATIONS = set(
    "abs acos acosh add and asin asinh atan atan2 atanh cbrt ceil clamp cos cosh div eq erf erfc erf_inv exp exp2 "
    "expm1 floor ge gt is_finite le log log1p logistic lt max min mul ne neg not or pow rem rsqrt select_n "
    "shift_left shift_right_arithmetic shift_right_logical sign sin sinh sqrt sub tan tanh xor".split()
)
"""Operations that both preambles have."""

OPERATORS = {"add": "+", "sub": "-", "mul": "*"}
"""Operations that the language has, for single numbers and for vectors: quicker to compile than calls."""

INDENT = "  "


class Writer:
    """Writes blocks as lines of source."""

    def __init__(self) -> None:
        """Begin with nothing written."""
        self.lines: list[str] = []
        self.names: dict[int, str] = {}
        self.pairs: dict[str, str] = {}
        self._count = 0

    def new(self, prefix: str = "v") -> str:
        """Return a name that is not in use."""
        self._count += 1
        return f"{prefix}{self._count}"

    def line(self, text: str, depth: int) -> None:
        """Write a line."""
        self.lines.append(INDENT * depth + text)

    def block(self, block: Block, inputs: Sequence[str], depth: int) -> list[str]:
        """Write a block's operations, and return the names of its outputs.

        Raises:
            UnsupportedError: If there is no source for an operation or a type.
        """
        self.names.update(zip(map(id, block.inputs), inputs, strict=True))
        outside = dict(self.pairs)  # what is computed inside a block is not there outside
        for value in block.values:
            self._value(value, depth)
        self.pairs = outside
        return [self.element(x) for x in block.outputs]

    def element(self, x: Element) -> str:
        """Return an element as an expression."""
        return self.names[id(x)] if isinstance(x, Value) else literal(x)

    def _value(self, value: Value, depth: int) -> None:
        args = [self.element(a) for a in value.args]
        match value.op:
            case "barrier":
                return
            case "item":
                self.names[id(value)] = f"{args[0]}_{dict(value.params)['index']}"
                return
            case "when":
                self._when(value, args, depth)
                return
            case "loop":
                self._loop(value, args, depth)
                return
            case "while":
                self._while(value, args, depth)
                return
            case "threefry2x32":
                name = self.names[id(value)] = self.new()
                self.line(f"auto {name}_0 = u32_lanes({args[2]}), {name}_1 = u32_lanes({args[3]});", depth)
                self.line(f"threefry2x32({args[0]}, {args[1]}, {name}_0, {name}_1);", depth)
                return
            case "sin" | "cos":  # most of the work for one of the two is that for the other
                if args[0] not in self.pairs:
                    pair = self.pairs[args[0]] = self.new()
                    kind = "auto" if isinstance(value.args[0], Value) else type_name(value.dtype)
                    self.line(f"{kind} {pair}_0 = {args[0]}, {pair}_1 = {args[0]};", depth)
                    self.line(f"sin_cos({args[0]}, {pair}_0, {pair}_1);", depth)
                self.names[id(value)] = f"{self.pairs[args[0]]}_{'sin cos'.split().index(value.op)}"
                return
            case "custom_jvp":  # the derivative is not asked for here
                outs = self.block(value.blocks[0], args, depth)
                name = self.names[id(value)] = self.new()
                for k, out in enumerate(outs):
                    self.line(f"const auto {name}_{k} = {out};", depth)
                return
        self.names[id(value)] = name = self.new()
        self.line(f"const auto {name} = {self._expression(value, args)};", depth)

    def _expression(self, value: Value, args: list[str]) -> str:
        kind = type_name(value.dtype)
        if value.op == "convert_element_type":
            return f"to_{kind}({args[0]})"
        if value.op == "bitcast_convert_type":
            return f"bits_{kind}({args[0]})"
        if value.op == "integer_pow":
            return f"integer_pow({args[0]}, {dict(value.params)['y']})"
        if value.op == "round":
            even = int(dict(value.params)["rounding_method"]) == 1
            return f"{'round_even_' if even else 'round_away_'}({args[0]})"
        limit = _limit(value)
        if limit is not None:
            return f"{limit}({args[1]}, {args[2]})"
        if value.op in OPERATORS and kind != "b1":
            return f"{args[0]} {OPERATORS[value.op]} {args[1]}"
        if value.op == "div" and kind in ("f32", "f64"):
            return f"{args[0]} / {args[1]}"
        if value.op not in OPERATIONS:
            raise UnsupportedError(f"operation {value.op!r} has no source")
        return f"{value.op}_({', '.join(args)})"

    def _when(self, value: Value, args: list[str], depth: int) -> None:
        mask, *old = args
        name = self._carry(value.blocks[0].outputs, old, depth)
        self.names[id(value)] = name
        self.line(f"if (any({mask})) {{", depth)
        for k, out in enumerate(self.block(value.blocks[0], [], depth + 1)):
            self.line(f"{name}_{k} = select_n_({mask}, {name}_{k}, {out});", depth + 1)
        self.line("}", depth)

    def _loop(self, value: Value, args: list[str], depth: int) -> None:
        (body,) = value.blocks
        name = self._carry(body.outputs, args, depth)
        self.names[id(value)] = name
        turn = self.new("n")
        self.line(f"for (int {turn} = 0; {turn} < {dict(value.params)['length']}; ++{turn}) {{", depth)
        outs = self.block(body, [f"{name}_{k}" for k in range(len(args))], depth + 1)
        self._assign(name, outs, None, depth + 1)
        self.line("}", depth)

    def _while(self, value: Value, args: list[str], depth: int) -> None:
        test, body = value.blocks
        name = self._carry(body.outputs, args, depth)
        self.names[id(value)] = name
        carry = [f"{name}_{k}" for k in range(len(args))]
        self.line("for (;;) {", depth)
        (goes_on,) = self.block(test, carry, depth + 1)
        self.line(f"if (!any({goes_on})) break;", depth + 1)
        self._assign(name, self.block(body, carry, depth + 1), goes_on, depth + 1)
        self.line("}", depth)

    def _carry(self, like: Sequence[Element], start: Sequence[str], depth: int) -> str:
        name = self.new()
        for k, (x, value) in enumerate(zip(like, start, strict=True)):
            self.line(f"auto {name}_{k} = {type_name(x.dtype)}_lanes({value});", depth)
        return name

    def _assign(self, name: str, outs: Sequence[str], mask: str | None, depth: int) -> None:
        """Assign all results of a turn at once: one may be what another was."""
        fresh = [self.new() for _ in outs]
        for k, (f, out) in enumerate(zip(fresh, outs, strict=True)):
            self.line(f"const auto {f} = {out if mask is None else f'select_n_({mask}, {name}_{k}, {out})'};", depth)
        for k, f in enumerate(fresh):
            self.line(f"{name}_{k} = {f};", depth)


def _limit(value: Value) -> str | None:
    """Return what a selection is called that keeps its first case above or below its second: ``x < low ? low : x``."""
    if value.op != "select_n" or value.dtype.kind != "f" or not isinstance(value.args[0], Value):
        return None
    test, x, limit = value.args
    if test.op not in ("lt", "gt") or test.args[0] is not x or not _same(test.args[1], limit):
        return None
    return "at_least" if test.op == "lt" else "at_most"


def _same(a: Element, b: Element) -> bool:
    return a is b or (is_constant(a) and is_constant(b) and literal(a) == literal(b))


def type_name(dtype: Any) -> str:
    """Return what a type is called in the source.

    Raises:
        UnsupportedError: If it has no name there.
    """
    name = np.dtype(dtype).name
    if name not in TYPES:
        raise UnsupportedError(f"numbers of type {name} have no source")
    return TYPES[name]


def literal(x: np.generic) -> str:
    """Return a constant, exactly."""
    kind = type_name(x.dtype)
    if kind == "b1":
        return "b1(1)" if bool(x) else "b1(0)"
    if kind in ("f32", "f64"):
        if not np.isfinite(x):
            return f"{kind}_nan()" if np.isnan(x) else f"{'-' if float(x) < 0 else ''}{kind}_infinity()"
        return f"{kind}({float(x).hex()})"
    if kind == "i32":
        return f"i32({int(x)})" if int(x) != -(2**31) else "i32(-2147483647 - 1)"
    return f"u32({int(x)}u)"
