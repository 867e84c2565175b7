"""Primitive objects: a gate, a box, a sphere, a pole, a cylinder, a wall, a landing pad. All lengths are in metres."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from crazysim.core.settings import as_rgba
from crazysim.errors import ConfigError, require
from crazysim.tables import LENGTH, range_between, read_numbers

DRONE_TOUCH_BITS = {"contype": 0, "conaffinity": 2}
"""Collision bits of geoms that touch only drones, so that no object touches the floor on which it stands."""

Geoms = list[dict[str, Any]]
"""Geoms in the frame of an object, as keyword arguments of MuJoCo's ``add_geom``."""


def gate(width: float = 0.45, height: float = 0.45, bar: float = 0.05, stand: float | None = None) -> Geoms:
    """Return a frame to fly through along x, with its origin in the middle of the opening.

    Args:
        width: Width of the opening, along y, m.
        height: Height of the opening, along z, m.
        bar: Thickness of the frame, m.
        stand: Height of the origin above the floor for a gate on a post, m; None for a gate without a post.
    """
    y, z, b = width / 2, height / 2, bar / 2
    geoms = [_box((0, side * (y + b), 0), (b, b, z + bar)) for side in (-1, 1)]
    geoms += [_box((0, 0, side * (z + b)), (b, y, b)) for side in (-1, 1)]
    if stand is not None:
        post = stand - z - bar
        if post <= 0:
            raise ConfigError(
                f"expected stand above {z + bar} m, the reach of the gate below its middle, got {stand} m. Use "
                f"stand=None for a gate without a post."
            )
        geoms.append(_box((0, 0, -z - bar - post / 2), (b / 2, b / 2, post / 2)))
    return geoms


def box(size: ArrayLike = (0.2, 0.2, 0.2)) -> Geoms:
    """Return a box around its origin, with full lengths ``size`` along x, y and z, m."""
    return [_box((0, 0, 0), np.asarray(size, float) / 2)]


def sphere(radius: float = 0.1) -> Geoms:
    """Return a ball around its origin."""
    return [{"type": "sphere", "size": (radius,)}]


def pole(height: float = 1.6, radius: float = 0.015) -> Geoms:
    """Return an upright pole with round ends, with its origin at its foot."""
    half = height / 2 - radius
    require(half > 0, f"expected a pole higher than it is thick, got height {height} m and radius {radius} m")
    return [{"type": "capsule", "size": (radius, half), "pos": (0, 0, height / 2)}]


def cylinder(height: float = 1.6, radius: float = 0.1) -> Geoms:
    """Return an upright cylinder, with its origin in the middle of its foot."""
    return [{"type": "cylinder", "size": (radius, height / 2), "pos": (0, 0, height / 2)}]


def wall(length: float = 2.0, height: float = 2.0, thickness: float = 0.05) -> Geoms:
    """Return a wall along y, with its origin in the middle of its foot."""
    return [_box((0, 0, height / 2), (thickness / 2, length / 2, height / 2))]


def landing_pad(radius: float = 0.3, thickness: float = 0.02) -> Geoms:
    """Return a round plate, with its origin in the middle of its upper side."""
    return [{"type": "cylinder", "size": (radius, thickness / 2), "pos": (0, 0, -thickness / 2)}]


def _box(pos: Sequence[float], half: ArrayLike) -> dict[str, Any]:
    return {"type": "box", "pos": tuple(pos), "size": tuple(np.asarray(half).tolist())}


PRIMITIVES: dict[str, tuple[Callable[..., Geoms], tuple[float, ...]]] = {
    "gate": (gate, (0.85, 0.35, 0.10, 1)),
    "box": (box, (0.75, 0.30, 0.25, 1)),
    "pole": (pole, (0.80, 0.25, 0.30, 1)),
    "cylinder": (cylinder, (0.45, 0.32, 0.22, 1)),
    "sphere": (sphere, (0.30, 0.45, 0.75, 1)),
    "wall": (wall, (0.70, 0.70, 0.68, 1)),
    "landing_pad": (landing_pad, (0.25, 0.55, 0.40, 1)),
}
"""Function and default colour, RGBA, of each primitive."""


def primitive_geoms(name: str, options: dict[str, Any], count: int) -> list[Geoms]:
    """Return the geoms of some objects of a primitive, complete for ``add_geom``.

    Args:
        name: Key of ``PRIMITIVES``.
        options: Arguments of the function of the primitive, and ``rgba``, one colour or one for each object.
    """
    make, rgba = PRIMITIVES[name]
    settings = {"rgba": rgba} | options
    colors = np.broadcast_to(as_rgba(settings.pop("rgba"), count), (count, 4))
    parameters = inspect.signature(make).parameters
    all_settings = ", ".join([*(f"{p.name}={p.default}" for p in parameters.values()), "rgba"])
    for key in settings.keys() & parameters.keys():
        if settings[key] is None and parameters[key].default is None:
            continue
        shape, remedy = np.shape(parameters[key].default or 0.0), f"Settings of {name!r} are {all_settings}."
        settings[key] = read_numbers(
            f"{key} of {name!r}", settings[key], range_between(positive=True), (shape,), remedy=remedy
        ).tolist()
    try:
        geoms = make(**settings)
    except TypeError as error:
        raise ConfigError(f"expected settings {all_settings} of {name!r}, got: {error}") from error
    for geom in geoms:
        lengths = np.asarray(geom["size"], float)
        require(
            np.all((lengths > 0) & (lengths <= LENGTH.high)),
            f"expected positive lengths of {name!r}, in m, up to {LENGTH.high:g}, got {settings}",
        )
        geom["type"] = getattr(mujoco.mjtGeom, f"mjGEOM_{geom['type'].upper()}")
        geom["size"] = (*geom["size"], 0, 0)[:3]
        geom |= DRONE_TOUCH_BITS
    return [[geom | {"rgba": rgba} for geom in geoms] for rgba in colors]
