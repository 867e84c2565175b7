"""Subnormal numbers taken for zero in NumPy, as XLA takes them on a CPU."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import platform
import sys
from collections.abc import Iterator

import numpy as np

Environment = ctypes.c_uint32 * 8
"""``fenv_t`` of x86-64 Linux."""
MXCSR_INDEX = 7
"""Word of it that controls the arithmetic of vector registers."""
FLUSH_BITS = 0x8040
"""Bits that take subnormal results and operands for zero: Intel 64 manual, volume 1, section 10.2.3."""


@contextlib.contextmanager
def flush_subnormals() -> Iterator[None]:
    """Treat subnormal numbers as zero in this thread; only on x86-64 Linux."""
    library = _library()
    if library is None:
        yield
        return
    before = Environment()
    library.fegetenv(before)
    inside = Environment(*before)
    inside[MXCSR_INDEX] |= FLUSH_BITS
    library.fesetenv(inside)
    try:
        yield
    finally:
        library.fesetenv(before)


@functools.cache
def _library() -> ctypes.CDLL | None:
    """Return the C library; None on other platforms, whose environments have another form."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return None
    for dtype in (np.float32, np.float64):
        np.finfo(dtype)  # NumPy computes the smallest numbers once, and would find zero later
    return ctypes.CDLL(None)
