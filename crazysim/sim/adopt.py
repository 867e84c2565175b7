"""Vehicles of an MJCF file, found by the names of their bodies, such as ``Crazyflie_0`` and ``Fleet1Tenth_1``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple, TypeGuard

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from crazysim.core.airframes import AirframeSource
from crazysim.core.population import Population
from crazysim.errors import ConfigError, UnknownNameError, require
from crazysim.scene.build import read_spec

VehicleKind = AirframeSource | type[Population]
"""Kind of a vehicle: the airframe of a drone, or a subclass of ``Population``."""


def known_kinds() -> dict[str, VehicleKind]:
    """Return the airframes and populations that need no entry in ``kinds``, by the prefix in the names of vehicles."""
    from crazysim.plugins.vehicles import Bicycles, Cars  # imported only when an MJCF file is read

    return {"Crazyflie": "crazyflie", "Bumblebee": "bumblebee", Cars.prefix: Cars, Bicycles.prefix: Bicycles}


VEHICLE_NAME = re.compile(r"([A-Za-z][A-Za-z0-9]*)_(\d+)")
"""Pattern of the name of a vehicle: prefix, underscore and number."""


class Vehicle(NamedTuple):
    """A vehicle found in an MJCF file."""

    name: str
    """Name of its body."""
    kind: VehicleKind
    """Its airframe or population."""
    pos: np.ndarray
    """Position, world frame, m. (3,)"""
    quat: np.ndarray
    """Attitude, body to world, xyzw. (4,)"""


def read_vehicles(
    xml_path: str | Path, kinds: Mapping[str, VehicleKind]
) -> tuple[mujoco.MjSpec, list[Vehicle], dict[type[Population], list[Vehicle]]]:
    """Return three parts of an MJCF file: the spec without vehicles, the drones, and the members of each population.

    Args:
        kinds: Airframes or populations by prefix, in addition to ``known_kinds``.

    Raises:
        ConfigError: If the file cannot be read, or has no drone.
    """
    spec = read_spec(xml_path)
    vehicles = remove_vehicles(spec, known_kinds() | dict(kinds))
    populations: dict[type[Population], list[Vehicle]] = {}
    for vehicle in vehicles:
        if _is_population(vehicle.kind):
            populations.setdefault(vehicle.kind, []).append(vehicle)
    drones = [vehicle for vehicle in vehicles if not _is_population(vehicle.kind)]
    if not drones:
        raise ConfigError(
            f"expected at least one drone in {str(xml_path)!r}, such as a body 'Crazyflie_0' with a free joint, got "
            f"{[v.name for v in vehicles]}"
        )
    return spec, drones, populations


def vehicle_poses(vehicles: list[Vehicle], template: Array) -> tuple[Array, Array]:
    """Return positions, m (n_worlds, n, 3), and attitudes, xyzw (n_worlds, n, 4), of vehicles in all worlds.

    Args:
        template: An array with the type of the results and a first axis over worlds.
    """
    poses = [v.pos for v in vehicles], [v.quat for v in vehicles]
    pos, quat = (jnp.asarray(np.broadcast_to(x, (template.shape[0], *np.shape(x))), template.dtype) for x in poses)
    return pos, quat


def remove_vehicles(spec: mujoco.MjSpec, kinds: Mapping[str, VehicleKind]) -> list[Vehicle]:
    """Return the vehicles of a spec, and remove their bodies from it.

    A vehicle is a child of the world body that can move (a mocap body, or a body with joints). Its name is a prefix, an
    underscore and a number.

    Args:
        spec: The spec, which is changed in place.
        kinds: Airframes or populations by prefix.
    """
    vehicles = []
    for body in spec.worldbody.bodies:
        match = VEHICLE_NAME.fullmatch(body.name)
        if match is None or not (body.mocap or len(body.joints)):
            continue
        prefix = match.group(1)
        require(
            prefix in kinds,
            f"expected a body with one of the prefixes {', '.join(kinds)}, got {body.name!r}. Use "
            f"kinds={{{prefix!r}: ...}} with an airframe or a population, or a body without joints.",
            UnknownNameError,
        )
        vehicles.append((body, Vehicle(body.name, kinds[prefix], np.array(body.pos), np.roll(body.quat, -1))))
    names = [vehicle.name for _, vehicle in vehicles]
    duplicates = [name for name in names if names.count(name) > 1]
    if duplicates:
        raise ConfigError(f"expected bodies with different names, got {duplicates[0]!r} twice. Rename one.")
    for body, _ in vehicles:
        spec.delete(body)
    return [vehicle for _, vehicle in vehicles]


def _is_population(kind: VehicleKind) -> TypeGuard[type[Population]]:
    return isinstance(kind, type) and issubclass(kind, Population)
