"""Checks of settings and arguments by their annotations."""

from __future__ import annotations

import functools
import inspect
import itertools
import math
import os
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.errors import ConfigError, expect, short_repr
from crazysim.tables import ANY_NUMBER, Range, Shapes, read_numbers

F = TypeVar("F", bound=Callable[..., Any])

NUMERIC_TYPES = frozenset((int, float, np.ndarray))
"""Types of fields with numbers; ``np.ndarray`` represents ``ArrayLike``."""


class Numbers:
    """Stand-in for ``ArrayLike`` in annotations, which is a union of many types."""


class NumbersByName:
    """Stand-in for ``Mapping[str, float]`` among the types of a field."""


TYPE_DESCRIPTIONS = {Callable: "a function", Mapping: "a dict"}
"""Names of types for messages, where they differ from the names of the classes."""


def check_flag(name: str, value: object) -> bool:
    """Return a setting that is on or off."""
    expect(isinstance(value, (bool, np.bool_)), f"{name} as True or False", value)
    return bool(value)


def check_value(
    name: str,
    value: object,
    value_types: Sequence[type],
    allowed: Range = ANY_NUMBER,
    shapes: Shapes | None = ((),),
    *,
    whole: bool = False,
    remedy: str = "",
) -> None:
    """Check a value by the types of its annotation.

    Args:
        value_types: Types that it may have, from ``annotated_types``; empty for any.
        shapes: Shapes of numbers; None for any.
        whole: Whether only whole numbers are accepted, as always if ``int`` is the only numeric type.
        remedy: Sentence for the end of messages.
    """
    if not value_types or (value is None and type(None) in value_types):
        return
    kinds = set(value_types) - {type(None)}
    classes, numeric_types = tuple(kinds - NUMERIC_TYPES), kinds & NUMERIC_TYPES
    if kinds == {bool}:
        check_flag(name, value)
    elif kinds == {NumbersByName}:
        expect(isinstance(value, Mapping), f"{name} as a dict of numbers by name", value, remedy)
        for key, item in value.items():
            read_numbers(f"{key!r} in {name}", item, allowed, ((),), remedy=remedy)
    elif numeric_types and not isinstance(value, classes):
        read_numbers(name, value, allowed, shapes, whole=whole or numeric_types == {int}, remedy=remedy)
    elif not isinstance(value, classes):
        names = " or ".join(sorted(TYPE_DESCRIPTIONS.get(k, k.__name__) for k in kinds))
        raise ConfigError(f"expected {name} as {names}, got {short_repr(value)}. {remedy}")


def check_arguments(function: F) -> F:
    """Decorate a public function so that it checks its arguments by their annotations, as ``check_settings`` fields.

    Numbers must be finite. Arrays may have any shape and any real numbers or bools, which the function checks itself.
    Traced values are not checked.
    """
    signature = inspect.signature(function)

    @functools.cache
    def allowed_types() -> dict[str, tuple[type, ...]]:
        names = getattr(function, "__globals__", {}) | {"ArrayLike": Numbers}
        annotated = {k: p.annotation for k, p in signature.parameters.items() if p.annotation is not p.empty}
        return {key: annotated_types(hint, names) for key, hint in annotated.items()}

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        for key, value in (bound := signature.bind(*args, **kwargs)).arguments.items():
            types, default = allowed_types().get(key, ()), signature.parameters[key].default
            if isinstance(value, jax.core.Tracer) or (value is None and default is None):
                continue
            remedy = f"help({function.__qualname__.removesuffix('.__init__')}) describes it."
            if np.ndarray in types and not isinstance(value, tuple(set(types) - NUMERIC_TYPES)):
                check_array(key, value, remedy)
                is_tree = hasattr(value, "dtype") or isinstance(value, (bool, int, float, list, tuple))
                bound.arguments[key] = value if is_tree else np.asarray(value)  # JAX takes no range, for example
            else:
                check_value(key, value, types, remedy=remedy)
                # One number in an array becomes a number, which can be compared, used as an index, and hashed.
                is_array = bool(types) and isinstance(value, (np.ndarray, jax.Array))
                bound.arguments[key] = value.item() if is_array else value
        return function(*bound.args, **bound.kwargs)

    return checked  # type: ignore[return-value]


