"""Checks of values from a file or a socket, with bounds on their sizes, and messages that name the location."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, short_repr

MAX_FILE_BYTES = 256 * 2**20
"""Largest file that is read, bytes."""
MAX_POINTS = 20_000
"""Largest number of points of a trajectory."""
MAX_TIME = 7200.0
"""Latest time, s. Up to this time, float32 resolves half a millisecond."""
MIN_LENGTH = 1e-3
"""Shortest piece, s: the resolution of Skybrush and of the Crazyflie's compressed trajectories."""
MAX_COORDINATE = 1e5
"""Largest magnitude of a coordinate, m, and of a yaw in the unit of its file."""


def raise_error(expected: str, got: str, location: str) -> NoReturn:
    """Raise the error for a value that is not accepted.

    Args:
        expected: Description of an accepted value.
        got: Description of the value.
        location: File and location in it.
    """
    raise ConfigError(f"expected {expected}, got {got} in {location}")


def parse_json(content: bytes | str, location: str) -> Any:
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"expected JSON in {location}, got {type(error).__name__}: {str(error)[:100]}") from error


def require_object(value: object, location: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise_error("an object {...}", short_repr(value), location)
    return value


def require_array(value: object, n_max: int, location: str) -> list[Any]:
    if not isinstance(value, list):
        raise_error("an array [...]", short_repr(value), location)
    if len(value) > n_max:
        raise_error(f"at most {n_max} entries", str(len(value)), location)
    return value


def require_version_one(value: dict[str, Any], location: str) -> None:
    version = value.get("version")
    if version != 1 or isinstance(version, bool):
        raise_error("version 1", short_repr(version), location)


def require_number(
    value: object, location: str, low: float = -sys.float_info.max, high: float = sys.float_info.max
) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        is_bounded = max(-low, high) < sys.float_info.max
        raise_error(
            f"a number from {low:g} to {high:g}" if is_bounded else "a finite number", short_repr(value), location
        )
    return float(value)


def require_text(value: object, location: str, n_max: int = 200) -> str:
    if not isinstance(value, str) or len(value) > n_max:
        raise_error(f"a text of at most {n_max} characters", short_repr(value), location)
    return value


def require_numbers(value: object, lengths: Sequence[int], bound: float, location: str) -> NDArray:
    """Return a value that must be an array with one of the ``lengths``, of numbers from ``-bound`` to ``bound``."""
    if isinstance(value, tuple):
        value = list(value)
    if not isinstance(value, list) or len(value) not in lengths:
        raise_error(f"an array of {' or '.join(map(str, lengths))} numbers", short_repr(value), location)
    return np.array([require_number(x, location, -bound, bound) for x in value])


def require_ascending(times: NDArray, min_step: float, location: str) -> None:
    """Check that times ascend by at least ``min_step``, so that no pieces overlap or have zero length."""
    steps = np.diff(times)
    if len(steps) and steps.min() < min_step * (1 - 1e-6):
        k = int(np.argmin(steps))
        raise_error(
            f"times that ascend by at least {min_step:g} s",
            f"{times[k]:g} s followed by {times[k + 1]:g} s at entry {k + 1}",
            location,
        )
