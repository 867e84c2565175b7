"""Vehicle models: loading the constants of a ground vehicle from a TOML file or a dict, with checks."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, UnknownNameError

FOLDER = Path(__file__).parent
GUIDE = "docs/guides/vehicles.md"
DYNAMICS = ("single_track", "kinematic")
"""Names of the dynamics of vehicles."""

KEYS: dict[str, tuple[int, ...]] = {
    "rigid_body.mass": (),
    "rigid_body.yaw_inertia": (),
    "axles.front": (),
    "axles.rear": (),
    "axles.track": (),
    "axles.kingpin_track": (),
    "wheels.number": (),
    "wheels.mass": (),
    "wheels.radius": (),
    "wheels.width": (),
    "wheels.armature": (),
    "wheels.friction_loss": (),
    "wheels.damping": (),
    "tyres.front": (),
    "tyres.rear": (),
    "tyres.friction": (),
    "drive.torque": (3,),
    "drive.torque_max": (),
    "drive.force": (3,),
    "drive.force_max": (),
    "drive.front_share": (),
    "steering.angle_max": (),
    "steering.rate_max": (),
    "steering.bandwidth": (),
    "trailer.hitch": (),
    "trailer.drawbar": (),
    "trailer.axle_distance": (),
    "trailer.track": (),
    "trailer.wheel_radius": (),
    "trailer.wheel_width": (),
    "trailer.mass": (),
    "trailer.deck": (3,),
    "trailer.deck_centre": (3,),
    "shape.length": (),
    "shape.width": (),
    "shape.height": (),
}
"""Shapes of all numbers, by table and key."""
OPTIONAL = ("tyres.front", "tyres.rear", "drive.", "trailer.")
"""Beginnings of the keys that a vehicle may lack; ``drive`` needs its force or its torque."""
NONNEGATIVE = ("wheels.", "steering.", "axles.track", "axles.kingpin_track", "drive.front_share", "drive.torque_max",
               "drive.force_max")  # fmt: skip
"""Beginnings of the keys that may be zero; of the others, all but the drive's constants are positive."""
TOP_LEVEL = ("name", "base", "model", "sources")


@dataclass(frozen=True, eq=False)
class VehicleModel:
    """Constants of a ground vehicle, as plain numbers in SI units."""

    name: str
    """Name: the key ``name``, or else the file's stem; ``custom`` for a dict without one."""
    dynamics: str
    """Dynamics of the vehicle, one of ``DYNAMICS``."""
    numbers: Mapping[str, NDArray[np.float64]]
    """All numbers by table and key, such as ``rigid_body.mass``."""

    def value(self, key: str) -> NDArray[np.float64]:
        """Return one number or array by its table and key, such as ``rigid_body.mass``.

        Raises:
            ConfigError: If the vehicle has none.
        """
        if key not in self.numbers:
            raise ConfigError(f"vehicle {self.name!r} has no value {key!r}. Add it; {GUIDE} lists all keys.")
        return self.numbers[key]

    def number(self, key: str) -> float:
        """Return one number by its table and key."""
        return float(self.value(key))

    @property
    def has_trailer(self) -> bool:
        """True if the vehicle has the numbers of a trailer."""
        return "trailer.hitch" in self.numbers

    @property
    def wheelbase(self) -> float:
        """Distance of the axles, m."""
        return self.number("axles.front") + self.number("axles.rear")

    def __repr__(self) -> str:
        """Return the name alone; the tables are long."""
        return f"VehicleModel({self.name!r})"


