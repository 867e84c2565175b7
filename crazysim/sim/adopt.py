"""Simulations of the vehicles of an MJCF, by the names of their bodies: ``Crazyflie_0``, ``Fleet1Tenth_1``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeGuard

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from crazysim.core.airframes import AirframeSource
from crazysim.core.population import Population
from crazysim.errors import ConfigError, UnknownNameError
from crazysim.scene.build import read_spec

if TYPE_CHECKING:
    from crazysim.sim.sim import Sim

Kind = AirframeSource | type[Population]
"""An airframe, or a subclass of ``Population``."""


def known_kinds() -> dict[str, Kind]:
    """Return the built-in airframes and populations by the prefix of names."""
    from crazysim.plugins.vehicles import Bicycles, Cars  # imported where a file is adopted

    return {"Crazyflie": "crazyflie", "Bumblebee": "bumblebee", Cars.prefix: Cars, Bicycles.prefix: Bicycles}


NAME = re.compile(r"([A-Za-z][A-Za-z0-9]*)_(\d+)")
"""Names of vehicles: prefix and number."""


class Vehicle(NamedTuple):
    """A vehicle that was found in an MJCF."""

    name: str
    """Name of its body."""
    kind: Kind
    """Its airframe or population."""
    pos: np.ndarray
    """Position, world frame, m. (3,)"""
    quat: np.ndarray
    """Attitude, body to world, xyzw. (4,)"""


def adopt(
    kind_of_sim: type[Sim],
    xml_path: str | Path,
    n_worlds: int,
    kinds: Mapping[str, Kind] | None,
    settings: dict[str, Any],
) -> Sim:
    """Return a simulation with the vehicles of an MJCF; see ``Sim.from_mjcf``."""
    spec = read_spec(xml_path)
    vehicles = take_vehicles(spec, known_kinds() | dict(kinds or {}))
    drones = [v for v in vehicles if not _is_population(v.kind)]
    if not drones:
        raise ConfigError(
            f"expected at least one drone in {str(xml_path)!r}, such as a body 'Crazyflie_0' with a free joint, got "
            f"{[v.name for v in vehicles]}"
        )
    sim = kind_of_sim(n_worlds, len(drones), [v.kind for v in drones], xml_path=spec, **settings)  # type: ignore[arg-type]
    sim.drone_names = tuple([v.name for v in drones])
    states = sim.data.states
    pos, quat = (_in_worlds([getattr(v, name) for v in drones], n_worlds, states.pos.dtype) for name in ("pos", "quat"))
    sim.data = sim.data.replace(states=states.replace(pos=pos, quat=quat))
    for kind in dict.fromkeys(v.kind for v in vehicles if _is_population(v.kind)):
        members = [v for v in vehicles if v.kind is kind]
        plugin = sim.add(kind([v.name for v in members]))
        poses = [
            _in_worlds([getattr(v, name) for v in members], n_worlds, states.pos.dtype) for name in ("pos", "quat")
        ]
        sim.data = plugin.write(sim.data, plugin.with_poses(plugin.read(sim.data), *poses))
    sim.build_default_data()
    return sim


def take_vehicles(spec: mujoco.MjSpec, kinds: Mapping[str, Kind]) -> list[Vehicle]:
    """Return the vehicles of a spec, and remove their bodies from it.

    Vehicles are children of the world that can move and whose names are a prefix and a number.

    Args:
        spec: The spec.
        kinds: Airframe or population by prefix.

    Raises:
        UnknownNameError: If a prefix is unknown, with those that are known.
        ConfigError: If two bodies have the same name.
    """
    found = []
    for body in spec.worldbody.bodies:
        match = NAME.fullmatch(body.name)
        if match is None or not (body.mocap or len(body.joints)):
            continue
        prefix = match.group(1)
        if prefix not in kinds:
            raise UnknownNameError(
                f"expected a body with one of the prefixes {', '.join(kinds)}, got {body.name!r}. Use "
                f"kinds={{{prefix!r}: ...}} with an airframe or a population, or a body without joints."
            )
        found.append((body, Vehicle(body.name, kinds[prefix], np.array(body.pos), np.roll(body.quat, -1))))
    names = [vehicle.name for _, vehicle in found]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ConfigError(f"expected bodies with different names, got {twice[0]!r} twice. Rename one.")
    for body, _ in found:
        spec.delete(body)
    return [vehicle for _, vehicle in found]


def _is_population(kind: Kind) -> TypeGuard[type[Population]]:
    return isinstance(kind, type) and issubclass(kind, Population)


def _in_worlds(rows: list[np.ndarray], n_worlds: int, dtype: DTypeLike) -> Array:
    return jnp.asarray(np.broadcast_to(rows, (n_worlds, *np.shape(rows))), dtype)
