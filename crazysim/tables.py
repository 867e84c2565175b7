"""Tables with the constants of airframes and vehicles: shapes and ranges of numbers, and tables that extend a base."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, UnknownNameError, expect, require, short_repr
from crazysim.storage import is_file, read_toml

MAX_NUMBER = 1e30
"""Largest magnitude of a number, and inverse of the smallest positive one; float32 can represent both."""
ENTRY_KEYS = ("value", "unit", "source")
"""Keys of a number that is written with its unit and source."""
MODEL_SUFFIXES = (".urdf", ".xml", ".mjcf", ".sdf", ".xacro")
"""Suffixes of models of bodies, which have no rotors and are not tables."""
MAX_BASES = 8
"""Largest number of tables in a chain of bases."""

Shapes = tuple[tuple[int | str, ...], ...]
"""Allowed shapes; ``"n"`` is the number of rotors, ``"any"`` any length."""


class Range(NamedTuple):
    """Range of a number."""

    text: str
    """Description, as in "expected mass to be ..."."""
    low: Any
    """Smallest value; for an array, one for all or one for each entry."""
    high: Any = MAX_NUMBER
    """Largest value."""


ANY_NUMBER = Range(f"finite, of a size up to {MAX_NUMBER:g}", -MAX_NUMBER)
POSITIVE = Range("positive", 1 / MAX_NUMBER)
NOT_NEGATIVE = Range("at least zero", 0.0)
NEGATIVE = Range("negative", -MAX_NUMBER, -1 / MAX_NUMBER)
NOT_NEGATIVE_OR_INF = Range("at least zero, or inf", 0.0, np.inf)
MASS = Range("from 1e-6 to 1e6 kg", 1e-6, 1e6)
INERTIA = Range("from 1e-15 to 1e9 kg m^2", 1e-15, 1e9)
LENGTH = Range("from 1e-6 to 1e3 m", 1e-6, 1e3)
LENGTH_OR_ZERO = Range("from 0 to 1e3 m", 0.0, 1e3)
TIMEOUT_RANGE = Range("positive, at most 1e+06", 1 / MAX_NUMBER, 1e6)
"""Range of times to wait for another program, s."""
COORDINATE = Range("from -1e3 to 1e3 m", -1e3, 1e3)


class Key(NamedTuple):
    """A number or an array of a table."""

    shapes: Shapes
    """Allowed shapes."""
    range: Range = ANY_NUMBER
    """Range of all entries."""


def range_between(low: float = -np.inf, high: float = np.inf, positive: bool = False) -> Range:
    """Return the range of finite numbers between two bounds; ``positive`` replaces ``low`` by the smallest number."""
    upper = "" if high > MAX_NUMBER else f" to {high:.6g}"
    if positive:
        return Range(f"positive{upper and f', at most {high:.6g}'}", 1 / MAX_NUMBER, min(high, MAX_NUMBER))
    if low < -MAX_NUMBER:
        return ANY_NUMBER if not upper else Range(f"finite and at most {high:.6g}", -MAX_NUMBER, high)
    return Range(f"from {low:.6g}{upper}" if upper else f"finite and at least {low:.6g}", low, min(high, MAX_NUMBER))


def read_numbers(
    name: str,
    value: Any,
    allowed: Range = ANY_NUMBER,
    shapes: Shapes | None = None,
    *,
    whole: bool = False,
    owner: str = "",
    remedy: str = "",
) -> NDArray:
    """Return a number or an array of numbers, checked and read-only, as float64, or int64 for whole numbers.

    Args:
        shapes: Allowed shapes; None for any that is not empty.
        owner: Kind and name of the owner, for the beginning of messages.
        remedy: Sentence for the end of messages.
    """
    owner, remedy = owner and f"{owner}: ", remedy and f". {remedy}"
    array = _as_array(name, value, shapes, whole, owner, remedy)
    if shapes is None and not array.size:
        raise ConfigError(f"{owner}expected {name} as a number or array, got an empty one{remedy}")
    if shapes is not None and not any(_is_allowed_shape(array.shape, shape) for shape in shapes):
        raise ConfigError(f"{owner}expected {name} of shape {' or '.join(map(str, shapes))}, got {array.shape}{remedy}")
    # Compare a float32 in float32: a bound such as pi / 2, rounded to float32, may exceed the bound itself.
    compared_values = np.asarray(value) if getattr(value, "dtype", None) == np.float32 else array
    if not np.all((compared_values >= allowed.low) & (compared_values <= allowed.high)):
        raise ConfigError(f"{owner}expected {name} to be {allowed.text}, got {short_repr(array.tolist())}{remedy}")
    return array


def read_floats(name: str, value: Any) -> NDArray[np.float64]:
    """Return a number or an array of numbers of any shape in float64, read-only; NaN and infinity are allowed."""
    return _as_array(name, value)


def read_number(name: str, value: Any, allowed: Range = ANY_NUMBER, remedy: str = "") -> float:
    """Return one number, checked as ``read_numbers`` does."""
    return float(read_numbers(name, value, allowed, ((),), remedy=remedy))


def _as_array(
    name: str, value: Any, shapes: Shapes | None = None, whole: bool = False, owner: str = "", remedy: str = ""
) -> NDArray:
    try:
        array = np.array(value)
    except (TypeError, ValueError, RecursionError):
        array = np.array(None)
    if array.dtype.kind not in ("iu" if whole else "iuf"):
        kind = f"a {'whole ' if whole else ''}number{'' if shapes == ((),) else ' or array'}"
        raise ConfigError(f"{owner}expected {name} as {kind}, got {short_repr(value)}{remedy}")
    array = array.astype(np.int64 if whole else np.float64)
    array.setflags(write=False)
    return array


def _is_allowed_shape(shape: tuple[int, ...], allowed: tuple[int | str, ...]) -> bool:
    return len(shape) == len(allowed) and all(length in ("any", n) for length, n in zip(allowed, shape, strict=True))


def as_number_array(owner: str, path: str, value: Any) -> NDArray[np.float64]:
    """Return a number or an array of numbers in float64, read-only.

    Args:
        owner: Kind and name of the number's owner, for messages.
        path: Table and key.
        value: The number, plain or as ``{ value, unit, source }``.
    """
    if isinstance(value, Mapping) and "value" in value:
        value = value["value"]
    return _as_array(path, value, owner=f"{owner}: ")


def check_numbers(owner: str, path: str, value: NDArray, key: Key, n_rotors: int = 0) -> None:
    """Check the shape and the range of a number or array.

    Args:
        owner: Kind and name of the number's owner, for messages.
        path: Table and key.
        n_rotors: Number of rotors, the length ``"n"`` in shapes.
    """
    shapes = tuple(tuple(n_rotors if length == "n" else length for length in shape) for shape in key.shapes)
    read_numbers(path, value, key.range, shapes, owner=owner)


@dataclass(frozen=True)
class Layout:
    """Tables and keys of one kind of file."""

    keys: Mapping[str, Key]
    """Shapes and ranges of all numbers, by dotted path."""
    top_level: tuple[str, ...]
    """Keys outside of tables."""
    guide: str
    """Page that lists the keys."""

    @functools.cached_property
    def tables(self) -> tuple[str, ...]:
        """All tables by dotted path."""
        parts = [path.split(".") for path in self.keys]
        return tuple(dict.fromkeys(".".join(x[:k]) for x in parts for k in range(1, len(x))))

    def numbers(
        self, owner: str, tables: Mapping[str, Any], prefix: str = ""
    ) -> Iterator[tuple[str, NDArray[np.float64]]]:
        """Yield the dotted path and the value of every number of tables that a user wrote.

        Args:
            owner: Kind, name and origin of the owner, for messages.
            tables: The tables, with plain numbers or with units and sources.
            prefix: Dotted path of these tables, with a dot at the end; empty for all.
        """
        for key, item in tables.items():
            path = f"{prefix}{key}"
            if path in self.top_level:
                continue
            if path in self.tables:
                if not isinstance(item, Mapping):
                    raise ConfigError(
                        f"{owner}: expected a table [{path}], got {short_repr(item)}. {self.guide} lists its keys."
                    )
                yield from self.numbers(owner, item, f"{path}.")
            elif path in self.keys:
                if isinstance(item, Mapping) and ("value" not in item or set(item) - set(ENTRY_KEYS)):
                    raise ConfigError(
                        f"{owner}: expected {path} as a number, an array or {{ value, unit, source }}, got "
                        f"{short_repr(dict(item))}. {self.guide} shows both forms."
                    )
                yield path, as_number_array(owner, path, item)
            elif isinstance(item, Mapping) and "value" not in item:
                suggestion = self._did_you_mean(f"[{table}]" for table in difflib.get_close_matches(path, self.tables))
                raise ConfigError(f"{owner}: expected a table that exists, got [{path}]. {suggestion}")
            else:
                paths = [*self.keys, *self.top_level] if not prefix else list(self.keys)
                raise ConfigError(f"{owner}: expected a key that exists, got {path!r}. {self.suggestion(path, paths)}")

    def suggestion(self, path: str, paths: Iterable[str]) -> str:
        """Return a hint at paths that are probably meant: first the same key in other tables, then similar ones."""
        paths = list(paths)
        table, _, key = path.rpartition(".")
        path_by_key_in_table = {p.rpartition(".")[2]: p for p in paths if p.rpartition(".")[0] == table}
        path_by_key = {p.rpartition(".")[2]: p for p in paths}
        candidates = [p for p in paths if p.rpartition(".")[2] == key]
        candidates += [path_by_key_in_table[k] for k in difflib.get_close_matches(key, path_by_key_in_table)]
        candidates += difflib.get_close_matches(path, paths)
        candidates += [path_by_key[k] for k in difflib.get_close_matches(key, path_by_key)]
        return self._did_you_mean(repr(p) for p in dict.fromkeys(candidates))

    def _did_you_mean(self, candidates: Iterable[str]) -> str:
        nearest = list(candidates)[:3]
        hint = f"Did you mean {' or '.join(nearest)}? " if nearest else ""
        return f"{hint}{self.guide} lists all keys."


def read_source(
    source: Any, kind: str, class_name: str, folder: Path, names: tuple[str, ...], guide: str
) -> tuple[str, str, Mapping[str, Any]]:
    """Return the name of a source, its origin for messages, and its tables.

    Args:
        source: Name of a built-in file, path of another, or a dict of tables.
        kind: Kind of object that the tables describe, such as ``"airframe"``, for messages.
        class_name: Name of its class with an article, for messages.
        folder: Folder of the built-in files.
        names: Names of the built-in files.
        guide: Page that lists the keys.

    Raises:
        UnknownNameError: If the source is neither the name of a built-in file nor a file.
        ConfigError: If the source has another type, or the file is not TOML.
    """
    if isinstance(source, Mapping):
        return "custom", "", dict(source)
    expect(
        isinstance(source, (str, Path)), f"a {kind} as a name, the path of a TOML file, a dict or {class_name}", source
    )
    if str(source) in names:
        return str(source), "", _read_built_in(folder / f"{source}.toml", guide)
    require(
        is_file(source),
        f"expected a {kind} as one of {', '.join(names)}, the path of a .toml file, or a dict, got "
        f"{short_repr(str(source))}, and no file of that path exists",
        UnknownNameError,
    )
    require(
        Path(source).suffix.lower() not in MODEL_SUFFIXES,
        f"expected a {kind} as a .toml file, got {str(source)!r}, a model of bodies. Write its mass, inertia and "
        f"rotors into a .toml file, for drones with 'crazysim airframe new'. Sim(xml_path=...) loads a scene.",
    )
    return Path(source).stem, f" in {source}", read_toml(source, guide)


@functools.cache
def _read_built_in(path: Path, guide: str) -> Mapping[str, Any]:
    return read_toml(path, guide)


def extend_bases(bases: tuple[str, ...], source: Any) -> tuple[str, ...]:
    """Return a chain of sources, extended by one source; each source is the base of the previous one.

    Args:
        bases: The chain so far: names or paths of sources, or types of sources without a name.
        source: Name, path or dict of the next source.
    """
    is_text = isinstance(source, (str, Path))
    name = str(source) if is_text else f"a {type(source).__name__}"
    chain = (*bases, name)
    if (is_text and name in bases) or len(chain) > MAX_BASES:
        raise ConfigError(
            f"expected a base that leads to a file without one, got {' -> '.join(chain)[:400]}. Remove the key "
            f"base from one of them."
        )
    return chain
