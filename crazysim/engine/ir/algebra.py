"""Algebraic simplification of operations with constant operands.

Only identities that hold for every number are used, such as ``x * 1``, ``x / 1`` and ``x - 0``. ``x + 0`` is simplified
too, as in XLA, although this loses the sign of a negative zero. ``x * 0`` of floats is not simplified, because the
product is NaN if x is infinite.

Zeros of shared parameters are an exception (``known_zero``): terms that they multiply are removed, such as terms of a
diagonal inertia or of an absent drag. If a state in such a term is infinite or NaN, the result is the sum of the other
terms, where plain XLA would return NaN. The world is flagged as not finite in both cases.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from crazysim.engine.ir.numpy_forms import bitcast, convert
from crazysim.engine.ir.ops import TABLE

Element = Any
"""A ``Value`` of a block, or a NumPy scalar for a constant."""


class KnownZero32(np.float32):
    """A zero of a shared parameter in float32."""


class KnownZero64(np.float64):
    """A zero of a shared parameter in float64."""


ZEROS: dict[np.dtype, type] = {np.dtype(np.float32): KnownZero32, np.dtype(np.float64): KnownZero64}
"""Classes of the zeros of shared parameters, by type."""


def known_zero(dtype: DTypeLike) -> np.generic | None:
    """Return the element for a zero of a shared parameter; None if the type is not float32 or float64."""
    zero_type = ZEROS.get(np.dtype(dtype))
    return None if zero_type is None else zero_type(0)


def is_known_zero(x: Element) -> bool:
    """Return True for a zero of a shared parameter, as ``known_zero`` makes it."""
    return isinstance(x, KnownZero32 | KnownZero64)


def simplify(name: str, args: tuple[Element, ...], dtype: np.dtype, params: tuple) -> Element | None:
    """Return the element that an operation reduces to; None if it must be computed at run time."""
    n_known = sum([isinstance(x, np.generic) for x in args])
    if n_known and dtype.kind == "f" and any(map(is_known_zero, args)):
        simplified = _without_zero_terms(name, args, dtype)
        if simplified is not None:
            return simplified
    if n_known == len(args) and TABLE[name].exact:
        return fold(name, args, dtype, params)
    match name:
        case "add" if n_known:
            return args[1] if _equals(args[0], 0) else args[0] if _equals(args[1], 0) else None
        case "sub" if n_known:
            return args[0] if _equals(args[1], 0) else None
        case "mul" if n_known:
            if dtype.kind != "f" and any([_equals(x, 0) for x in args]):
                return dtype.type(0)
            return args[1] if _equals(args[0], 1) else args[0] if _equals(args[1], 1) else None
        case "div" if n_known:
            return args[0] if _equals(args[1], 1) else None
        case "and" | "or" if n_known and dtype.kind == "b":
            number, other = args if isinstance(args[0], np.generic) else args[::-1]
            return other if bool(number) == (name == "and") else number
        case "sin" | "cos" if n_known and _equals(args[0], 0):  # exact on every platform, unlike other arguments
            return dtype.type(name == "cos")
        case "atan2" if n_known == 2 and _equals(args[0], 0) and args[1] > 0:
            return args[0]
        case "select_n":
            return _select(*args)
        case "convert_element_type" | "bitcast_convert_type" if args[0].dtype == dtype:
            return args[0]
    return None


def _without_zero_terms(name: str, args: tuple[Element, ...], dtype: np.dtype) -> Element | None:
    zeros = [is_known_zero(x) for x in args]
    match name:
        case "mul" | "neg" | "convert_element_type":
            return known_zero(dtype)
        case "add":
            return args[1] if zeros[0] else args[0]
        case "sub" if zeros[1]:
            return args[0]
        case "div" if zeros == [True, False]:
            return known_zero(dtype)
    return None


def _select(which: Element, no: Element, yes: Element) -> Element | None:
    if isinstance(which, np.generic):
        return yes if which else no
    if no is yes:
        return no
    is_same = isinstance(no, np.generic) and isinstance(yes, np.generic) and constant_key(no) == constant_key(yes)
    return no if is_same else None


def fold(name: str, args: Sequence[np.generic], dtype: np.dtype, params: tuple) -> np.generic | None:
    """Return the result of an operation on constants; None if NumPy does not compute it exactly as the engine does."""
    row = TABLE[name]
    if not row.exact or row.numpy is None:
        return None
    kwargs = {"dtype": dtype} if row.numpy in (convert, bitcast) else dict(params)
    with np.errstate(all="ignore"):
        return dtype.type(row.numpy(*args, **kwargs))


def constant_key(x: np.generic) -> Any:
    """Return a key that is equal for constants of the same type and bits."""
    return x.dtype, type(x), x.tobytes()


def _equals(x: Element, number: float) -> bool:
    return isinstance(x, np.generic) and bool(x == number)
