"""Tables of constants, of airframes and vehicles: shapes and ranges of their numbers, and the bases they extend."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, shown

LARGEST = 1e30
"""Largest size of a number, and inverse of the smallest positive one; float32 represents both, and their inverses."""
MAX_BASES = 8
"""Most tables that extend each other."""

Shapes = tuple[tuple[int | str, ...], ...]
"""Allowed shapes; ``"n"`` is the number of rotors."""


class Range(NamedTuple):
    """Range of a number."""

    text: str
    """Description, as in "expected mass to be ..."."""
    low: Any
    """Smallest value; for an array, one for all or one for each entry."""
    high: Any = LARGEST
    """Largest value."""


ANY = Range(f"finite, of a size up to {LARGEST:g}", -LARGEST)
POSITIVE = Range("positive", 1 / LARGEST)
NOT_NEGATIVE = Range("at least zero", 0.0)
NEGATIVE = Range("negative", -LARGEST, -1 / LARGEST)
UNLIMITED = Range("at least zero, or inf", 0.0, np.inf)
MASS = Range("from 1e-6 to 1e6 kg", 1e-6, 1e6)
INERTIA = Range("from 1e-15 to 1e9 kg m^2", 1e-15, 1e9)
LENGTH = Range("from 1e-6 to 1e3 m", 1e-6, 1e3)
MAYBE_LENGTH = Range("from 0 to 1e3 m", 0.0, 1e3)
PLACE = Range("from -1e3 to 1e3 m", -1e3, 1e3)


class Key(NamedTuple):
    """A number or an array of a table."""

    shapes: Shapes
    """Allowed shapes."""
    range: Range = ANY
    """Range of all entries."""


def as_numbers(owner: str, path: str, value: Any) -> NDArray[np.float64]:
    """Return a number or an array of numbers in float64, read-only.

    Args:
        owner: Kind and name of what the number belongs to, for messages.
        path: Table and key.
        value: The number, plain or as ``{ value, unit, source }``.

    Raises:
        ConfigError: If it is anything else, such as text.
    """
    if isinstance(value, Mapping) and "value" in value:
        value = value["value"]
    try:
        array = np.array(value)
    except (TypeError, ValueError, RecursionError):
        array = np.array(None)
    if array.dtype.kind not in "iuf":
        raise ConfigError(f"{owner}: expected {path} as a number or array, got {shown(value)}")
    array = array.astype(np.float64)
    array.setflags(write=False)
    return array


def check_numbers(owner: str, path: str, value: NDArray, key: Key, n: int = 0) -> None:
    """Check the shape and the range of a number or array.

    Args:
        owner: Kind and name of what the number belongs to, for messages.
        path: Table and key.
        value: The number or array.
        key: Its shapes and range.
        n: Number of rotors.

    Raises:
        ConfigError: If it has another shape, or an entry is out of the range.
    """
    shapes = [tuple(n if length == "n" else length for length in shape) for shape in key.shapes]
    if value.shape not in shapes:
        raise ConfigError(f"{owner}: expected {path} of shape {' or '.join(map(str, shapes))}, got {value.shape}")
    if not np.all((value >= key.range.low) & (value <= key.range.high)):
        raise ConfigError(f"{owner}: expected {path} to be {key.range.text}, got {shown(value.tolist())}")


def extended(bases: tuple[str, ...], source: Any) -> tuple[str, ...]:
    """Return the sources that extend each other, with one more.

    Args:
        bases: Names, paths or kinds of the sources so far, each of which has the next one as its base.
        source: Name, path or dict of the next one.

    Raises:
        ConfigError: If it is among them already, or there are more than ``MAX_BASES``.
    """
    is_text = isinstance(source, (str, Path))
    name = str(source) if is_text else f"a {type(source).__name__}"
    found = (*bases, name)
    if (is_text and name in bases) or len(found) > MAX_BASES:
        raise ConfigError(
            f"expected a base that leads to a file without one, got {' -> '.join(found)[:400]}. Remove the key "
            f"base from one of them."
        )
    return found
