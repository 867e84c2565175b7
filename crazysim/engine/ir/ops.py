"""The table of operations: meaning and name of each operation in every target.

Programs contain no other operations. A row gives the types of numbers that an operation takes, its form in each target,
and its cost. The targets are NumPy (for constants and for the interpreter), XLA, C++ and CUDA, and CasADi. A target
refuses a program with an operation for which it has no form.

Integers and conversions follow XLA, which defines what C leaves undefined. The quotient of a division by zero is -1
(all bits set), and the remainder is the dividend. A shift by the size of the type or more gives 0, or all sign bits. A
float that is converted to an integer is rounded towards zero and saturates at the limits of the type; NaN becomes 0.
``max``, ``min`` and ``clamp`` return NaN if an operand is NaN; the sign of a zero that they return is not defined.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from crazysim.engine.errors import UnsupportedError
from crazysim.engine.ir import numpy_forms as forms

DTYPES = frozenset(map(np.dtype, "bool int8 int16 int32 int64 uint8 uint16 uint32 uint64 float32 float64".split()))
"""Types of numbers. Half precision is missing, because XLA keeps more digits inside a fusion than other engines."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class OperationForm:
    """Row of the table: one operation."""

    name: str
    """Name in programs, and of JAX's primitive if there is one."""
    operands: str
    """One letter for each operand: T for a type that all T share, b for bool, u for uint32, * for any type. ``...``
    stands for any number of operands of any type."""
    results: str = "T"
    """One letter for each result, as for ``operands``."""
    kinds: str = "f"
    """Kinds that T may be: f for float, i and u for signed and unsigned integer, b for bool."""
    numpy: Callable[..., Any] | None = None
    """NumPy's form, on arrays or scalars, with static parameters as keywords."""
    exact: bool = False
    """Whether NumPy and XLA agree to the last bit, so that operations on constants are folded."""
    xla: str | Callable[..., Any] = ""
    """Name in ``jax.lax``, or a function of the operands. By default the name of the row."""
    source: str | Mapping[str, str] = "{name}_({all})"
    """Expression in C++ and CUDA, or expressions by kind. {0}, {1}, ... and {all} stand for the operands, {type} for
    the type of the result, and the name of a static parameter for its value. The functions are in ``targets/``."""
    casadi: str | Callable[..., Any] | None = None
    """Name in ``casadi``, or a function of that module and the operands; None if CasADi has no form."""
    casadi_kinds: str = "fib"
    """Kinds for which CasADi's form is correct. It computes in float64, which does not wrap around as uint32 does."""
    cost: float = 1
    """Cost in multiply-adds."""
    structured: bool = False
    """Whether each target implements the operation separately, because it is not one expression of its operands."""

    def accepts(self, dtypes: Sequence[np.dtype]) -> bool:
        if "..." in self.operands:
            return True
        shared_types = {x for x, letter in zip(dtypes, self.operands, strict=False) if letter == "T"}
        fixed_types = [(x, letter) for x, letter in zip(dtypes, self.operands, strict=False) if letter in "bu"]
        return (
            len(dtypes) == len(self.operands)
            and len(shared_types) <= 1
            and all(x.kind in self.kinds for x in shared_types)
            and all(x == {"b": np.dtype(bool), "u": np.dtype(np.uint32)}[letter] for x, letter in fixed_types)
        )


EXPENSIVE_COST = 2
"""Cost from which a number is worth a register, to be computed once instead of at every step."""


def unsupported_error(name: str, dtypes: Sequence[np.dtype], result: Any = bool) -> UnsupportedError | None:
    """Return the error for an operation that is not defined for these types of operands and result, or None."""
    other = next((x.name for x in (*dtypes, np.dtype(result)) if x not in DTYPES), None)
    if other is not None:
        return UnsupportedError(f"numbers of type {other}")
    if TABLE[name].accepts(dtypes):
        return None
    return UnsupportedError(f"operation {name!r} on {', '.join(dict.fromkeys(x.name for x in dtypes))}")


# CasADi's forms ------------------------------------------------------------------------------------------------------


