"""Work outside of compiled code that compiles little: one program for a pure function, none for arrays of numbers."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jax import Array

F = TypeVar("F", bound=Callable[..., Any])


def compiled(*static: str) -> Callable[[F], F]:
    """Return a decorator that compiles a function for calls with arrays, and leaves calls with tracers as they are.

    Outside of ``jit``, JAX compiles each operation separately, which takes 10 ms to 30 ms per operation and shape; the
    decorated function is compiled once instead. Within ``jit``, ``grad`` and the engine's stages its operations become
    part of the surrounding code, and constants remain constants.

    Args:
        *static: Names of arguments that are Python values.
    """

    def decorate(fn: F) -> F:
        jitted = jax.jit(fn, static_argnames=static)

        @functools.wraps(fn)
        def call(*args: Any, **kwargs: Any) -> Any:
            return (fn if _traced((args, kwargs)) else jitted)(*args, **kwargs)

        return call  # type: ignore[return-value]

    return decorate


def as_array(values: Any, dtype: Any) -> Array:
    """Return a copy of numbers on the host as an array on the device; ``jnp.asarray`` compiles a program per shape.

    Args:
        values: Numbers, lists or NumPy arrays.
        dtype: Type of the array; of 32 bits unless JAX is set to 64.
    """
    return jax.device_put(np.array(values, dtype))


def _traced(values: Sequence[Any]) -> bool:
    return any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(values))
