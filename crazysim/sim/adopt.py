"""Simulations of the vehicles of an MJCF, by the names of their bodies: ``Crazyflie_0``, ``Fleet1Tenth_1``."""

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
from crazysim.errors import ConfigError, UnknownNameError
from crazysim.scene.build import read_spec

VehicleKind = AirframeSource | type[Population]
"""An airframe, or a subclass of ``Population``."""


def known_kinds() -> dict[str, VehicleKind]:
    """Return the built-in airframes and populations by the prefix of names."""
    from crazysim.plugins.vehicles import Bicycles, Cars  # imported where a file is adopted

    return {"Crazyflie": "crazyflie", "Bumblebee": "bumblebee", Cars.prefix: Cars, Bicycles.prefix: Bicycles}


VEHICLE_NAME = re.compile(r"([A-Za-z][A-Za-z0-9]*)_(\d+)")
"""Names of vehicles: prefix and number."""


class Vehicle(NamedTuple):
    """A vehicle that was found in an MJCF."""

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
    """Return the spec of an MJCF without its vehicles, its drones, and the members of each population.

    Args:
        xml_path: MJCF file.
        kinds: Airframe or population by further prefixes, besides ``known_kinds``.

    Raises:
        ConfigError: If the file cannot be read, or has no drone.
    """
    spec = read_spec(xml_path)
    vehicles = take_vehicles(spec, known_kinds() | dict(kinds))
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
        vehicles: The vehicles.
        template: An array of worlds, in whose type they are.
    """
    rows = [v.pos for v in vehicles], [v.quat for v in vehicles]
    pos, quat = (jnp.asarray(np.broadcast_to(x, (template.shape[0], *np.shape(x))), template.dtype) for x in rows)
    return pos, quat


def take_vehicles(spec: mujoco.MjSpec, kinds: Mapping[str, VehicleKind]) -> list[Vehicle]:
    """Return the vehicles of a spec, and remove their bodies from it.

    Vehicles are children of the world that can move and whose names are a prefix and a number.

    Args:
        spec: The spec.
        kinds: Airframe or population by prefix.
    """
    vehicles = []
    for body in spec.worldbody.bodies:
        match = VEHICLE_NAME.fullmatch(body.name)
        if match is None or not (body.mocap or len(body.joints)):
            continue
        prefix = match.group(1)
        if prefix not in kinds:
            raise UnknownNameError(
                f"expected a body with one of the prefixes {', '.join(kinds)}, got {body.name!r}. Use "
                f"kinds={{{prefix!r}: ...}} with an airframe or a population, or a body without joints."
            )
        vehicles.append((body, Vehicle(body.name, kinds[prefix], np.array(body.pos), np.roll(body.quat, -1))))
    names = [vehicle.name for _, vehicle in vehicles]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ConfigError(f"expected bodies with different names, got {twice[0]!r} twice. Rename one.")
    for body, _ in vehicles:
        spec.delete(body)
    return [vehicle for _, vehicle in vehicles]


def _is_population(kind: VehicleKind) -> TypeGuard[type[Population]]:
    return isinstance(kind, type) and issubclass(kind, Population)
