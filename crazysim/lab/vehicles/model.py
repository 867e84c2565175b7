"""Vehicle models: loading the constants of a ground vehicle from a TOML file or a dict, with checks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, short_repr
from crazysim.tables import (
    COORDINATE,
    INERTIA,
    LENGTH,
    LENGTH_OR_ZERO,
    MASS,
    MAX_NUMBER,
    NOT_NEGATIVE,
    NOT_NEGATIVE_OR_INF,
    POSITIVE,
    Key,
    Layout,
    Range,
    check_numbers,
    extend_bases,
    read_source,
)

VEHICLE_FOLDER = Path(__file__).parent
GUIDE = "docs/guides/vehicles.md"
DYNAMICS_NAMES = ("single_track", "kinematic")
"""Names of the dynamics of vehicles."""

_SIZE, _SIZE_OR_ZERO = Key(((),), LENGTH), Key(((),), LENGTH_OR_ZERO)
_POSITIVE, _NOT_NEGATIVE, _UNLIMITED = (Key(((),), limits) for limits in (POSITIVE, NOT_NEGATIVE, NOT_NEGATIVE_OR_INF))
_DRIVE = Key(((3,),), Range("a positive gain, then damping and friction of at least zero", (1 / MAX_NUMBER, 0.0, 0.0)))

KEYS: dict[str, Key] = {
    "rigid_body.mass": Key(((),), MASS),
    "rigid_body.yaw_inertia": Key(((),), INERTIA),
    "axles.front": _SIZE,
    "axles.rear": _SIZE,
    "axles.track": _SIZE_OR_ZERO,
    "axles.kingpin_track": _SIZE_OR_ZERO,
    "wheels.number": Key(((),), Range("from 1 to 100", 1.0, 100.0)),
    "wheels.mass": Key(((),), Range("from 0 to 1e6 kg", 0.0, MASS.high)),
    "wheels.radius": _SIZE,
    "wheels.width": _SIZE_OR_ZERO,
    "wheels.armature": _NOT_NEGATIVE,
    "wheels.friction_loss": _NOT_NEGATIVE,
    "wheels.damping": _NOT_NEGATIVE,
    "tyres.front": _POSITIVE,
    "tyres.rear": _POSITIVE,
    "tyres.friction": _POSITIVE,
    "drive.torque": _DRIVE,
    "drive.torque_max": _UNLIMITED,
    "drive.force": _DRIVE,
    "drive.force_max": _UNLIMITED,
    "drive.front_share": Key(((),), Range("from 0 to 1", 0.0, 1.0)),
    "steering.angle_max": Key(((),), Range("from 0 to 1.5 rad, below a right angle", 0.0, 1.5)),
    "steering.rate_max": _UNLIMITED,
    "steering.bandwidth": _NOT_NEGATIVE,
    "trailer.hitch": _SIZE,
    "trailer.drawbar": _SIZE,
    "trailer.axle_distance": _SIZE,
    "trailer.track": _SIZE,
    "trailer.wheel_radius": _SIZE,
    "trailer.wheel_width": _SIZE,
    "trailer.mass": Key(((),), MASS),
    "trailer.deck": Key(((3,),), LENGTH),
    "trailer.deck_centre": Key(((3,),), COORDINATE),
    "shape.length": _SIZE,
    "shape.width": _SIZE,
    "shape.height": _SIZE,
}
"""Shapes and ranges of all numbers, by table and key."""
OPTIONAL_KEYS = ("tyres.front", "tyres.rear", "drive.", "trailer.")
"""Prefixes of the keys that a vehicle may lack, except that it needs ``drive.force`` or ``drive.torque``.
``CarParams.create`` also needs the limit of the drive and ``drive.front_share``."""
LAYOUT = Layout(KEYS, ("name", "base", "model", "sources"), GUIDE)
"""Keys of vehicles."""


@dataclass(frozen=True, eq=False)
class VehicleModel:
    """Constants of a ground vehicle, as plain numbers in SI units."""

    name: str
    """Name: the key ``name``, or else the file's stem; ``custom`` for a dict without a name."""
    dynamics: str
    """Dynamics of the vehicle, one of ``DYNAMICS_NAMES``."""
    numbers: Mapping[str, NDArray[np.float64]]
    """All numbers by table and key, such as ``rigid_body.mass``."""

    def value(self, key: str) -> NDArray[np.float64]:
        """Return one number or array by its table and key, such as ``rigid_body.mass``."""
        if key not in self.numbers:
            raise ConfigError(f"vehicle {self.name!r} has no value {key!r}. Add it; {GUIDE} lists all keys.")
        return self.numbers[key]

    def number(self, key: str) -> float:
        """Return one number by its table and key."""
        return float(self.value(key))

    @property
    def has_trailer(self) -> bool:
        """Whether the vehicle has the numbers of a trailer."""
        return "trailer.hitch" in self.numbers

    @property
    def wheelbase(self) -> float:
        """Distance of the axles, m."""
        return self.number("axles.front") + self.number("axles.rear")

    def __repr__(self) -> str:
        return f"VehicleModel({self.name!r})"


