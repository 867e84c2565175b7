"""Airframes: loading the constants of a drone type from a TOML file or a dict, with checks."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazysim.drones.checks import check_airframe
from crazysim.drones.keys import GUIDE, KEYS, TABLES, TOP_LEVEL, check_keys, suggestion
from crazysim.errors import ConfigError, UnknownNameError, shown
from crazysim.storage import is_file, read_toml
from crazysim.tables import as_numbers, extended

FOLDER = Path(__file__).parent
BODY = (
    "rigid_body.mass",
    "rigid_body.inertia",
    "rotors.position",
    "rotors.yaw_torque_sign",
    "rotors.thrust_max",
    "rotors.thrust_curve",
)
"""Numbers that gains and fits of an airframe assume."""
TUNED = ("fitted", "controller", "geometric", "mellinger", "pid")
"""Tables of gains and fits."""


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
    not_inherited: str = ""
    """Reason why gains and fits of the base are missing, for messages; empty if all were inherited."""

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
                    f"{self.why_missing(path)}Add [{path}] to the airframe; {GUIDE} lists its keys."
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
        if path not in self.values:
            raise ConfigError(
                f"airframe {self.name!r} has no value {path!r}. {self.why_missing(path)}{_remedy(path, self.values)}"
            )
        value = self.values[path]
        if shape is not None and value.shape != shape:
            raise ConfigError(f"airframe {self.name!r}: expected {path} of shape {shape}, got {value.shape}")
        return value

    def why_missing(self, path: str) -> str:
        """Return why a table or value of the base was not inherited, with a space at the end; empty if it was."""
        return f"{self.not_inherited} " if self.not_inherited and path.partition(".")[0] in TUNED else ""

    @functools.cached_property
    def values(self) -> Mapping[str, NDArray[np.float64]]:
        """All numbers by dotted path, such as ``rigid_body.mass``."""
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
    def rotor_vel_limits(self) -> NDArray[np.float64]:
        """Speeds of the least and the largest thrust of a rotor that is on, rpm. (2, 1 or n_rotors)"""
        k0, k1, k2 = np.atleast_2d(self.value("rotors.thrust_curve")).T
        thrusts = np.array([self.value("rotors.thrust_min", ()), self.value("rotors.thrust_max", ())])[:, None]
        return (-k1 + np.sqrt(k1**2 - 4 * k2 * (k0 - thrusts))) / (2 * k2)

    @property
    def full_thrust_voltage(self) -> float | None:
        """Motor voltage at which a rotor reaches ``rotors.thrust_max``, V; None if ``[battery]`` has no such number."""
        if "battery.thrust_over_voltage" not in self.values:
            return None
        excess = self.value("battery.thrust_over_voltage") - [self.value("rotors.thrust_max"), 0, 0, 0]
        roots = np.polynomial.polynomial.polyroots(excess)
        voltages = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
        return float(np.min(voltages)) if len(voltages) else None

    def __repr__(self) -> str:
        """Return the name alone; the tables are long."""
        return f"Airframe({self.name!r})"


def airframe_names() -> tuple[str, ...]:
    """Return the names of the built-in airframes."""
    return tuple(drone.value for drone in Drone)


def load_airframe(source: str | Path | Mapping[str, Any] | Airframe) -> Airframe:
    """Return the airframe of a name, a TOML file anywhere on disk, or a dict of the same tables.

    A number is written plainly, or as ``{ value = ..., unit = "...", source = "..." }`` as in the built-in files. With
    the key ``base``, the name or path of another airframe, only the numbers that differ from it are given. Another body
    (``BODY``) does not inherit gains and fits (``TUNED``).

    Args:
        source: Name of a built-in airframe, path of a ``.toml`` file, dict, or an airframe (returned as is).

    Raises:
        UnknownNameError: If the source is neither the name of an airframe nor a file.
        ConfigError: If a table or key does not exist, or the numbers cannot be those of a drone.
    """
    return _load(source, ())


def is_airframe_file(source: Any) -> bool:
    """Return True for the path of a file, and False for a name of a built-in airframe or anything else."""
    return isinstance(source, (str, Path)) and str(source) not in airframe_names() and is_file(source)


def _load(source: Any, bases: tuple[str, ...]) -> Airframe:
    """Return the airframe of a source, which is the base of others."""
    if isinstance(source, Airframe):
        return source
    bases = extended(bases, source)
    default_name, origin, tables = ("custom", "", dict(source)) if isinstance(source, Mapping) else _read(source)
    name = str(tables.get("name", default_name))
    check_keys(f"airframe {name!r}{origin}", tables)
    numbers, why = _numbers(name, {key: table for key, table in tables.items() if key not in TOP_LEVEL}), ""
    if tables.get("base") is not None:
        base = _load(tables["base"], bases)
        inherited, why = _inherited(base, dict(_values(numbers)))
        numbers = _merged(inherited, numbers)
    airframe = Airframe(name, numbers, why)
    check_airframe(airframe)
    return airframe


def _read(source: Any) -> tuple[str, str, Mapping[str, Any]]:
    """Return the name of an airframe, its origin for messages, and its tables."""
    if not isinstance(source, (str, Path)):
        raise ConfigError(
            f"expected a drone as a name, the path of a TOML file, a dict or an Airframe, got {shown(source)}"
        )
    if str(source) in airframe_names():
        return str(source), "", _built_in(str(source))
    if not is_file(source):
        raise UnknownNameError(
            f"expected a drone as one of {', '.join(airframe_names())}, the path of a .toml file, or a dict, "
            f"got {shown(str(source))}, and no file of that path exists"
        )
    return Path(source).stem, f" in {source}", read_toml(source, GUIDE)


@functools.cache
def _built_in(name: str) -> Mapping[str, Any]:
    return read_toml(FOLDER / f"{name}.toml", GUIDE)


def _inherited(base: Airframe, changes: Mapping[str, Any]) -> tuple[Mapping[str, Any], str]:
    """Return the tables that an airframe inherits, and why not all of them.

    Args:
        base: The base.
        changes: The airframe's own numbers, by dotted path.
    """
    old = base.values
    changed = [path for path in BODY if path in changes and not np.array_equal(changes[path], old.get(path, np.nan))]
    lost = [table for table in TUNED if table in base.tables]
    if not changed or not lost:
        return base.tables, base.not_inherited
    tables = {key: table for key, table in base.tables.items() if key not in TUNED}
    ratio = old.get("controller.thrust2torque")
    if ratio is not None and not {"rotors.thrust_curve", "rotors.torque_curve"} & set(changes):
        tables["controller"] = {"thrust2torque": ratio}  # of the propellers alone
    names = _listed(f"[{table}]" for table in lost)
    why = f"Its base {base.name!r} has {names}, which fit another {_listed(changed)} and are not inherited."
    return tables, why


def _listed(names: Iterable[str]) -> str:
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of an airframe with some numbers changed or added."""
    merged = dict(base)
    for key, new in changes.items():
        old = merged.get(key)
        merged[key] = _merged(old, new) if isinstance(old, Mapping) and isinstance(new, Mapping) else new
    return merged


def _numbers(name: str, tables: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return tables, checked by ``check_keys``, with their numbers as arrays."""
    found = {}
    for key, item in tables.items():
        path = f"{prefix}{key}"
        if path in TABLES:
            found[key] = _numbers(name, item, f"{path}.")
        else:
            found[key] = as_numbers(f"airframe {name!r}", path, item)
    return found


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