def vehicle_names() -> tuple[str, ...]:
    """Return the names of the built-in vehicle models."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.toml")))


def load_vehicle(source: str | Path | Mapping[str, Any] | VehicleModel) -> VehicleModel:
    """Return the vehicle model of a name, a TOML file anywhere on disk, or a dict of the same tables.

    A number is written plainly, or as ``{ value = ..., unit = "...", source = "..." }`` as in the built-in files. With
    the key ``base``, the name or path of another vehicle, only the numbers that differ from it are given.

    Args:
        source: Name of a built-in vehicle, path of a ``.toml`` file, dict, or a vehicle model (returned as is).

    Raises:
        UnknownNameError: If the source is neither the name of a vehicle nor a file.
        ConfigError: If a table or key does not exist, or the numbers cannot be those of a vehicle.
    """
    if isinstance(source, VehicleModel):
        return source
    name, tables = ("custom", dict(source)) if isinstance(source, Mapping) else _read(source)
    name = str(tables.get("name", name))
    base = load_vehicle(tables["base"]) if "base" in tables else None
    numbers = dict(base.numbers) if base is not None else {}
    own = dict(_numbers(name, {key: table for key, table in tables.items() if key not in TOP_LEVEL}))
    for kind, other in (("torque", "force"), ("force", "torque")):
        if f"drive.{kind}" in own:
            numbers = {key: x for key, x in numbers.items() if not key.startswith(f"drive.{other}")}
    dynamics = tables.get("model", base.dynamics if base is not None else DYNAMICS[0])
    vehicle = VehicleModel(name, dynamics, numbers | own)
    _check(vehicle)
    return vehicle


def _read(source: str | Path) -> tuple[str, dict[str, Any]]:
    """Return the name of a vehicle and its tables."""
    if not isinstance(source, (str, Path)):
        raise ConfigError(f"expected a vehicle as a name, the path of a TOML file, a dict or a VehicleModel, got "
                          f"{source!r}")  # fmt: skip
    path = FOLDER / f"{source}.toml" if str(source) in vehicle_names() else Path(source)
    if not path.is_file():
        raise UnknownNameError(
            f"expected a vehicle as one of {', '.join(vehicle_names())}, the path of a .toml file, or a dict, got "
            f"{str(source)!r}, and no file of that path exists"
        )
    try:
        return path.stem, tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path} is not valid TOML: {error}; see {GUIDE} for the format") from error


def _numbers(name: str, node: Any, prefix: str = "") -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Yield the key and the value of every number, and check that the key exists."""
    for key, item in node.items():
        path = f"{prefix}{key}"
        is_table = isinstance(item, Mapping) and not prefix
        if is_table and any(known.startswith(f"{path}.") for known in KEYS):
            yield from _numbers(name, item, f"{path}.")
            continue
        if path not in KEYS:
            near = get_close_matches(path, KEYS, n=3) or [k for k in KEYS if k.rpartition(".")[2] == key]
            hint = f"Did you mean {' or '.join(map(repr, near))}? " if near else ""
            raise ConfigError(f"vehicle {name!r}: expected a key that exists, got {path!r}. {hint}{GUIDE} lists all.")
        value = item["value"] if isinstance(item, Mapping) and "value" in item else item
        try:
            array = np.array(value, np.float64)
        except (TypeError, ValueError) as error:
            raise ConfigError(f"vehicle {name!r}: expected {path} as a number or array, got {value!r}") from error
        array.setflags(write=False)
        yield path, array


def _check(vehicle: VehicleModel) -> None:
    """Check that the numbers are those of a vehicle that can drive."""
    name, numbers = vehicle.name, vehicle.numbers
    if vehicle.dynamics not in DYNAMICS:
        raise ConfigError(f"vehicle {name!r}: expected model as one of {', '.join(DYNAMICS)}, got {vehicle.dynamics!r}")
    tyres = ("tyres.front", "tyres.rear") if vehicle.dynamics == "single_track" else ()
    trailer = tuple(key for key in KEYS if key.startswith("trailer.")) if vehicle.has_trailer else ()
    needed = [key for key in KEYS if not key.startswith(OPTIONAL)]
    missing = [key for key in (*needed, *tyres, *trailer) if key not in numbers]
    if missing:
        raise ConfigError(
            f"vehicle {name!r}: expected {', '.join(missing)}, which it lacks. Add them, or start from another vehicle "
            f"with base = 'aiml_head'. {GUIDE} lists all keys."
        )
    if ("drive.torque" in numbers) == ("drive.force" in numbers):
        raise ConfigError(f"vehicle {name!r}: expected either drive.torque or drive.force, got both or neither")
    for key, value in numbers.items():
        if value.shape != KEYS[key]:
            raise ConfigError(f"vehicle {name!r}: expected {key} of shape {KEYS[key]}, got {value.shape}")
        if np.any(np.isnan(value)) or (np.any(np.isinf(value)) and not key.endswith("_max")):
            raise ConfigError(f"vehicle {name!r}: expected {key} to be finite, got {value.tolist()}")
        signed = key in ("drive.torque", "drive.force", "trailer.deck_centre")
        low_ok = np.all(value >= 0) if key.startswith(NONNEGATIVE) else np.all(value > 0)
        if not signed and (not low_ok or (key == "wheels.radius" and value == 0)):
            kind = "at least zero" if key.startswith(NONNEGATIVE) and key != "wheels.radius" else "positive"
            raise ConfigError(f"vehicle {name!r}: expected {key} to be {kind}, got {value.tolist()}")