VehicleSource = str | Path | Mapping[str, Any] | VehicleModel
"""Name of a built-in vehicle, path of a TOML file, dict, or vehicle model."""


def vehicle_names() -> tuple[str, ...]:
    """Return the names of the built-in vehicle models."""
    return tuple(sorted(path.stem for path in VEHICLE_FOLDER.glob("*.toml")))


def load_vehicle(source: VehicleSource) -> VehicleModel:
    """Load the vehicle model of a name, a TOML file anywhere on disk, or a dict of the same tables.

    A number is written plainly, or as ``{ value = ..., unit = "...", source = "..." }`` as in the built-in files. With
    the key ``base``, the name or path of another vehicle, only the numbers that differ from it are given.

    Args:
        source: Name of a built-in vehicle, path of a ``.toml`` file, dict, or a vehicle model (returned as is).

    Raises:
        UnknownNameError: If the source is neither the name of a vehicle nor a file.
    """
    return _load_model(source, ())


def _load_model(source: Any, bases: tuple[str, ...]) -> VehicleModel:
    if isinstance(source, VehicleModel):
        return source
    bases = extend_bases(bases, source)
    stem, origin, tables = read_source(source, "vehicle", "a VehicleModel", VEHICLE_FOLDER, vehicle_names(), GUIDE)
    name = str(tables.get("name", stem))
    base = _load_model(tables["base"], bases) if "base" in tables else None
    numbers = dict(base.numbers) if base is not None else {}
    own_numbers = dict(LAYOUT.numbers(f"vehicle {name!r}{origin}", tables))
    for kind, other in (("torque", "force"), ("force", "torque")):
        if f"drive.{kind}" in own_numbers:
            numbers = {key: x for key, x in numbers.items() if not key.startswith(f"drive.{other}")}
    dynamics = tables.get("model", base.dynamics if base is not None else DYNAMICS_NAMES[0])
    vehicle = VehicleModel(name, dynamics, numbers | own_numbers)
    _check_model(vehicle)
    return vehicle


def _check_model(vehicle: VehicleModel) -> None:
    name, numbers = vehicle.name, vehicle.numbers
    if vehicle.dynamics not in DYNAMICS_NAMES:
        raise ConfigError(
            f"vehicle {name!r}: expected model as one of {', '.join(DYNAMICS_NAMES)}, got "
            f"{short_repr(vehicle.dynamics)}"
        )
    tyres = ("tyres.front", "tyres.rear") if vehicle.dynamics == "single_track" else ()
    trailer = tuple(key for key in KEYS if key.startswith("trailer.")) if vehicle.has_trailer else ()
    required_keys = [key for key in KEYS if not key.startswith(OPTIONAL_KEYS)]
    missing = [key for key in (*required_keys, *tyres, *trailer) if key not in numbers]
    if missing:
        raise ConfigError(
            f"vehicle {name!r}: expected {', '.join(missing)}, which it lacks. Add them, or start from another vehicle "
            f"with base = 'aiml_head'. {GUIDE} lists all keys."
        )
    if ("drive.torque" in numbers) == ("drive.force" in numbers):
        raise ConfigError(f"vehicle {name!r}: expected either drive.torque or drive.force, got both or neither")
    for key, value in numbers.items():
        check_numbers(f"vehicle {name!r}", key, value, KEYS[key])
