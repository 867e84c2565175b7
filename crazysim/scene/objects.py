"""Objects that a user adds to the scene, and the handles that move them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, NDArray

from crazysim.arguments import check_flag
from crazysim.core.data import Objects, SimData, require_data
from crazysim.core.settings import as_mask, positive_integer
from crazysim.eager import jit_eager_calls
from crazysim.engine.pytree import device_array, select_worlds
from crazysim.errors import ConfigError, UnknownNameError, expect, require, short_repr
from crazysim.scene.collision import touches_drones
from crazysim.scene.primitives import DRONE_TOUCH_BITS, PRIMITIVES, primitive_geoms

MAX_OBJECTS = 100_000
"""Largest number of objects that can be added at once."""
IDENTITY_QUAT = (0.0, 0.0, 0.0, 1.0)
"""Identity attitude, xyzw."""
Source = str | Path | mujoco.MjSpec | mujoco.MjsBody
"""Name of a primitive, path of an MJCF file, MJCF text, a spec, or a body of a spec."""


@dataclasses.dataclass(frozen=True)
class Handle:
    """Objects of one kind in the scene. A handle stays valid when more objects are added."""

    name: str
    """Prefix of the bodies' names ``name:0``, ``name:1``, ..."""
    numbers: tuple[int, ...]
    """Indices of these objects within their kind."""
    rows: tuple[int, ...]
    """Rows of these objects in ``data.objects``; empty if they cannot be moved."""

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the bodies."""
        return tuple(f"{self.name}:{k}" for k in self.numbers)

    @property
    def movable(self) -> bool:
        """Whether the objects can be moved, independently in each world."""
        return bool(self.rows)

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, k: int | slice) -> Handle:
        n = len(self)
        if not isinstance(k, slice) and (not isinstance(k, (int, np.integer)) or not -n <= k < n):
            raise IndexError(f"expected an index from 0 to {n - 1} or a slice, got {short_repr(k)}, of {self.name!r}")
        select = (lambda x: x[k]) if isinstance(k, slice) else (lambda x: (x[k],))
        return Handle(self.name, select(self.numbers), select(self.rows) if self.movable else ())

    def set_pose(
        self,
        data: SimData,
        pos: ArrayLike | None = None,
        quat: ArrayLike | None = None,
        vel: ArrayLike | None = None,
        mask: ArrayLike | None = None,
    ) -> SimData:
        """Return the data with these objects moved; works in ``jax.jit``, rollouts, and stages of one world.

        Args:
            data: Simulation, or one world of it in a stage.
            pos: Positions of the bodies' frames, world frame, m. None keeps the positions. (3,), (n, 3) or (n_worlds,
                n, 3)
            quat: Attitudes, body to world, xyzw; they are normalised. None keeps the attitudes. (4,), (n, 4) or
                (n_worlds, n, 4)
            vel: Velocities for contact response and blur, world frame, m/s; they do not move the objects. None sets
                them to zero if ``pos`` is passed, and keeps them otherwise. Shapes as ``pos``
            mask: True in the worlds to change; None for all. (n_worlds,)
        """
        objects = self._objects(data)
        mask = as_mask(mask, objects.pos.shape[:-3])
        if pos is not None and vel is None:
            vel = np.zeros(3)
        new_arrays = {
            name: self._replace_checked_rows(getattr(objects, name), name, value, mask)
            for name, value in (("pos", pos), ("quat", quat), ("vel", vel))
            if value is not None
        }
        return data.replace(objects=objects.replace(**new_arrays))

    def pose(self, data: SimData) -> tuple[Array, Array]:
        """Return positions, m (n_worlds, n, 3), and attitudes, xyzw (n_worlds, n, 4); without n_worlds in a stage."""
        objects = self._objects(data)
        return _select_rows(objects.pos, self.rows), _select_rows(objects.quat, self.rows)

    def _objects(self, data: SimData) -> Objects:
        require_data(data)
        require(self.movable, f"expected objects added with mocap=True, got {self.name!r}, which cannot be moved")
        names = data.objects.names if data.objects is not None else ()
        if tuple(names[k] for k in self.rows if k < len(names)) != self.bodies:
            raise ConfigError(
                f"expected a handle of this simulation, whose movable objects are {names or 'none'}, got one of "
                f"{self.bodies}"
            )
        return data.objects  # type: ignore[return-value]

    def _replace_checked_rows(self, old: Array, field: str, value: ArrayLike, mask: Array | None) -> Array:
        value = require_pose_array(value, field, len(self), old.shape[-1], old.shape[0] if old.ndim == 4 else None)
        return _replace_rows(old, value, mask, self.rows, field == "quat")


@jit_eager_calls("row_indices", "is_quat")
def _replace_rows(
    old: Array, value: Array | NDArray, mask: Array | None, row_indices: tuple[int, ...], is_quat: bool
) -> Array:
    # Arrays are (n_worlds, 1, n_objects, k) for all worlds, or (n_objects, k) for one world.
    n, size = len(row_indices), old.shape[-1]
    value = jnp.asarray(value, old.dtype)
    if is_quat:
        value = value * jax.lax.rsqrt(jnp.sum(value**2, axis=-1, keepdims=True))
    value = jnp.broadcast_to(value[:, None] if value.ndim == 3 else value, (*old.shape[:-2], n, size))
    start, end = row_indices[0], row_indices[0] + n
    if row_indices == tuple(range(start, end)):  # compile time does not grow with the number of objects
        replaced = jnp.concatenate([old[..., :start, :], value, old[..., end:, :]], axis=-2)
    else:
        rows = [old[..., k, :] for k in range(old.shape[-2])]
        for i, k in enumerate(row_indices):
            rows[k] = value[..., i, :]
        replaced = jnp.stack(rows, axis=-2)
    return select_worlds(mask, replaced, old)


@jit_eager_calls("row_indices")
def _select_rows(poses: Array, row_indices: tuple[int, ...]) -> Array:
    return (poses if poses.ndim == 2 else poses[:, 0])[..., np.array(row_indices), :]


def require_pose_array(value: ArrayLike, field: str, n: int, size: int, n_worlds: int | None) -> Array | np.ndarray:
    """Return positions, attitudes or velocities of ``n`` objects after a check of their shape and values."""
    try:
        array = value if isinstance(value, jax.Array) else np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"expected numbers for {field}, got {value!r}") from error
    shapes = [(size,), (n, size)] + ([] if n_worlds is None else [(n_worlds, n, size)])
    require(array.shape in shapes, f"expected {field} of shape {' or '.join(map(str, shapes))}, got {array.shape}")
    is_on_host = isinstance(array, np.ndarray)
    if is_on_host and (not np.isfinite(array).all() or (field == "quat" and not array.any(axis=-1).all())):
        raise ConfigError(
            f"expected finite numbers for {field}, not all zero in a quaternion, got "
            f"{np.array2string(array, threshold=8)}"
        )
    return array


class SceneSnapshot(NamedTuple):
    """Contents of a scene, which ``restore_snapshot`` restores."""

    names: list[set[str]]
    """Names of the elements of the spec, in the order of ``_elements``."""
    handles: list[Handle]
    """Handles of all objects."""
    initial_poses: list[tuple[NDArray, NDArray]]
    """Initial positions, m, and attitudes, xyzw, of the objects of each movable handle. (n_worlds, n, ...) each"""


class SceneObjects:
    """The objects that were added to a scene."""

    def __init__(self, n_worlds: int):
        self._n_worlds = n_worlds
        self._handles: list[Handle] = []
        self._initial_poses: list[tuple[NDArray, NDArray]] = []
        self.maps: tuple[str, ...] = ()
        """Names of the bodies of maps, of which each world has one."""

    @property
    def movable(self) -> tuple[str, ...]:
        """Names of the bodies that can be moved, in the order of ``data.objects``."""
        return tuple(body for handle in self._handles if handle.movable for body in handle.bodies)

    def add(
        self,
        spec: mujoco.MjSpec,
        source: Source | list[Source],
        name: str | None,
        count: int,
        pos: ArrayLike,
        quat: ArrayLike,
        mocap: bool,
        options: dict[str, Any],
    ) -> Handle:
        """Add bodies to a spec, and return their handle; see ``Scene.add``."""
        name = _default_name(source) if name is None else name
        expect(isinstance(name, str) and name, "a non-empty string as name of an object", name)
        numbers = tuple(range(positive_integer("count", count, MAX_OBJECTS)))
        names = [f"{name}:{k}" for k in numbers]
        used_names = sorted({*self.movable, *(body.name for body in spec.bodies)} & {name, *names})
        if used_names or name == "drone":
            raise ConfigError(
                f"expected a new name, got {(used_names or ['drone:0'])[0]!r}, a body of the scene. Pass name=."
            )
        n_worlds = self._n_worlds if check_flag("mocap", mocap) else None
        poses = [
            np.broadcast_to(
                np.asarray(require_pose_array(x, field, count, size, n_worlds)), (n_worlds or 1, count, size)
            )
            for x, field, size in ((pos, "pos", 3), (quat, "quat", 4))
        ]
        poses[1] = poses[1] / np.linalg.norm(poses[1], axis=-1, keepdims=True)
        add_bodies(spec, source, names, poses[0][0], poses[1][0], mocap, options)
        first = len(self.movable)
        handle = Handle(name, numbers, tuple(first + k for k in numbers) if mocap else ())
        self._handles.append(handle)
        if mocap:
            self._initial_poses.append((poses[0], poses[1]))
        return handle

    def add_maps(self, spec: mujoco.MjSpec, sources: Sequence[Source], name: str) -> None:
        """Add maps to a spec, of which each world has one; see ``Maps``."""
        origin = (0.0, 0.0, 0.0)
        handle = self.add(spec, list(sources), name, len(sources), origin, IDENTITY_QUAT, False, {})
        for body in (spec.body(x) for x in handle.bodies):
            body.mocap = True
            require(
                not body.find_all("light"),
                f"expected maps without lights, which would shine in all worlds, got one in {body.name!r}. Use "
                f"Sim(xml_path=...) for lights.",
            )
            for geom in body.find_all("geom"):
                # MJX would check all pairs of geoms of two maps.
                bits = DRONE_TOUCH_BITS if touches_drones(geom.contype, geom.conaffinity) else {"conaffinity": 0}
                geom.contype, geom.conaffinity = 0, bits["conaffinity"]
        self.maps = handle.bodies

    def repeated(self, n: int) -> SceneObjects:
        """Return the same objects with each world ``n`` times."""
        objects = SceneObjects(n * self._n_worlds)
        objects._handles, objects.maps = self._handles[:], self.maps
        objects._initial_poses = [
            (np.repeat(pos, n, axis=0), np.repeat(quat, n, axis=0)) for pos, quat in self._initial_poses
        ]
        return objects

    def count_objects(self, name: str) -> int:
        """Return the number of added objects of a kind, by its name as in ``Handle.name``; 0 if there are none."""
        return sum(len(handle) for handle in self._handles if handle.name == name)

    def take_snapshot(self, spec: mujoco.MjSpec) -> SceneSnapshot:
        """Return the present contents of a spec, for ``restore_snapshot``."""
        return SceneSnapshot(
            [{x.name for x in elements} for elements in _elements(spec)], self._handles[:], self._initial_poses[:]
        )

    def restore_snapshot(self, spec: mujoco.MjSpec, snapshot: SceneSnapshot) -> bool:
        """Remove all additions to a spec since a snapshot; return True if there were any."""
        pairs = zip(_elements(spec), snapshot.names, strict=True)
        added = [x for elements, names in pairs for x in elements if x.name not in names]
        for element in added:
            spec.delete(element)
        self._handles, self._initial_poses = snapshot.handles, snapshot.initial_poses
        self.maps = (
            self.maps if any(body in handle.bodies for handle in self._handles for body in self.maps[:1]) else ()
        )
        return bool(added)

    def build_record(self, previous: Objects | None, mocap_ids: list[int], map_ids: list[int]) -> Objects | None:
        """Return the record of the movable objects: poses of an earlier record, and initial poses of other objects.

        Args:
            previous: Earlier record, or None.
            mocap_ids: Mocap ids of the bodies, in the order of ``movable``.
            map_ids: Mocap ids of the maps.
        """
        if not self._initial_poses and not map_ids:
            return None
        names, no_poses = self.movable, tuple(np.zeros((self._n_worlds, 0, n)) for n in (3, 4))
        initial_poses = zip(no_poses, *self._initial_poses, strict=True)
        pos, quat = (np.concatenate(xs, axis=1)[:, None] for xs in initial_poses)
        poses = [pos, quat, np.zeros_like(pos)]
        if previous is not None:
            old_rows = {name: k for k, name in enumerate(previous.names)}
            rows = [k for k, name in enumerate(names) if name in old_rows]
            kept_rows = [old_rows[names[k]] for k in rows]
            for new, old in zip(poses, (previous.pos, previous.quat, previous.vel), strict=True):
                new[..., rows, :] = np.asarray(old)[..., kept_rows, :]
        pos, quat, vel = (device_array(x) for x in poses)
        objects = Objects(pos, quat, vel, device_array(mocap_ids, np.int32), names)
        if not map_ids:
            return objects
        map_index = None if previous is None else previous.map_index
        if map_index is None:
            map_index = device_array(np.zeros((self._n_worlds, 1)), np.int32)
        return objects.replace(map_index=map_index, map_ids=device_array(map_ids, np.int32))


def _elements(spec: mujoco.MjSpec) -> tuple[Sequence[Any], ...]:
    return spec.worldbody.bodies, spec.materials, spec.textures, spec.meshes, spec.hfields


def add_bodies(
    spec: mujoco.MjSpec,
    source: Source | list[Source],
    names: list[str],
    pos: np.ndarray,
    quat: np.ndarray,
    mocap: bool,
    options: dict,
) -> None:
    """Add bodies to a spec.

    Args:
        source: Name of a primitive, path of an MJCF file, MJCF text, spec, or body of a spec; or a list with one of
            these for each body, except primitives.
        pos: Positions, m. (n, 3)
        quat: Attitudes, xyzw. (n, 4)
        mocap: Whether the bodies can be moved.
        options: Settings of the primitive.
    """
    poses = [{"pos": p, "quat": np.roll(q, 1)} for p, q in zip(pos, quat, strict=True)]
    if isinstance(source, str) and source in PRIMITIVES:
        objects = primitive_geoms(source, options, len(names))
        for name, pose, geoms in zip(names, poses, objects, strict=True):
            body = spec.worldbody.add_body(name=name, mocap=mocap, **pose)
            for geom in geoms:
                body.add_geom(**geom)
        return
    require(not options, f"expected no settings, which only {', '.join(PRIMITIVES)} have, got {', '.join(options)}")
    for k, (name, pose) in enumerate(zip(names, poses, strict=True)):
        body_source = _load_source(source[k] if isinstance(source, list) else source)
        body = spec.worldbody.add_body(name=name, mocap=mocap, **pose)
        frame, prefix = body.add_frame(), f"{name}/"
        if isinstance(body_source, mujoco.MjSpec):
            spec.attach(body_source, prefix=prefix, frame=frame)
        else:
            frame.attach_body(body_source, prefix, "")


def _load_source(source: Source) -> mujoco.MjSpec | mujoco.MjsBody:
    if isinstance(source, mujoco.MjsBody):
        return source
    kinds = f"{', '.join(PRIMITIVES)}, an MJCF file, MJCF text, an MjSpec or a body of one"
    try:
        if isinstance(source, mujoco.MjSpec):
            spec = source.copy()
        elif isinstance(source, str) and source.lstrip().startswith("<"):
            spec = mujoco.MjSpec.from_string(source)
        elif isinstance(source, (str, Path)) and Path(source).is_file():
            spec = mujoco.MjSpec.from_file(str(source))
        elif isinstance(source, (str, Path)):
            raise UnknownNameError(f"expected {kinds}, got {str(source)!r}")
        else:
            raise ConfigError(f"expected {kinds}, got {source!r}")
        spec.copy().compile()
    except (ValueError, mujoco.FatalError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"expected an object that compiles, got: {error}") from error
    return spec


def _default_name(source: Source | list[Source]) -> str:
    if isinstance(source, mujoco.MjsBody):
        return source.name or "object"
    if isinstance(source, mujoco.MjSpec):
        return source.modelname or "object"
    return (
        Path(source).stem if isinstance(source, Path) or (isinstance(source, str) and "<" not in source) else "object"
    )
