"""Load an airframe from a TOML file or a dict, and check that it can fly."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, UnknownNameError

FOLDER = Path(__file__).parent


class Drone(StrEnum):
    """Names of the airframes that come with the package."""

    cf21B_500 = "cf21B_500"
    cf2x_L250 = "cf2x_L250"
    cf2x_P250 = "cf2x_P250"
    cf2x_T350 = "cf2x_T350"
    hb_x500 = "hb_x500"
    crazyflie = "crazyflie"
    bumblebee = "bumblebee"


@dataclass(frozen=True, eq=False)
class Airframe:
    """The constants of a drone type, as plain numbers in SI units (rotor speeds in rpm)."""

    name: str
    """Name; of the file, for one that was loaded from a file."""
    tables: Mapping[str, Any]
    """Every table of the file with its numbers as float64 arrays, without unit and source."""

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
                    f"airframe {self.name!r} has no table [{path}]; it has {sorted(self.tables)}. "
                    f"Add [{path}] to its TOML file, or choose another dynamics or command level."
                )
        return node

    def value(self, path: str, shape: tuple[int, ...] | None = None) -> NDArray[np.float64]:
        """Return one number or array by its dotted path, such as ``rigid_body.mass``.

        Args:
            path: Table and key.
            shape: The shape it must have; None accepts any.

        Raises:
            ConfigError: If it is missing or has another shape.
        """
        table, _, key = path.rpartition(".")
        found = self.table(table)
        if key not in found:
            raise ConfigError(f"airframe {self.name!r} lacks {path!r}; [{table}] has {sorted(found)}")
        value = found[key]
        if isinstance(value, Mapping):
            raise ConfigError(f"airframe {self.name!r}: {path} is a table with {sorted(value)}, needed is a number")
        if shape is not None and value.shape != shape:
            raise ConfigError(f"airframe {self.name!r}: {path} has shape {value.shape}, needed is {shape}")
        return value

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
        """Rotor positions and spins as signs and ratios: thrusts to torque. (3, n_rotors)

        A rotor at (x, y) with thrust f gives the torque (y f, -x f), so the rows are y / arm, -x / arm and
        the sign of the torque that its drag puts on the body about z.
        """
        position = self.value("rotors.position")
        sign = self.value("rotors.yaw_torque_sign")
        return np.stack([position[:, 1] / self.arm, -position[:, 0] / self.arm, sign])

    def __repr__(self) -> str:
        """Return the name alone; the tables are long."""
        return f"Airframe({self.name!r})"


def airframe_names() -> tuple[str, ...]:
    """Return the names of the airframes that come with the package."""
    return tuple(drone.value for drone in Drone)


def load_airframe(source: str | Path | Mapping[str, Any] | Airframe) -> Airframe:
    """Return the airframe of a name, a TOML file anywhere on disk, or a dict of the same tables.

    A number is either written plainly, or as ``{ value = ..., unit = "...", source = "..." }`` as the files
    of the package have it.

    Args:
        source: Name of a built-in airframe, path of a ``.toml`` file, dict, or an airframe (returned as is).

    Raises:
        UnknownNameError: If the name is no airframe and no file.
        ConfigError: If the contents cannot be those of a drone.
    """
    if isinstance(source, Airframe):
        return source
    if isinstance(source, Mapping):
        name, tables = str(source.get("name", "custom")), dict(source)
    else:
        name, tables = _read(source)
    tables.pop("sources", None)
    tables.pop("name", None)
    airframe = Airframe(name, _numbers(name, tables, ()))
    _check(airframe)
    return airframe


def _read(source: str | Path) -> tuple[str, dict[str, Any]]:
    if not isinstance(source, (str, Path)):
        raise ConfigError(f"a drone is a name, the path of a TOML file, a dict or an airframe, not {source!r}")
    path = FOLDER / f"{source}.toml" if str(source) in airframe_names() else Path(source)
    if not path.is_file():
        raise UnknownNameError(
            f"unknown drone {str(source)!r}: it is none of {', '.join(airframe_names())}, and no TOML file of "
            f"that path exists. Give one of these names, the path of a .toml file, or a dict."
        )
    try:
        return path.stem, tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from error


def _numbers(name: str, node: Any, path: tuple[str, ...]) -> Any:
    if isinstance(node, Mapping) and "value" not in node:
        return {key: _numbers(name, item, (*path, key)) for key, item in node.items()}
    value = node["value"] if isinstance(node, Mapping) else node
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"airframe {name!r}: {'.'.join(path)} = {value!r} is not a number or array") from error
    if not np.all(np.isfinite(array)):
        raise ConfigError(f"airframe {name!r}: {'.'.join(path)} = {value!r} is not finite")
    array.setflags(write=False)
    return array


def _check(airframe: Airframe) -> None:
    """Refuse what cannot fly, with the number at fault."""
    mass = airframe.value("rigid_body.mass", ())
    if mass <= 0:
        raise ConfigError(f"airframe {airframe.name!r}: mass is {mass} kg, it must be positive")
    inertia = airframe.inertia
    if inertia.shape != (3, 3) or not np.allclose(inertia, inertia.T) or np.min(np.linalg.eigvalsh(inertia)) <= 0:
        raise ConfigError(
            f"airframe {airframe.name!r}: inertia {inertia.tolist()} must be three positive moments "
            f"or a symmetric positive definite 3 x 3 matrix, kg m^2"
        )
    position = airframe.value("rotors.position")
    if position.ndim != 2 or position.shape[1] != 3:
        raise ConfigError(f"airframe {airframe.name!r}: rotors.position has shape {position.shape}, needed is (n, 3)")
    airframe.value("rotors.yaw_torque_sign", (len(position),))
    low, high = airframe.value("rotors.thrust_min", ()), airframe.value("rotors.thrust_max", ())
    if not 0 <= low < high:
        raise ConfigError(
            f"airframe {airframe.name!r}: thrust_min {low} N and thrust_max {high} N must be 0 <= min < max"
        )
    for path, shapes in _optional(airframe, len(position)).items():
        value = airframe.value(path)
        if value.shape not in shapes:
            raise ConfigError(
                f"airframe {airframe.name!r}: {path} has shape {value.shape}, needed is {' or '.join(map(str, shapes))}"
            )
    if len(position) * high <= mass * 9.81:
        raise ConfigError(
            f"airframe {airframe.name!r}: {len(position)} rotors of {high} N at most cannot lift {mass} kg"
        )


def _optional(airframe: Airframe, n_rotors: int) -> dict[str, tuple[tuple[int, ...], ...]]:
    """Return the shapes that numbers may have which only some models need, for those that are there."""
    shapes: dict[str, tuple[tuple[int, ...], ...]] = {
        "rotors.inertia": ((), (n_rotors,)),
        "rotors.thrust_curve": ((3,), (n_rotors, 3)),
        "rotors.torque_curve": ((3,), (n_rotors, 3)),
        "rotors.lag": ((4,), (n_rotors, 4)),
        "drag.coefficients": ((3,), (3, 3)),
    }
    for model in airframe.tables.get("fitted", {}):
        shapes |= {f"fitted.{model}.{key}": ((3,),) for key in ("rpy_coef", "rpy_rates_coef", "cmd_rpy_coef")}
        shapes |= {f"fitted.{model}.{key}": ((),) for key in ("acc_coef", "cmd_f_coef", "thrust_dyn_coef")}
        shapes[f"fitted.{model}.drag_coefficients"] = ((3,), (3, 3))
    return {path: allowed for path, allowed in shapes.items() if _has(airframe.tables, path)}


def _has(tables: Mapping[str, Any], path: str) -> bool:
    first, _, rest = path.partition(".")
    node = tables.get(first) if isinstance(tables, Mapping) else None
    return node is not None and (not rest or _has(node, rest))
