"""Operations in NumPy, where NumPy has no function that agrees with XLA; ``ops`` has the table of operations.

Operands are NumPy arrays or scalars.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import DTypeLike


def divide(a: Any, b: Any) -> Any:
    """Divide. Integers round towards zero, x / 0 has all bits set, and the smallest integer / -1 is that integer."""
    if a.dtype.kind == "f":
        return np.divide(a, b)
    if a.dtype.kind == "u":
        return np.where(b == 0, np.iinfo(a.dtype).max, a // np.where(b == 0, b.dtype.type(1), b))
    is_special = (b == 0) | (b == -1)
    divisor = np.where(is_special, b.dtype.type(1), b)
    floor = a // divisor
    quotient = floor + ((a % divisor != 0) & ((a < 0) != (divisor < 0)))
    return np.where(b == 0, a.dtype.type(-1), np.where(b == -1, np.negative(a), quotient))


def remainder(a: Any, b: Any) -> Any:
    """Return the remainder with the sign of the dividend; for integers, the remainder of x / 0 is x."""
    if a.dtype.kind == "f":
        return np.fmod(a, b)
    is_special = (b == 0) if b.dtype.kind == "u" else (b == 0) | (b == -1)
    divisor = np.where(is_special, b.dtype.type(1), b)
    return np.where(b == 0, a, np.where(is_special, a.dtype.type(0), np.fmod(a, divisor)))


def sign(x: Any) -> Any:
    """Return -1, 0 or 1 with the sign of a number; zeros and NaN are returned unchanged."""
    return np.where(x > 0, x.dtype.type(1), np.where(x < 0, x.dtype.type(-1 if x.dtype.kind != "u" else 0), x))


def round_away(x: Any) -> Any:
    """Round to the nearest integer, halves away from zero."""
    truncated = np.trunc(x)
    return np.copysign(np.where(np.abs(x - truncated) >= 0.5, np.abs(truncated) + 1, np.abs(truncated)), x)


def total_shift(shift: Callable[[Any, Any], Any], fill: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
    """Return a shift that is defined for any number of bits.

    Args:
        shift: Shift by fewer bits than the type has.
        fill: Function from the operand to the result for other numbers of bits.
    """

    def shifted(x: Any, n: Any) -> Any:
        bits = 8 * x.dtype.itemsize
        is_in_range = (n >= 0) & (n < bits) if n.dtype.kind == "i" else n < bits
        return np.where(is_in_range, shift(x, np.where(is_in_range, n, n.dtype.type(0))), fill(x))

    return shifted


def shift_logical(x: Any, n: Any) -> Any:
    """Shift to the right and fill with zeros."""
    unsigned = np.dtype(f"u{x.dtype.itemsize}")
    return np.right_shift(np.asarray(x).view(unsigned), np.asarray(n).view(unsigned)).view(x.dtype)


def shift_arithmetic(x: Any, n: Any) -> Any:
    """Shift to the right and fill with the sign."""
    signed = np.dtype(f"i{x.dtype.itemsize}")
    return np.right_shift(np.asarray(x).view(signed), np.asarray(n).view(signed)).view(x.dtype)


def sign_bits(x: Any) -> Any:
    """Return all bits set for negative numbers, and zero for others."""
    return shift_arithmetic(x, x.dtype.type(8 * x.dtype.itemsize - 1))


def convert(x: Any, dtype: DTypeLike) -> Any:
    """Convert numbers as XLA does: floats are rounded towards zero and saturate as integers, and NaN becomes 0."""
    x, dtype = np.asarray(x), np.dtype(dtype)
    if x.dtype.kind == "f" and dtype.kind in "iu":
        limits = np.iinfo(dtype)
        low, high = float(limits.min), float(limits.max) + 1  # both are exact, powers of two or 0
        is_in_range = (x > low - 1) & (x < high) if dtype.itemsize < 8 else (x >= low) & (x < high)
        truncated = np.where(is_in_range, x, 0).astype(dtype)
        saturated = np.where(np.isnan(x), 0, np.where(x >= high, limits.max, limits.min)).astype(dtype)
        return np.where(is_in_range, truncated, saturated)
    return x != 0 if dtype.kind == "b" else x.astype(dtype)


def bitcast(x: Any, dtype: DTypeLike) -> Any:
    return np.asarray(x).view(dtype)


def power(a: Any, b: Any) -> Any:
    """Raise to a power; for an exponent of 0.5 NumPy takes the square root, which is wrong at -inf and -0."""
    is_root = (b == 0.5) & ((a == 0) | np.isneginf(a))
    return np.where(is_root, np.abs(a), np.power(a, b))


def integer_pow(x: Any, y: int) -> Any:
    """Raise to a power that is a Python integer."""
    return x**y if y >= 0 else 1 / x**-y


def log_gamma(x: Any) -> Any:
    """Return the logarithm of the absolute value of the gamma function; at -inf, XLA returns inf, SciPy -inf."""
    return np.where(np.isinf(x), np.abs(x), scipy_function("gammaln")(x))


def scipy_function(name: str) -> Callable[..., Any]:
    """Return a function of ``scipy.special``, which is imported at its first call. JAX depends on SciPy."""

    def call(*args: Any) -> Any:
        from scipy import special

        return getattr(special, name)(*args)

    return call


def digamma(x: Any) -> Any:
    """Return the derivative of the logarithm of the gamma function; XLA returns NaN at its poles."""
    return np.where((x <= 0) & (x == np.floor(x)), x.dtype.type(np.nan), scipy_function("digamma")(x))
