"""A reader of programs (``ir``) that gives them to CasADi: every value is an expression on single numbers.

CasADi computes in float64 whatever the program's types are. Integers are whole numbers without an overflow, and a
number is never NaN: what asks for that is answered with no.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

from crazysim.engine.ir import Block, Element, Value
from crazysim.engine.lower import UnsupportedError
from crazysim.engine.program import Segment, Slot

Expression = Any
"""A ``casadi.SX`` of one number."""

LONGEST_LOOP = 256
"""Most turns of a loop that are written out, one after the other."""

UNSIGNED = frozenset("add sub div rem max min select_n eq ne lt le gt ge".split())
"""Operations on words that whole numbers of 53 bits can follow; a product of two words is longer."""

LARGEST = 1.7976931348623157e308
"""Largest float64, for CasADi cannot be asked whether a number is finite."""


def step(segment: Segment, number: Callable[[Slot], Expression]) -> dict[Slot, Expression]:
    """Return what a step makes of the numbers that a segment writes.

    Args:
        segment: A program of one drone.
        number: What its inputs are before the step.

    Raises:
        UnsupportedError: If CasADi has nothing for an operation.
    """
    blocks = [segment.block] if segment.before is None else [segment.before, segment.block]
    if any(value.op == "threefry2x32" for block in blocks for value in block.walk()):
        raise UnsupportedError("it draws random numbers")
    constants = [] if segment.before is None else run(segment.before, [number(slot) for slot in segment.constants])
    outputs = run(segment.block, [*(number(slot) for slot in segment.reads), *constants])
    return dict(zip(segment.writes, outputs, strict=True))


def run(block: Block, inputs: Sequence[Expression]) -> list[Expression]:
    """Return the outputs of a block.

    Raises:
        UnsupportedError: If CasADi has nothing for an operation.
    """
    return _Reader().run(block, inputs)


class _Reader:
    """Reads blocks into expressions."""

    def __init__(self) -> None:
        self.sx = _casadi().SX
        self.operations = _operations()
        self.env: dict[int, Any] = {}
        self.in_custom_jvp = False

    def run(self, block: Block, inputs: Sequence[Expression]) -> list[Expression]:
        self.env.update(zip(map(id, block.inputs), inputs, strict=True))
        for value in block.values:
            if value.op != "barrier":
                self.env[id(value)] = self._value(value, [self._element(x) for x in value.args])
        return [self._element(x) for x in block.outputs]

    def _element(self, x: Element) -> Any:
        return self.env[id(x)] if isinstance(x, Value) else self.sx(float(x))

    def _value(self, value: Value, args: list[Any]) -> Any:
        params = dict(value.params)
        match value.op:
            case "item":
                return args[0][params["index"]]
            case "when":
                mask, *old = args
                new = self.run(value.blocks[0], [])
                return [_select(mask, x, y) for x, y in zip(new, old, strict=True)]
            case "loop":
                if params["length"] > LONGEST_LOOP:
                    raise UnsupportedError(f"a loop of {params['length']} turns; written out are up to {LONGEST_LOOP}")
                for _ in range(params["length"]):
                    args = self.run(value.blocks[0], args)
                return args
            case "while":
                raise UnsupportedError("a loop that goes on until a condition fails has no form written out")
            case "custom_jvp":
                outside, self.in_custom_jvp = self.in_custom_jvp, True
                outputs = self.run(value.blocks[0], args)
                self.in_custom_jvp = outside
                return outputs
            case "convert_element_type":
                return _convert(value, args[0])
            case "sqrt" if self.in_custom_jvp:
                return _guarded_sqrt(args[0])
            case "and" | "or" | "xor" | "not" if value.dtype.kind != "b":
                raise UnsupportedError(
                    f"operation {value.op!r} on the bits of {value.dtype.name} has no form in CasADi"
                )
        unsigned = value.dtype.kind == "u"
        if value.op not in self.operations or (unsigned and value.op not in UNSIGNED):
            raise UnsupportedError(f"operation {value.op!r} on {value.dtype.name} has no form in CasADi")
        out = self.operations[value.op](*args, **params)
        if value.op == "div" and value.dtype.kind in "iu":
            return _towards_zero(out)
        return _wrap(out) if unsigned and value.op in ("add", "sub") else out


def _convert(value: Value, x: Expression) -> Expression:
    before, after = value.args[0].dtype.kind, value.dtype.kind
    if after == "b":
        return x != 0
    if before == "f" and after in "iu":
        x = _towards_zero(x)
    return _wrap(x) if after == "u" and before != "b" else x


def _wrap(x: Expression) -> Expression:
    """Return a whole number as 32 bits without a sign hold it."""
    return x - 2.0**32 * _casadi().floor(x / 2.0**32)


def _inverse_erf(x: Expression) -> Expression:
    """Return the inverse of the error function; CasADi has six digits, and each step of Newton doubles them."""
    ca = _casadi()
    y = ca.erfinv(x)
    for _ in range(2):
        y = y - (ca.erf(y) - x) * (math.sqrt(math.pi) / 2) * ca.exp(y * y)
    return y


def _select(which: Expression, yes: Expression, no: Expression) -> Expression:
    return _casadi().if_else(which, yes, no)


def _towards_zero(x: Expression) -> Expression:
    return _select(x < 0, _casadi().ceil(x), _casadi().floor(x))


def _guarded_sqrt(x: Expression) -> Expression:
    """Return a root whose slope at zero is zero.

    A function that brings a derivative of its own has it for the places where that of its arithmetic is infinite,
    as a norm at zero.
    """
    ca = _casadi()
    return _select(x > 0, ca.sqrt(_select(x > 0, x, 1.0)), 0.0)


def _round(x: Expression, rounding_method: Any) -> Expression:
    ca = _casadi()
    if int(rounding_method) == 0:  # halves away from zero
        return ca.sign(x) * ca.floor(ca.fabs(x) + 0.5)
    up = ca.floor(x + 0.5)
    tie_to_odd = ca.logic_and(up == x + 0.5, ca.fmod(up, 2) != 0)
    return up - tie_to_odd


@functools.cache
def _operations() -> dict[str, Callable[..., Expression]]:
    """Return what CasADi has for operations on floats, on whole numbers, and on truth values as 0 and 1."""
    ca = _casadi()
    same = "floor ceil exp log log1p expm1 tanh sin cos tan asin acos atan atan2 sinh cosh asinh acosh atanh".split()
    same += "sqrt sign erf".split()
    return {name: getattr(ca, name) for name in same} | {
        "add": lambda a, b: a + b,
        "sub": lambda a, b: a - b,
        "mul": lambda a, b: a * b,
        "div": lambda a, b: a / b,
        "rem": ca.fmod,
        "neg": lambda x: -x,
        "abs": ca.fabs,
        "max": ca.fmax,
        "min": ca.fmin,
        "pow": ca.power,
        "integer_pow": lambda x, y: x**y,
        "exp2": lambda x: ca.power(2.0, x),
        "rsqrt": lambda x: 1 / ca.sqrt(x),
        "cbrt": lambda x: ca.sign(x) * ca.power(ca.fabs(x), 1 / 3),
        "logistic": lambda x: 1 / (1 + ca.exp(-x)),
        "erfc": lambda x: 1 - ca.erf(x),
        "erf_inv": _inverse_erf,
        "round": _round,
        "clamp": lambda low, x, high: ca.fmin(ca.fmax(x, low), high),
        "select_n": lambda which, no, yes: _select(which, yes, no),
        "is_finite": lambda x: ca.fabs(x) <= LARGEST,
        "and": ca.logic_and,
        "or": ca.logic_or,
        "xor": lambda a, b: a != b,
        "not": ca.logic_not,
        "eq": lambda a, b: a == b,
        "ne": lambda a, b: a != b,
        "lt": lambda a, b: a < b,
        "le": lambda a, b: a <= b,
        "gt": lambda a, b: a > b,
        "ge": lambda a, b: a >= b,
    }


def _casadi() -> Any:
    """Return CasADi, which is an extra."""
    import casadi

    return casadi
