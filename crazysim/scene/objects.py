"""Objects that a user adds to the scene, and the handles that they are moved by."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from crazysim.core.data import Objects, SimData
from crazysim.errors import ConfigError, UnknownNameError
from crazysim.pytree import select_worlds

IDENTITY = (0.0, 0.0, 0.0, 1.0)
"""The attitude that turns nothing, xyzw."""
TOUCHED_BY_DRONES = {"contype": 0, "conaffinity": 2}
"""Bits of a geom that drones touch, and nothing else: no object rests on the floor as a contact."""


@dataclasses.dataclass(frozen=True)
class Handle:
    """Objects of one kind in the scene. It stays valid when more are added."""

    name: str
    """Name; the bodies in the scene are called ``name:0``, ``name:1``, ..."""
    numbers: tuple[int, ...]
    """Which of its kind these are."""
    places: tuple[int, ...]
    """Where their poses are in ``data.objects``; empty if they cannot be moved."""

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the bodies."""
        return tuple(f"{self.name}:{k}" for k in self.numbers)

    @property
    def movable(self) -> bool:
        """Whether they have poses of their own in every world."""
        return bool(self.places)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.numbers)

    def __getitem__(self, k: int | slice) -> Handle:
        """Return a handle of some of them."""
        some = (lambda x: x[k]) if isinstance(k, slice) else (lambda x: (x[k],))
        return Handle(self.name, some(self.numbers), some(self.places) if self.movable else ())

    def set_pose(self, data: SimData, pos: Any = None, quat: Any = None, vel: Any = None, mask: Any = None) -> SimData:
        """Return the data with these objects elsewhere. Pure: for use in jit, in rollouts, in stages of one world.

        Args:
            data: The simulation, or in a stage one world of it.
            pos: Where the bodies' frames are, world frame, m; None to leave them. (3,), (n, 3) or (n_worlds, n, 3)
            quat: Their attitudes, body to world, xyzw; normalised here. The same shapes with 4
            vel: How fast they move, world frame, m/s; nothing moves by it, but contacts feel it. As ``pos``; where
                ``pos`` is given and this is not, zero.
            mask: In which worlds; None for all. (n_worlds,)

        Raises:
            ConfigError: If they cannot be moved, belong to another simulation, or a shape or number cannot be.
        """
        objects = self._objects(data)
        if pos is not None and vel is None:
            vel = np.zeros(3)
        new = {
            name: self._written(getattr(objects, name), name, value, mask)
            for name, value in (("pos", pos), ("quat", quat), ("vel", vel))
            if value is not None
        }
        return data.replace(objects=objects.replace(**new))

    def pose(self, data: SimData) -> tuple[Array, Array]:
        """Return where they are, m (n_worlds, n, 3), and their attitudes, xyzw (n_worlds, n, 4)."""
        objects = self._objects(data)
        pos, quat = (x[..., self.places, :] for x in (objects.pos, objects.quat))
        return (pos, quat) if pos.ndim == 2 else (pos[:, 0], quat[:, 0])

    def _objects(self, data: SimData) -> Objects:
        if not self.movable:
            raise ConfigError(f"{self.name!r} was added with mocap=False and stays where it is; add it with mocap=True")
        names = data.objects.names if data.objects is not None else ()
        if tuple(names[k] for k in self.places if k < len(names)) != self.bodies:
            raise ConfigError(
                f"the handle of {self.bodies} is of another simulation; this one's movable objects are "
                f"{names or 'none'}"
            )
        return data.objects  # type: ignore[return-value]

    def _written(self, old: Array, what: str, value: Any, mask: Any) -> Array:
        n, size = len(self), old.shape[-1]
        value = as_poses(value, what, n, size, old.shape[0] if old.ndim == 4 else None).astype(old.dtype)
        if what == "quat":
            value = value * jax.lax.rsqrt(jnp.sum(value**2, axis=-1, keepdims=True))
        value = jnp.broadcast_to(value[:, None] if value.ndim == 3 else value, (*old.shape[:-2], n, size))
        rows = [old[..., k, :] for k in range(old.shape[-2])]
        for i, k in enumerate(self.places):
            rows[k] = value[..., i, :]
        return select_worlds(None if mask is None else jnp.asarray(mask), jnp.stack(rows, axis=-2), old)


