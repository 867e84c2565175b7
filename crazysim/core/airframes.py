"""Airframes of the drones of a simulation: names of the drones, and parameters that differ between airframes."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

import jax
import numpy as np
from numpy.typing import ArrayLike

from crazysim.drones import Airframe, AirframeSource, load_airframe
from crazysim.engine.pytree import PyTree
from crazysim.errors import ConfigError

T = TypeVar("T")

NAME_PREFIXES = {"Crazyflie": ("cf", "crazyflie"), "Bumblebee": ("bumblebee",)}
"""Lower-case beginnings of airframe names, by the prefix of the drones' names, as in AIMotionLab-Virtual."""
ROTOR_MASK = "rotors"
"""Name of the field of a record that masks rotors: True for the rotors that a drone has. The field is None if all
drones have the same number of rotors."""
PER_ROTOR_FIELDS = ("L", "prop_inertia", "rpm2thrust", "rpm2torque", "rotor_dyn_coef")
"""Fields in which missing rotors repeat the value of the last rotor; all other fields are zero for missing rotors.
``L`` is the arm of the rotors."""


Airframes = Airframe | Sequence[Airframe]
"""One airframe for all drones, or a sequence with one for each drone."""


def load_airframes(drone: AirframeSource | Sequence[AirframeSource], n_drones: int) -> tuple[Airframe, ...]:
    """Return the airframe of each drone; drones with the same source share one object. (n_drones,)"""
    if not is_airframe_list(drone):
        return (load_airframe(drone),) * n_drones  # type: ignore[arg-type]
    if not drone:
        raise ConfigError("expected an airframe or a list with one for each drone, got an empty list")
    if len(drone) != n_drones:
        raise ConfigError(
            f"expected {n_drones} airframes, one for each drone, got {len(drone)}. Use Sim(n_drones={len(drone)}), or "
            f"one airframe for all."
        )
    keys = [str(source) if isinstance(source, (str, Path)) else id(source) for source in drone]
    airframe_by_key = {key: load_airframe(source) for key, source in dict(zip(keys, drone, strict=True)).items()}
    return tuple([airframe_by_key[key] for key in keys])


def is_airframe_list(drone: object) -> TypeGuard[Sequence[AirframeSource]]:
    """Return True for a sequence with one airframe for each drone, False for a single airframe."""
    return isinstance(drone, Sequence) and not isinstance(drone, str)


def as_airframes(airframes: Airframes, n_drones: int = 1) -> tuple[Airframe, ...]:
    """Return the airframe of each drone. (n_drones,)"""
    return (airframes,) * n_drones if isinstance(airframes, Airframe) else tuple(airframes)


def find_common_airframe(airframes: Airframes) -> Airframe:
    """Return the airframe that all drones share."""
    first_airframe, *other_airframes = as_airframes(airframes)
    if any(other_airframe is not first_airframe for other_airframe in other_airframes):
        names = ", ".join(dict.fromkeys(repr(airframe.name) for airframe in (first_airframe, *other_airframes)))
        raise ConfigError(f"expected one airframe for all drones, got {names}. Use sim.airframes, one for each drone.")
    return first_airframe


def max_n_rotors(airframes: Airframes) -> int:
    # Thousands of drones share a few airframes.
    distinct_airframes = {id(airframe): airframe for airframe in as_airframes(airframes)}
    return max(airframe.n_rotors for airframe in distinct_airframes.values())


def name_prefix(airframe: Airframe) -> str:
    """Return the prefix of drone names for an airframe: ``Crazyflie``, ``Bumblebee``, or its own name in PascalCase."""
    name = airframe.name.lower()
    for prefix, beginnings in NAME_PREFIXES.items():
        if name.startswith(beginnings):
            return prefix
    words = re.findall("[A-Za-z0-9]+", airframe.name)
    return "".join(word[0].upper() + word[1:] for word in words) or "Drone"


