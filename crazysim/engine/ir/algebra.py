"""Algebra on operations whose operands are partly known.

Only what no number contradicts is used: ``x * 1``, ``x / 1``, ``x - 0`` and, as XLA does, ``x + 0``, which loses the
sign of a zero. ``x * 0`` is kept, for it is NaN where x is infinite. A zero of a shared parameter is the exception
(``known_zero``): the zeros of a diagonal inertia or of a missing drag say that a term is not there. A state that
is infinite or NaN then gives what its other terms give, where plain XLA gives NaN; its world is flagged either way.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from crazysim.engine.ir.numpy_forms import bitcast, convert
from crazysim.engine.ir.ops import TABLE

Element = Any


class KnownZero32(np.float32):
    """A zero of a shared parameter in float32."""


class KnownZero64(np.float64):
    """A zero of a shared parameter in float64."""


ZEROS: dict[np.dtype, type] = {np.dtype(np.float32): KnownZero32, np.dtype(np.float64): KnownZero64}


def known_zero(dtype: DTypeLike) -> np.generic | None:
    """Return the element for a parameter that is zero, and absent from sums and products; None for other types."""
    kind = ZEROS.get(np.dtype(dtype))
    return None if kind is None else kind(0)


def is_known_zero(x: Element) -> bool:
    """Return True for a parameter that is zero."""
    return isinstance(x, KnownZero32 | KnownZero64)


def simplify(name: str, args: tuple[Element, ...], dtype: np.dtype, params: tuple) -> Element | None:
    """Return the element that an operation reduces to without being computed at run time, or None."""
    n_known = sum([isinstance(x, np.generic) for x in args])
    if n_known and dtype.kind == "f" and any(map(is_known_zero, args)):
        simple = _without_zero_terms(name, args, dtype)
        if simple is not None:
            return simple
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
            known, other = args if isinstance(args[0], np.generic) else args[::-1]
            return other if bool(known) == (name == "and") else known
        case "sin" | "cos" if n_known and _equals(args[0], 0):  # exact everywhere, as other values are not
            return dtype.type(name == "cos")
        case "atan2" if n_known == 2 and _equals(args[0], 0) and args[1] > 0:
            return args[0]
        case "select_n":
            return _select(*args)
        case "convert_element_type" | "bitcast_convert_type" if args[0].dtype == dtype:
            return args[0]
    return None


def _without_zero_terms(name: str, args: tuple[Element, ...], dtype: np.dtype) -> Element | None:
    """Return an operation without a term that a zero of a shared parameter multiplies."""
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
    same = isinstance(no, np.generic) and isinstance(yes, np.generic) and constant_key(no) == constant_key(yes)
    return no if same else None


def fold(name: str, args: Sequence[np.generic], dtype: np.dtype, params: tuple) -> np.generic | None:
    """Return the result for constants, where NumPy has it to the last bit."""
    row = TABLE[name]
    if not row.exact or row.numpy is None:
        return None
    settings = {"dtype": dtype} if row.numpy in (convert, bitcast) else dict(params)
    with np.errstate(all="ignore"):
        return dtype.type(row.numpy(*args, **settings))


def constant_key(x: np.generic) -> Any:
    """Return what two constants have in common that are the same to the last bit."""
    return x.dtype, type(x), x.tobytes()


def _equals(x: Element, number: float) -> bool:
    return isinstance(x, np.generic) and bool(x == number)
