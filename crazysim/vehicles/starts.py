"""Starts of cars: in a row, at given places, or along their paths."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError
from crazysim.pytree import floating
from crazysim.vehicles.path import Path

GAP = 1.0
"""Distance of neighbours that start in a row, m."""


def in_a_row(n: int) -> NDArray[Any]:
    """Return places in a row along y around the origin. (n, 2)"""
    return np.stack([np.zeros(n), GAP * (np.arange(n) - (n - 1) / 2)], axis=1)


def places(name: str, value: Any, counts: tuple[int, int], core: tuple[int, ...]) -> NDArray[np.float64]:
    """Return a value for all cars, or for each. (..., *core)

    Raises:
        ConfigError: If it has another shape or is not finite.
    """
    array = np.asarray(value, float)
    shapes = [core, (counts[1], *core), (*counts, *core)]
    if array.shape not in shapes or not np.all(np.isfinite(array)):
        raise ConfigError(
            f"expected {name} as finite numbers of shape {' or '.join(map(str, shapes))} = (n_worlds, n_members, ...), "
            f"got shape {array.shape}"
        )
    return array


def numbers(name: str, value: Any, counts: tuple[int, int], n: int | None = None) -> NDArray[Any]:
    """Return a number for all cars, (1,), or for each, (n_worlds, n_members, 1); whole numbers below n if it is given.

    Raises:
        ConfigError: If it has another shape or an invalid value.
    """
    array = np.asarray(value)
    whole = n is None or (array.dtype.kind in "iu" and np.all((array >= 0) & (array < n)))
    if array.shape not in ((), counts[1:], counts) or array.dtype.kind not in "iuf" or not whole:
        what = "a number" if n is None else f"a whole number from 0 to {n - 1}"
        raise ConfigError(
            f"expected {name} as {what} for all cars, or for each, {counts[1:]} or {counts} = (n_worlds, n_members), "
            f"got {value!r}"
        )
    if not np.all(np.isfinite(array)):
        raise ConfigError(f"expected {name} to be finite, got {value!r}")
    array = array.astype(floating() if n is None else np.int32)
    return array[None] if array.ndim == 0 else np.array(np.broadcast_to(array, counts))[..., None]


def on_path(
    paths: Path, index: NDArray[Any], start: NDArray[Any], counts: tuple[int, int]
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return positions (..., 2), headings (..., 1) and arc lengths (..., 1) of cars on their paths at time zero."""
    index, start = (np.broadcast_to(x, (*counts, 1)) for x in (index, start))
    pos, yaw, arc = np.zeros((*counts, 2)), np.zeros((*counts, 1)), np.zeros((*counts, 1))
    found: dict[tuple[int, float], tuple[Any, ...]] = {}
    for at in np.ndindex(counts):
        key = int(index[at][0]), float(start[at][0])
        if key not in found:
            found[key] = paths.at_time(*key)
        pos[at], yaw[at], arc[at] = found[key]
    return pos, yaw, arc


def projected(paths: Any, index: Any, pos: NDArray[Any], arc: NDArray[Any]) -> NDArray[Any]:
    """Return the arc lengths next to positions, in the round of a reference. (n_worlds, n_members, 1)"""
    index, found = np.broadcast_to(index, arc.shape), np.empty_like(arc)
    for at in np.ndindex(arc.shape[:2]):
        k = int(index[at][0])
        nearest, length = paths.nearest(k, pos[at]), float(paths.length[k])
        rounds = round((float(arc[at][0]) - nearest) / length) if paths.closed[k] else 0
        found[at] = nearest + rounds * length
    return found


def spread(paths: Path, index: NDArray[Any], n: int) -> NDArray[Any]:
    """Return start times of n cars: at equal intervals for those of one closed path, zero for others, s. (n,)"""
    own = np.broadcast_to(index.reshape(-1)[:n], (n,))
    times = np.zeros(n)
    for path in np.unique(own):
        cars = np.flatnonzero(own == path)
        if np.asarray(paths.closed)[path]:
            times[cars] = -np.arange(len(cars)) / len(cars) * float(paths.duration[path])
    return times
