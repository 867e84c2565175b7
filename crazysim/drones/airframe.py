"""Airframes: loading the constants of a drone type from a TOML file or a dict, with checks."""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazysim.drones.keys import GUIDE, KEYS, TOP_LEVEL, check_keys, suggestion
from crazysim.errors import ConfigError, UnknownNameError

FOLDER = Path(__file__).parent


class Drone(StrEnum):
    """Names of the built-in airframes."""

    cf21B_500 = "cf21B_500"
    cf2x_L250 = "cf2x_L250"
    cf2x_P250 = "cf2x_P250"
    cf2x_T350 = "cf2x_T350"
    hb_x500 = "hb_x500"
    crazyflie = "crazyflie"
    bumblebee = "bumblebee"
    bumblebee_lab = "bumblebee_lab"


@dataclass(frozen=True, eq=False)
class Airframe:
    """Constants of a drone type, as plain numbers in SI units (rotor speeds in rpm)."""

    name: str
    """Name: the key ``name``, or else the file's stem; ``custom`` for a dict without one."""
    tables: Mapping[str, Any]
    """All tables of the file with their numbers as float64 arrays, without units and sources."""

    def table(self, path: str) -> Mapping[str, Any]:
        """Return a table by its dotted path, such as ``controller.state``.

        Raises:
            ConfigError: If the airframe has no such table.
        """
        node: Any = self.tables
        for part in path.split("."):
            node = node.get(part) if isinstance(node, Mapping) else None
            if not isinstance(node, Mapping):
                raise ConfigError(
                    f"airframe {self.name!r} has no table [{path}], only {sorted(self.tables)}. "
                    f"Add [{path}] to the airframe; {GUIDE} lists its keys."
                )
        return node

    def value(self, path: str, shape: tuple[int, ...] | None = None) -> NDArray[np.float64]:
        """Return one number or array by its dotted path, such as ``rigid_body.mass``.

        Args:
            path: Table and key.
            shape: Expected shape; None for any.

        Raises:
            ConfigError: If the value is missing or has another shape.
        """
        if path not in self._by_path:
            raise ConfigError(f"airframe {self.name!r} has no value {path!r}. {_remedy(path, self._by_path)}")
        value = self._by_path[path]
        if shape is not None and value.shape != shape:
            raise ConfigError(f"airframe {self.name!r}: expected {path} of shape {shape}, got {value.shape}")
        return value

    @functools.cached_property
    def _by_path(self) -> dict[str, NDArray[np.float64]]:
        return dict(_values(self.tables))

    @property
    def n_rotors(self) -> int:
        """Number of rotors."""
        return len(self.value("rotors.position"))

    @property
    def inertia(self) -> NDArray[np.float64]:
        """Inertia about the centre of mass, body frame, kg m^2. (3, 3)"""
        inertia = self.value("rigid_body.inertia")
        return np.diag(inertia) if inertia.shape == (3,) else inertia

    @property
    def arm(self) -> float:
        """Largest distance of a rotor from the body's x or y axis, m: the scale of the mixing matrix."""
        return float(np.max(np.abs(self.value("rotors.position")[:, :2])))

    @property
    def mixing_matrix(self) -> NDArray[np.float64]:
        """Rotor thrusts to torque over the arm, 1. (3, n_rotors)

        A rotor at (x, y) with thrust f exerts the torque (y f, -x f), so the rows are y / arm, -x / arm and
        the sign of the torque that its drag exerts on the body about z.
        """
        position = self.value("rotors.position")
        sign = self.value("rotors.yaw_torque_sign")
        return np.stack([position[:, 1] / self.arm, -position[:, 0] / self.arm, sign])

    @property
    def full_thrust_voltage(self) -> float | None:
        """Motor voltage at which a rotor reaches ``rotors.thrust_max``, V; None without a table ``[battery]``."""
        if "battery" not in self.tables:
            return None
        excess = self.value("battery.thrust_over_voltage") - [self.value("rotors.thrust_max"), 0, 0, 0]
        roots = np.polynomial.polynomial.polyroots(excess)
        return float(np.min(roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]))

    def __repr__(self) -> str:
        """Return the name alone; the tables are long."""
        return f"Airframe({self.name!r})"


def airframe_names() -> tuple[str, ...]:
    """Return the names of the built-in airframes."""
    return tuple(drone.value for drone in Drone)