def drone_names(airframes: Sequence[Airframe]) -> tuple[str, ...]:
    """Return the names of drones, numbered for each prefix: ``Crazyflie_0``, ``Bumblebee_0``, ``Crazyflie_1``."""
    counts: dict[str, int] = {}
    names = []
    for prefix in map(name_prefix, airframes):
        counts[prefix] = counts.get(prefix, -1) + 1
        names.append(f"{prefix}_{counts[prefix]}")
    return tuple(names)


def create_per_drone(airframes: Airframes, create: Callable[[Airframe], T], n_worlds: int) -> T:
    """Return one record for all drones: a leaf is shared if it is equal for all airframes, else it has a row per drone.

    If airframes have different numbers of rotors, axes over rotors are padded to the largest number. The padding
    repeats the last rotor in ``PER_ROTOR_FIELDS`` and is zero in other fields, such as a mixing matrix.
    """
    airframes = as_airframes(airframes)
    distinct_airframes = list({id(airframe): airframe for airframe in airframes}.values())
    records = [create(airframe) for airframe in distinct_airframes]
    if len(distinct_airframes) == 1:
        return records[0]
    rotor_counts = [airframe.n_rotors for airframe in distinct_airframes]
    if len(set(rotor_counts)) > 1:
        records = [_add_rotor_masks(record, n) for record, n in zip(records, rotor_counts, strict=True)]
    structures = [jax.tree.structure(record) for record in records]
    for airframe, structure in zip(distinct_airframes, structures, strict=True):
        if structure != structures[0]:
            raise ConfigError(
                f"expected airframes that define the same fields of {type(records[0]).__name__}, got "
                f"{distinct_airframes[0].name!r} and {airframe.name!r}, of which one lacks a field. Add its values, "
                f"inherit them with the key 'base', or use another controller."
            )
    airframe_indices = [distinct_airframes.index(airframe) for airframe in airframes]

    def stack_leaf(path: tuple[object, ...], *values: ArrayLike) -> np.ndarray:
        name = jax.tree_util.keystr(path[-1:]).strip("[].'\"")
        arrays = _pad_to_longest([np.asarray(x) for x in values], name)
        if all(np.array_equal(x, arrays[0]) for x in arrays):
            return arrays[0]
        per_drone = np.stack([arrays[k] for k in airframe_indices])
        return np.array(np.broadcast_to(per_drone, (n_worlds, *per_drone.shape)))

    return jax.tree_util.tree_map_with_path(stack_leaf, *records)


def _pad_to_longest(arrays: list[np.ndarray], name: str) -> list[np.ndarray]:
    # A length of 1 means that all rotors share a value, which is repeated.
    shape = tuple(np.max([x.shape for x in arrays], axis=0)) if arrays[0].ndim else ()
    padded = []
    for x in arrays:
        padding = [(0, n - size) for n, size in zip(shape, x.shape, strict=True)]
        is_repeated = [size == 1 and n > 1 for n, size in zip(shape, x.shape, strict=True)]
        if any(is_repeated):
            x = np.broadcast_to(
                x, [n if repeat else size for n, size, repeat in zip(shape, x.shape, is_repeated, strict=True)]
            )
            padding = [(0, n - size) for n, size in zip(shape, x.shape, strict=True)]
        padded.append(np.pad(x, padding, mode="edge" if name in PER_ROTOR_FIELDS else "constant"))
    return padded


def _add_rotor_masks(record: Any, n_rotors: int) -> Any:
    if not isinstance(record, PyTree):
        return record
    changes = {}
    for f in dataclasses.fields(record):  # type: ignore[arg-type]
        value = getattr(record, f.name)
        if f.name == ROTOR_MASK and value is None:
            changes[f.name] = np.ones(n_rotors, bool)
        elif isinstance(value, (PyTree, tuple, list)):
            is_sequence = isinstance(value, (tuple, list))
            changes[f.name] = (
                type(value)(_add_rotor_masks(x, n_rotors) for x in value)
                if is_sequence
                else _add_rotor_masks(value, n_rotors)
            )
    return record.replace(**changes) if changes else record