def _casadi_erf_inv(ca: Any, x: Any) -> Any:
    y = ca.erfinv(x)
    for _ in range(2):
        y = y - (ca.erf(y) - x) * (np.sqrt(np.pi) / 2) * ca.exp(y * y)
    return y


def _casadi_round_even(ca: Any, x: Any) -> Any:
    up = ca.floor(x + 0.5)
    return up - ca.logic_and(up == x + 0.5, ca.fmod(up, 2) != 0)


_LARGEST_FLOAT64 = float(np.finfo(np.float64).max)
"""Largest finite number, for the test for finite numbers, which CasADi lacks."""


def _rows() -> list[OperationForm]:
    any_number, integer = "fiu", "iu"

    def unary(name: str, numpy: Any, cost: float, casadi: Any = None, **fields: Any) -> OperationForm:
        return OperationForm(name=name, operands="T", numpy=numpy, cost=cost, casadi=casadi, **fields)

    def binary(name: str, numpy: Any, kinds: str, cost: float = 1, **fields: Any) -> OperationForm:
        return OperationForm(name=name, operands="TT", numpy=numpy, kinds=kinds, cost=cost, **fields)

    def comparison(name: str, numpy: Any, casadi: Any, kinds: str = any_number) -> OperationForm:
        # The cost is counted with the selection that uses the result.
        return binary(name, numpy, kinds, 0, results="b", exact=True, casadi=casadi, casadi_kinds="fiub")

    arithmetic = [
        binary("add", np.add, any_number, exact=True, source={"fu": "{0} + {1}", "i": "add_({all})"},
               casadi=lambda _, a, b: a + b, casadi_kinds="fiu"),
        binary("sub", np.subtract, any_number, exact=True, source={"fu": "{0} - {1}", "i": "sub_({all})"},
               casadi=lambda _, a, b: a - b, casadi_kinds="fiu"),
        binary("mul", np.multiply, any_number, exact=True, source={"fu": "{0} * {1}", "i": "mul_({all})"},
               casadi=lambda _, a, b: a * b),
        binary("div", forms.divide, any_number, 4, exact=True, source={"f": "{0} / {1}", "iu": "div_({all})"},
               casadi=lambda _, a, b: a / b, casadi_kinds="fiu"),
        binary("rem", forms.remainder, any_number, 8, exact=True, casadi="fmod", casadi_kinds="fiu"),
        binary("max", np.maximum, any_number, exact=True, casadi="fmax", casadi_kinds="fiu"),
        binary("min", np.minimum, any_number, exact=True, casadi="fmin", casadi_kinds="fiu"),
        OperationForm(name="clamp", operands="TTT", kinds=any_number, exact=True, casadi_kinds="fi",
            numpy=lambda low, x, high: np.minimum(np.maximum(x, low), high),
            casadi=lambda ca, low, x, high: ca.fmin(ca.fmax(x, low), high)),
        unary("neg", np.negative, 0, lambda _, x: -x, kinds=any_number, exact=True),
        unary("abs", np.abs, 0, "fabs", kinds="fi", exact=True),
        unary("sign", forms.sign, 1, "sign", kinds=any_number, exact=True),
        binary("nextafter", np.nextafter, "f", 4),
        unary("integer_pow", forms.integer_pow, 4, lambda _, x, y: x**y, kinds=any_number,
              source="integer_pow({0}, {y})"),
    ]  # fmt: skip
    rounding = [
        unary("floor", np.floor, 4, "floor", exact=True),
        unary("ceil", np.ceil, 4, "ceil", exact=True),
        unary("round_even", np.rint, 4, _casadi_round_even, exact=True,
              xla=lambda x: _lax().round(x, _lax().RoundingMethod.TO_NEAREST_EVEN)),
        unary("round_away", forms.round_away, 4, lambda ca, x: ca.sign(x) * ca.floor(ca.fabs(x) + 0.5), exact=True,
              xla=lambda x: _lax().round(x, _lax().RoundingMethod.AWAY_FROM_ZERO)),
        unary("is_finite", np.isfinite, 1, lambda ca, x: ca.fabs(x) <= _LARGEST_FLOAT64, results="b", exact=True),
    ]  # fmt: skip
    functions = [
        unary("sqrt", np.sqrt, 4, "sqrt", exact=True),
        unary("rsqrt", lambda x: 1 / np.sqrt(x), 2, lambda ca, x: 1 / ca.sqrt(x)),
        unary("cbrt", np.cbrt, 4, lambda ca, x: ca.sign(x) * ca.power(ca.fabs(x), 1 / 3)),
        unary("exp", np.exp, 8, "exp"),
        unary("exp2", np.exp2, 8, lambda ca, x: ca.power(2.0, x)),
        unary("expm1", np.expm1, 16, "expm1"),
        unary("log", np.log, 8, "log"),
        unary("log1p", np.log1p, 16, "log1p"),
        unary("logistic", lambda x: 1 / (1 + np.exp(-x)), 8, lambda ca, x: 1 / (1 + ca.exp(-x))),
        unary("sin", np.sin, 8, "sin"),  # sine and cosine share most of their work:
        unary("cos", np.cos, 8, "cos"),  # the source computes them together
        unary("tan", np.tan, 16, "tan"),
        unary("asin", np.arcsin, 16, "asin"),
        unary("acos", np.arccos, 16, "acos"),
        unary("atan", np.arctan, 16, "atan"),
        binary("atan2", np.arctan2, "f", 16, casadi="atan2"),
        unary("sinh", np.sinh, 16, "sinh"),
        unary("cosh", np.cosh, 16, "cosh"),
        unary("tanh", np.tanh, 8, "tanh"),
        unary("asinh", np.arcsinh, 16, "asinh"),
        unary("acosh", np.arccosh, 16, "acosh"),
        unary("atanh", np.arctanh, 16, "atanh"),
        binary("pow", forms.power, "f", 16, casadi="power"),
        unary("erf", forms.scipy_function("erf"), 16, "erf"),
        unary("erfc", forms.scipy_function("erfc"), 16, lambda ca, x: 1 - ca.erf(x)),
        unary("erf_inv", forms.scipy_function("erfinv"), 16, _casadi_erf_inv),
        unary("lgamma", forms.log_gamma, 32),
        unary("digamma", forms.digamma, 32),
    ]
    comparisons = [
        comparison("eq", np.equal, lambda _, a, b: a == b, "fiub"),
        comparison("ne", np.not_equal, lambda _, a, b: a != b, "fiub"),
        comparison("lt", np.less, lambda _, a, b: a < b),
        comparison("le", np.less_equal, lambda _, a, b: a <= b),
        comparison("gt", np.greater, lambda _, a, b: a > b),
        comparison("ge", np.greater_equal, lambda _, a, b: a >= b),
        OperationForm(name="select_n", operands="bTT", kinds="fiub", exact=True, casadi_kinds="fiub",
            numpy=lambda which, no, yes: np.where(which, yes, no),
            casadi=lambda ca, which, no, yes: ca.if_else(which, yes, no)),
    ]  # fmt: skip
    bits = [
        binary("and", np.bitwise_and, "iub", exact=True, xla="bitwise_and", casadi="logic_and", casadi_kinds="b"),
        binary("or", np.bitwise_or, "iub", exact=True, xla="bitwise_or", casadi="logic_or", casadi_kinds="b"),
        binary("xor", np.bitwise_xor, "iub", exact=True, xla="bitwise_xor",
               casadi=lambda _, a, b: a != b, casadi_kinds="b"),
        unary("not", np.invert, 1, "logic_not", kinds="iub", exact=True, xla="bitwise_not", casadi_kinds="b"),
        binary("shift_left", forms.total_shift(np.left_shift, np.zeros_like), integer, exact=True),
        binary("shift_right_logical", forms.total_shift(forms.shift_logical, np.zeros_like), integer, exact=True),
        binary("shift_right_arithmetic", forms.total_shift(forms.shift_arithmetic, forms.sign_bits), integer,
               exact=True),
        OperationForm(name="convert_element_type", operands="*", results="*", numpy=forms.convert, exact=True,
            source="to_{type}({0})"),
        OperationForm(name="bitcast_convert_type", operands="*", results="*", numpy=forms.bitcast, exact=True,
            source="bits_{type}({0})"),
        OperationForm(name="opaque_copy", operands="T", cost=0, numpy=lambda x, **_: x, xla=lambda x, **_: x,
            source="OPAQUE_COPY({0})"),
    ]  # fmt: skip
    structured = [
        OperationForm(name="barrier", operands="", results="", cost=0, structured=True),
        OperationForm(name="table", operands="", results="*", cost=0, structured=True),
        OperationForm(name="lookup", operands="**", results="*", structured=True),
        OperationForm(name="any_lane", operands="b", results="b", kinds="b", structured=True),
        OperationForm(name="threefry2x32", operands="uuuu", results="uu", cost=60, structured=True),
        *(OperationForm(name=name, operands="...", results="...", cost=0, structured=True)
          for name in ("when", "loop", "while", "custom_jvp", "over_others")),
    ]  # fmt: skip
    return [*arithmetic, *rounding, *functions, *comparisons, *bits, *structured]