def as_poses(value: Any, what: str, n: int, size: int, n_worlds: int | None) -> Array:
    """Return positions, attitudes or velocities of ``n`` objects, checked. (size,), (n, size) or (n_worlds, n, size)

    Raises:
        ConfigError: If it has another shape, or comes from the host and is not finite.
    """
    try:
        shape = np.shape(value)
        host = None if isinstance(value, jax.Array) else np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{what} cannot be {value!r}; needed are numbers") from error
    shapes = [(size,), (n, size)] + ([] if n_worlds is None else [(n_worlds, n, size)])
    if shape not in shapes:
        raise ConfigError(f"{what} has shape {shape}; needed is one of {', '.join(map(str, shapes))}")
    if host is not None and (not np.isfinite(host).all() or (what == "quat" and not host.any(axis=-1).all())):
        raise ConfigError(
            f"{what} is {np.array2string(host, threshold=8)}; needed are finite numbers, not all zero in a quaternion"
        )
    return jnp.asarray(value if host is None else host)


# Primitives: each returns geoms in the frame of its object, as keyword arguments of MuJoCo's add_geom ---------------

Geoms = list[dict[str, Any]]


def gate(width: float = 0.45, height: float = 0.45, bar: float = 0.05, stand: float | None = None) -> Geoms:
    """A frame to fly through along x; its origin is the middle of the opening.

    Args:
        width: Of the opening, along y, m.
        height: Of the opening, along z, m.
        bar: Thickness of the frame, m.
        stand: Height of the origin over the floor, m: the gate then stands on a post; None for a gate in the air.
    """
    y, z, b = width / 2, height / 2, bar / 2
    geoms = [_box((0, side * (y + b), 0), (b, b, z + bar)) for side in (-1, 1)]
    geoms += [_box((0, 0, side * (z + b)), (b, y, b)) for side in (-1, 1)]
    if stand is not None:
        low = stand - z - bar
        if low <= 0:
            raise ConfigError(f"a gate {stand} m over the floor; its lower bar needs {z + bar} m below its middle")
        geoms.append(_box((0, 0, -z - bar - low / 2), (b / 2, b / 2, low / 2)))
    return geoms


def box(size: Any = (0.2, 0.2, 0.2)) -> Geoms:
    """A box around its origin; ``size`` are its full lengths along x, y and z, m."""
    return [_box((0, 0, 0), np.asarray(size, float) / 2)]


def sphere(radius: float = 0.1) -> Geoms:
    """A ball around its origin."""
    return [{"type": "sphere", "size": (radius,)}]


def pole(height: float = 1.6, radius: float = 0.015) -> Geoms:
    """An upright pole with round ends; its origin is its foot."""
    half = height / 2 - radius
    if half <= 0:
        raise ConfigError(f"a pole of height {height} m and radius {radius} m; it must be higher than it is thick")
    return [{"type": "capsule", "size": (radius, half), "pos": (0, 0, height / 2)}]


def wall(length: float = 2.0, height: float = 2.0, thickness: float = 0.05) -> Geoms:
    """A wall across x, along y; its origin is the middle of its foot."""
    return [_box((0, 0, height / 2), (thickness / 2, length / 2, height / 2))]


def landing_pad(radius: float = 0.3, thickness: float = 0.02) -> Geoms:
    """A round plate; its origin is the middle of its upper side."""
    return [{"type": "cylinder", "size": (radius, thickness / 2), "pos": (0, 0, -thickness / 2)}]


def _box(pos: Any, half: Any) -> dict[str, Any]:
    return {"type": "box", "pos": tuple(pos), "size": tuple(half)}


PRIMITIVES: dict[str, tuple[Callable[..., Geoms], tuple[float, ...]]] = {
    "gate": (gate, (0.85, 0.35, 0.10, 1)),
    "box": (box, (0.75, 0.30, 0.25, 1)),
    "pole": (pole, (0.80, 0.25, 0.30, 1)),
    "sphere": (sphere, (0.30, 0.45, 0.75, 1)),
    "wall": (wall, (0.70, 0.70, 0.68, 1)),
    "landing_pad": (landing_pad, (0.25, 0.55, 0.40, 1)),
}
"""What ``add`` knows by name, and its colour, rgba."""