def check_array(name: str, value: object, remedy: str = "Use an array of numbers.") -> None:
    """Check that a value is an array of real numbers or bools, which may be traced, without reading it."""
    try:
        dtype: Any = value.dtype if isinstance(value, jax.Array) else np.asarray(value).dtype
    except (TypeError, ValueError, RecursionError):
        dtype = np.dtype(object)
    is_too_large = isinstance(value, int) and not -(2**31) <= value < 2**31  # for JAX's int32
    expect(
        not is_too_large and any(jnp.issubdtype(dtype, k) for k in (np.bool_, np.integer, np.floating)),
        f"{name} as numbers",
        value,
        remedy,
    )


def require_memory(what: str, n_bytes: float, remedy: str, device: jax.Device, n_devices: int = 1) -> None:
    """Check that arrays fit into the memory of their devices: a system without memory ends the process.

    Args:
        what: The arrays, for the message.
        n_bytes: Lower bound of their size, bytes.
        remedy: Sentence for the end of the message.
        n_devices: Number of devices among which the arrays are divided.
    """
    n_devices = 1 if device.platform == "cpu" else n_devices  # several on a host share its memory
    memory, others = n_devices * _memory_size(device), f" and {n_devices - 1} more" if n_devices > 1 else ""
    if n_bytes > memory:
        raise ConfigError(
            f"expected arrays that fit into the {memory / 2**30:.1f} GiB of {device}{others}, got {what}, which need "
            f"{n_bytes / 2**30:.1f} GiB. {remedy}"
        )


def tree_bytes(tree: Any) -> int:
    """Return the size of all arrays of a tree, which may be traced, bytes."""
    return sum(np.size(x) * x.dtype.itemsize for x in jax.tree.leaves(tree))


def _memory_size(device: jax.Device) -> float:
    stats = device.memory_stats() or {}
    if "bytes_limit" in stats:
        return stats["bytes_limit"]
    if device.platform != "cpu" or "SC_PHYS_PAGES" not in getattr(os, "sysconf_names", {}):
        return math.inf
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def annotated_types(hint: Any, names: Mapping[str, Any]) -> tuple[type, ...]:
    """Return the types of an annotation; an empty tuple if it contains anything but classes, functions and numbers."""
    if isinstance(hint, str):
        try:
            hint = eval(hint, dict(names))
        except Exception:  # a name that is only imported for type checkers
            return ()
    if hint is Numbers or hint == ArrayLike:
        return (np.ndarray,)
    if typing.get_origin(hint) in (Mapping, dict):
        return (NumbersByName,) if typing.get_args(hint)[1:] == (float,) else (Mapping,)
    if typing.get_origin(hint) is Literal:
        return tuple({type(value) for value in typing.get_args(hint)})
    if typing.get_origin(hint) is Callable:
        return (Callable,)  # type: ignore[return-value]  # a class for ``isinstance``
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        parts = [annotated_types(part, names) for part in typing.get_args(hint)]
        return tuple(itertools.chain(*parts)) if all(parts) else ()
    if typing.get_origin(hint) is Sequence and (inner := annotated_types(typing.get_args(hint)[0], names)):
        return (np.ndarray,) if NUMERIC_TYPES.issuperset(inner) else ()
    # Fields that are annotated as arrays are not checked: they may hold NumPy or JAX arrays of any dtype.
    is_class = inspect.isclass(hint) and hint not in (Any, object, Array, np.ndarray) and not typing.get_args(hint)
    return (hint,) if is_class and not getattr(hint, "_is_protocol", False) else ()