def load_airframe(source: str | Path | Mapping[str, Any] | Airframe) -> Airframe:
    """Return the airframe of a name, a TOML file anywhere on disk, or a dict of the same tables.

    A number is written plainly, or as ``{ value = ..., unit = "...", source = "..." }`` as in the built-in files. With
    the key ``base``, the name or path of another airframe, only the numbers that differ from it are given.

    Args:
        source: Name of a built-in airframe, path of a ``.toml`` file, dict, or an airframe (returned as is).

    Raises:
        UnknownNameError: If the source is neither the name of an airframe nor a file.
        ConfigError: If a table or key does not exist, or the numbers cannot be those of a drone.
    """
    if isinstance(source, Airframe):
        return source
    if isinstance(source, Mapping):
        default_name, origin, tables = "custom", "", dict(source)
    else:
        default_name, origin, tables = _read(source)
    name = str(tables.get("name", default_name))
    check_keys(f"airframe {name!r}{origin}", tables)
    base = tables.get("base")
    numbers = _numbers(name, {key: table for key, table in tables.items() if key not in TOP_LEVEL}, ())
    if base is not None:
        numbers = _merged(load_airframe(base).tables, numbers)
    airframe = Airframe(name, numbers)
    _check(airframe)
    return airframe


def _read(source: str | Path) -> tuple[str, str, dict[str, Any]]:
    """Return the name of an airframe, its origin for messages, and its tables."""
    if not isinstance(source, (str, Path)):
        raise ConfigError(f"expected a drone as a name, the path of a TOML file, a dict or an Airframe, got {source!r}")
    path = FOLDER / f"{source}.toml" if str(source) in airframe_names() else Path(source)
    if not path.is_file():
        raise UnknownNameError(
            f"expected a drone as one of {', '.join(airframe_names())}, the path of a .toml file, or a dict, "
            f"got {str(source)!r}, and no file of that path exists"
        )
    try:
        return path.stem, f" in {path}", _parsed(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path} is not valid TOML: {error}; see {GUIDE} for the format") from error


@functools.lru_cache(maxsize=32)
def _parsed(text: str) -> dict[str, Any]:
    return tomllib.loads(text)


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of an airframe with some numbers changed or added."""
    merged = dict(base)
    for key, new in changes.items():
        old = merged.get(key)
        merged[key] = _merged(old, new) if isinstance(old, Mapping) and isinstance(new, Mapping) else new
    return merged


def _numbers(name: str, node: Any, path: tuple[str, ...]) -> Any:
    if isinstance(node, Mapping) and "value" not in node:
        return {key: _numbers(name, item, (*path, key)) for key, item in node.items()}
    value = node["value"] if isinstance(node, Mapping) else node
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"airframe {name!r}: expected {'.'.join(path)} as a number or array, got {value!r}"
        ) from error
    if not np.all(np.isfinite(array)):
        raise ConfigError(f"airframe {name!r}: expected {'.'.join(path)} to be finite, got {value!r}")
    array.setflags(write=False)
    return array


def _values(tables: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Yield the dotted path and the value of every number."""
    for key, item in tables.items():
        if isinstance(item, Mapping):
            yield from _values(item, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", item


def _remedy(path: str, paths: Iterable[str]) -> str:
    """Return the advice for a value that an airframe lacks: to add it if it exists, else the path that was meant."""
    table, _, key = path.rpartition(".")
    return f"Add {key} to its table [{table}]; {GUIDE} lists all keys." if path in KEYS else suggestion(path, paths)


def _check(airframe: Airframe) -> None:
    """Check that the numbers are those of a drone that can fly."""

    def refuse(problem: str) -> ConfigError:
        return ConfigError(f"airframe {airframe.name!r}: {problem}")

    for table in ("rigid_body", "rotors"):
        airframe.table(table)
    mass = airframe.value("rigid_body.mass", ())
    if mass <= 0:
        raise refuse(f"expected a positive mass, got {mass} kg")
    inertia = airframe.inertia
    if inertia.shape != (3, 3) or not np.allclose(inertia, inertia.T) or np.min(np.linalg.eigvalsh(inertia)) <= 0:
        raise refuse(
            "expected an inertia of three positive moments or a symmetric positive definite 3 x 3 matrix, kg m^2, "
            f"got {inertia.tolist()}"
        )
    position = airframe.value("rotors.position")
    if position.ndim != 2 or position.shape[1] != 3:
        raise refuse(f"expected rotors.position of shape (n, 3), got {position.shape}")
    airframe.value("rotors.yaw_torque_sign", (len(position),))
    low, high = airframe.value("rotors.thrust_min", ()), airframe.value("rotors.thrust_max", ())
    if not 0 <= low < high:
        raise refuse(f"expected 0 <= thrust_min < thrust_max, got {low} N and {high} N")
    for path, value in _values(airframe.tables):
        shapes = _shapes(path, len(position))
        if value.shape not in shapes:
            raise refuse(f"expected {path} of shape {' or '.join(map(str, shapes))}, got {value.shape}")
    if len(position) * high <= mass * 9.81:
        raise refuse(f"expected rotors that lift {mass} kg, got {len(position)} rotors of at most {high} N")


def _shapes(path: str, n_rotors: int) -> list[tuple[int, ...]]:
    """Return the allowed shapes of a number."""
    return [tuple(n_rotors if n == "n" else int(n) for n in shape) for shape in KEYS[path]]