def _lax() -> Any:
    from jax import lax

    return lax


TABLE: Mapping[str, OperationForm] = {row.name: row for row in _rows()}
"""All operations by name.

- ``barrier`` separates stages: values that are used after it are computed once, before it.
- ``when(mask, *old)`` returns the outputs of its block where the mask is true, and the old numbers elsewhere.
- ``loop(*carry, length=)`` runs its block ``length`` times.
- ``while(*carry)`` runs its second block as long as its first block returns true.
- ``custom_jvp(*args, derivative=)`` runs its block, and has a custom derivative.
- ``over_others(*published, reduce=, n_members=)`` runs its block for each drone of the world. The inputs of the block
  are the numbers that this drone published, and whether it is the reading drone itself. ``reduce`` names the operation
  that combines each output. ``over_others`` never occurs in an inner block.
- ``threefry2x32`` is the cipher of JAX's random numbers.
- ``opaque_copy(x, part=)`` is x as a new value in each part, so that the numbers that depend on it are recomputed.
  Compilers on the host may still merge these values.
- ``table(numbers=)`` is a table of constants.
- ``lookup(table, index, offset=, aligned=)`` is the entry of a table at the sum of an int32 index (a multiple of four
  if ``aligned``) and a constant offset. The sum must be in bounds.
- ``any_lane`` is true where its operand is true. A target may also return true in all lanes of a vector if the operand
  is true in any of them.

Comparisons and changes of sign cost nothing: comparisons are counted with the selections that use them, and a change of
sign is part of another operation. The cost of a function is the cost of a hardware approximation and a step that
refines it, or of the shortest polynomial that is exact to float32. A random number takes twenty rounds of add, rotate
and xor. An operation that runs a block costs as much as the block.
"""

REDUCTIONS: Mapping[str, str] = {"sum": "add", "min": "min", "max": "max"}
"""Operations that combine the results of ``over_others``."""

INDEX_REDUCTIONS: Mapping[str, str] = {"argmin": "lt", "argmax": "gt"}
"""Comparison that decides whether a number replaces the best number so far, for each reduction that returns an index:
of the first drone with the smallest or largest number. Only derivatives in kernels use these reductions."""


def neutral_number(name: str, dtype: np.dtype) -> np.generic:
    """Return the initial number of a reduction. For bools, ``or`` and ``and`` take the place of max and min."""
    if name in ("add", "or", "and", *INDEX_REDUCTIONS):
        return dtype.type(name == "and")
    limits = (-np.inf, np.inf) if dtype.kind == "f" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
    return dtype.type(limits[name == "min"])


BOOLEAN_FORM: Mapping[str, tuple[str, int | None]] = {
    "lt": ("and", 0),
    "gt": ("and", 1),
    "le": ("or", 0),
    "ge": ("or", 1),
    "max": ("or", None),
    "min": ("and", None),
}
"""Logical operation that replaces each comparison, maximum or minimum of bools, and the index of the operand that is
negated first, or None."""
