"""Calls outside of compiled code: functions compiled as a whole, and rows read without compilation."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from numpy.typing import NDArray

F = TypeVar("F", bound=Callable[..., Any])


def jit_eager_calls(*static: str) -> Callable[[F], F]:
    """Return a decorator that compiles a function for calls with arrays, and does not change calls with tracers.

    Outside of ``jit``, JAX compiles each operation separately, which takes 10 ms to 30 ms per operation and shape; the
    decorated function is compiled as a whole instead. Within ``jit``, ``grad`` and the engine's stages, the operations
    of the function become part of the surrounding code, and constant arguments remain constants.

    Args:
        *static: Names of arguments that are Python values.
    """

    def decorate(fn: F) -> F:
        jitted = jax.jit(fn, static_argnames=static)

        @functools.wraps(fn)
        def call(*args: Any, **kwargs: Any) -> Any:
            return (fn if is_traced((args, kwargs)) else jitted)(*args, **kwargs)

        return call  # type: ignore[return-value]

    return decorate


@contextlib.contextmanager
def explain_traced_values(title: str) -> Iterator[None]:
    """Add the remedy to JAX's error about a traced value in a Python ``if``, ``while``, ``int`` or array of NumPy."""
    try:
        yield
    except (
        jax.errors.ConcretizationTypeError,
        jax.errors.TracerArrayConversionError,
        jax.errors.TracerIntegerConversionError,
    ) as error:
        if not any("jnp.where" in note for note in getattr(error, "__notes__", ())):
            error.add_note(
                f"in {title}, which is compiled for all worlds at once: a value is not known yet. Use "
                "jnp.where(condition, x, y) in place of a Python if, and jnp in place of np or math."
            )
        raise


def fetch_rows(x: Any, rows: Any) -> NDArray:
    """Return ``x[rows]`` on the host; rows of a CPU array are read by NumPy, without a compiled call."""
    return np.asarray(x)[rows] if is_on_host(x) else np.asarray(x[rows])


def is_on_host(x: Any) -> bool:
    """Whether an array is in the host's memory: a NumPy array, or a JAX array on the CPU."""
    if isinstance(x, jax.core.Tracer):
        return False
    return not isinstance(x, jax.Array) or all(device.platform == "cpu" for device in x.devices())


def is_traced(values: Sequence[Any]) -> bool:
    """Whether a leaf of the values is traced: within ``jit``, ``grad`` or a stage of the engine."""
    return any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(values))