# Into the spec ------------------------------------------------------------------------------------------------------


def add_bodies(
    spec: mujoco.MjSpec, what: Any, names: list[str], pos: np.ndarray, quat: np.ndarray, mocap: bool, options: dict
) -> None:
    """Add bodies of a name each to the scene.

    Args:
        spec: The scene.
        what: Name of a primitive, path of an MJCF file, MJCF text, spec, or body of a spec.
        names: Names of the bodies.
        pos: Where they are, m. (n, 3)
        quat: Their attitudes, xyzw. (n, 4)
        mocap: Whether they can be moved.
        options: Of the primitive.

    Raises:
        ConfigError: If there is no such thing, or it does not compile.
        UnknownNameError: If there is no such primitive.
    """
    place = [{"pos": p, "quat": np.roll(q, 1)} for p, q in zip(pos, quat, strict=True)]
    if isinstance(what, str) and what in PRIMITIVES:
        geoms = _primitive(what, options)
        for name, where in zip(names, place, strict=True):
            body = spec.worldbody.add_body(name=name, mocap=mocap, **where)
            for geom in geoms:
                body.add_geom(**geom)
        return
    if options:
        raise ConfigError(f"{', '.join(options)} : only the primitives {', '.join(PRIMITIVES)} have settings")
    for name, where in zip(names, place, strict=True):
        source = _source(what)
        body = spec.worldbody.add_body(name=name, mocap=mocap, **where)
        frame, prefix = body.add_frame(), f"{name}/"
        if isinstance(source, mujoco.MjSpec):
            spec.attach(source, prefix=prefix, frame=frame)
        else:
            frame.attach_body(source, prefix, "")


def _primitive(what: str, options: dict[str, Any]) -> Geoms:
    make, rgba = PRIMITIVES[what]
    rgba = options.pop("rgba", rgba)
    try:
        geoms = make(**options)
    except TypeError as error:
        raise ConfigError(f"{what!r}: {error}. Its settings: {_settings(make)}") from error
    for geom in geoms:
        if not np.all(np.asarray(geom["size"], float) > 0):
            raise ConfigError(f"{what!r} with {options} has no size; every length must be positive, in m")
        geom["type"] = getattr(mujoco.mjtGeom, f"mjGEOM_{geom['type'].upper()}")
        geom["size"] = (*geom["size"], 0, 0)[:3]
        geom |= {"rgba": rgba, **TOUCHED_BY_DRONES}
    return geoms


def _settings(make: Callable[..., Any]) -> str:
    names = make.__code__.co_varnames[: make.__code__.co_argcount]
    return ", ".join([*(f"{n}={d}" for n, d in zip(names, make.__defaults__ or (), strict=True)), "rgba"])


def _source(what: Any) -> mujoco.MjSpec | mujoco.MjsBody:
    """Return what is to be attached: it is read anew for every body, for attaching may use it up."""
    if isinstance(what, mujoco.MjsBody):
        return what
    try:
        if isinstance(what, mujoco.MjSpec):
            spec = what.copy()
        elif isinstance(what, str) and what.lstrip().startswith("<"):
            spec = mujoco.MjSpec.from_string(what)
        elif isinstance(what, (str, Path)) and Path(what).is_file():
            spec = mujoco.MjSpec.from_file(str(what))
        elif isinstance(what, (str, Path)):
            raise UnknownNameError(
                f"there is no object and no file {str(what)!r}; objects are {', '.join(PRIMITIVES)}, or give an MJCF "
                f"file, MJCF text, an MjSpec or a body of one"
            )
        else:
            raise ConfigError(f"an object cannot be {what!r}; give a name, MJCF file or text, MjSpec or body of one")
        spec.copy().compile()
    except (ValueError, mujoco.FatalError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"the object does not compile: {error}") from error
    return spec
