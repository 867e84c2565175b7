"""Records of a simulation: states, time and sizes, objects, and its complete data."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.arguments import require_memory, tree_bytes
from crazysim.control import Control, Controller, command_size
from crazysim.core.airframes import Airframes, as_airframes, create_per_drone, max_n_rotors
from crazysim.core.controls import SimControls
from crazysim.drones import Airframe
from crazysim.dynamics import Dynamics, first_principles, fitted
from crazysim.engine.pytree import (
    Members,
    PyTree,
    check_axes,
    float_dtype,
    has_members,
    host_array,
    leaf,
    leaf_indices,
    n_batch_axes,
    scopes,
    static,
    watched_flags,
)
from crazysim.engine.record import Record, Roles, require_arrays
from crazysim.errors import ConfigError, short_repr

SimParams = first_principles.Params | fitted.Params
"""Parameters of a dynamics model."""

_UNWATCHED = "unwatched"
"""Mark of leaves that are not watched."""


class SimState(PyTree):
    """Rigid-body and rotor state of every drone, and the external wrench on it."""

    pos: Array = leaf("drone", 1)
    """Position of the centre of mass, world frame, m. (n_worlds, n_drones, 3)"""
    quat: Array = leaf("drone", 1)
    """Attitude, body to world, unit, xyzw. (n_worlds, n_drones, 4)"""
    vel: Array = leaf("drone", 1)
    """Velocity of the centre of mass, world frame, m/s. (n_worlds, n_drones, 3)"""
    ang_vel: Array = leaf("drone", 1)
    """Angular velocity, body frame, rad/s. (n_worlds, n_drones, 3)"""
    force: Array = leaf("drone", 1)
    """External force on the centre of mass, world frame, N; kept until it is changed. (n_worlds, n_drones, 3)"""
    torque: Array = leaf("drone", 1)
    """External torque, world frame, N m; kept until it is changed. (n_worlds, n_drones, 3)"""
    rotor_vel: Array = leaf("drone", 1)
    """Rotor speeds, rpm; in ``so_rpy_rotor*`` the collective thrust, N. (n_worlds, n_drones, n_rotors)"""

    @staticmethod
    def create(n_worlds: int, n_drones: int, n_rotors: int = 4) -> SimState:
        """Return the state of drones at rest on the floor, level, on a grid with a spacing of 1 m around the origin."""
        shape = (n_worlds, n_drones)
        grid = np.zeros((n_drones, 3))
        grid[:, :2] = grid_2d(n_drones)
        return SimState(
            pos=host_array(grid, *shape, 3),
            quat=host_array([0.0, 0.0, 0.0, 1.0], *shape, 4),
            vel=host_array(0.0, *shape, 3),
            ang_vel=host_array(0.0, *shape, 3),
            force=host_array(0.0, *shape, 3),
            torque=host_array(0.0, *shape, 3),
            rotor_vel=host_array(0.0, *shape, n_rotors),
        )


STATE_SIZES = {"pos": 3, "quat": 4, "vel": 3, "ang_vel": 3, "force": 3, "torque": 3, "rotor_vel": 4}
"""Numbers of each state of a drone; rotors of drones from first principles may be more."""


class SimStateDeriv(PyTree):
    """Time derivative of the state of every drone."""

    vel: Array = leaf("drone", 1)
    """Velocity, world frame, m/s. (n_worlds, n_drones, 3)"""
    ang_vel: Array = leaf("drone", 1)
    """Angular velocity, body frame, rad/s. (n_worlds, n_drones, 3)"""
    acc: Array = leaf("drone", 1)
    """Acceleration, world frame, m/s^2. (n_worlds, n_drones, 3)"""
    ang_acc: Array = leaf("drone", 1)
    """Angular acceleration, body frame, rad/s^2. (n_worlds, n_drones, 3)"""
    rotor_acc: Array = leaf("drone", 1)
    """Rotor acceleration, rpm/s; in ``so_rpy_rotor*`` the rate of thrust, N/s. (n_worlds, n_drones, n_rotors)"""
    plugins: dict[str, dict[str, Array]] = dataclasses.field(default_factory=dict)
    """Derivatives of plugins' own states, per second: by plugin, then by field of its record."""

    @staticmethod
    def create(n_worlds: int, n_drones: int, device: jax.Device | None = None, n_rotors: int = 4) -> SimStateDeriv:
        """Return a derivative of zeros.

        Args:
            device: Device of the arrays; None for NumPy arrays.
        """
        sizes = {"vel": 3, "ang_vel": 3, "acc": 3, "ang_acc": 3, "rotor_acc": n_rotors}
        zeros = {name: host_array(0.0, n_worlds, n_drones, size) for name, size in sizes.items()}
        return SimStateDeriv(**(zeros if device is None else jax.device_put(zeros, device)))


class SimCore(PyTree):
    """Time, sizes, seed and flags."""

    freq: int = static()
    """Rate of physics steps, Hz."""
    steps: Array = leaf("world")
    """Number of physics steps since the last reset of the world, at most ``MAX_STEPS``. (n_worlds, 1)"""
    episode: Array = leaf("world")
    """Number of resets of the world. Its random numbers depend on it. (n_worlds, 1)"""
    nonfinite: Array = leaf("world")
    """Whether the world has become non-finite in a leaf that ``SimData.roles`` watches, or has taken more than
    ``MAX_STEPS`` steps, since its last reset. (n_worlds, 1)"""
    n_worlds: int = static()
    """Number of worlds."""
    n_drones: int = static()
    """Number of drones per world."""
    world_id: Array = leaf("world")
    """Index of the world, or its index within its block if each block of worlds has a separate random key. The world's
    random numbers depend on it. (n_worlds, 1)"""
    drone_id: Array = leaf("drone")
    """Index of the drone in its world. Its random numbers depend on it. (n_worlds, n_drones)"""
    drone_mocap_ids: Array = leaf("shared", 1)
    """MuJoCo mocap ids of the bodies of the drones. (n_drones,)"""
    rng_key: Array = leaf("parameter", 0)
    """Random key; resets do not change it. (n_worlds, n_drones) for one key per drone, else ()"""
    mjx_synced: Array = leaf("shared", 0)
    """Whether the scene matches this data. ()"""

    @staticmethod
    def create(freq: int, n_worlds: int, n_drones: int, drone_mocap_ids: ArrayLike, rng_key: int | Array) -> SimCore:
        """Return the core of a simulation before its first step."""
        return SimCore(
            freq=freq,
            steps=host_array(0, n_worlds, 1, dtype=np.int32),
            episode=host_array(0, n_worlds, 1, dtype=np.int32),
            nonfinite=host_array(False, n_worlds, 1, dtype=bool),
            n_worlds=n_worlds,
            n_drones=n_drones,
            world_id=host_array(np.arange(n_worlds)[:, None], n_worlds, 1, dtype=np.int32),
            drone_id=host_array(np.arange(n_drones), n_worlds, n_drones, dtype=np.int32),
            drone_mocap_ids=host_array(drone_mocap_ids, n_drones, dtype=np.int32),
            rng_key=as_key(rng_key),
            mjx_synced=host_array(False, dtype=bool),
        )


class Objects(PyTree):
    """Poses of the movable objects of the scene in every world; ``sim.scene.add`` creates them."""

    pos: Array = leaf("world", 2)
    """Positions of the frames of the objects, world frame, m. (n_worlds, 1, n_objects, 3)"""
    quat: Array = leaf("world", 2)
    """Attitudes, body to world, unit, xyzw. (n_worlds, 1, n_objects, 4)"""
    vel: Array = leaf("world", 2)
    """Velocities that contact response uses, world frame, m/s; they do not move the objects.
    (n_worlds, 1, n_objects, 3)"""
    mocap_ids: Array = leaf("shared", 1)
    """MuJoCo mocap ids of the bodies of the objects. (n_objects,)"""
    names: tuple[str, ...] = static()
    """Names of the bodies of the objects."""
    recorded: bool = static(default=False)
    """Whether a recording determines the poses of all objects, even those that plugins move, such as loads."""
    map_index: Array | None = leaf("world", default=None)
    """Index of the map of each world in ``Maps``; None without maps. (n_worlds, 1)"""
    map_ids: Array | None = leaf("shared", 1, default=None)
    """MuJoCo mocap ids of the bodies of the maps. (n_maps,)"""

    def with_poses(self, poses: Mapping[str, tuple[Array, Array]]) -> Objects:
        """Return the objects of one world with new poses for some of them.

        Args:
            poses: Positions, m, (n, 3) and attitudes, xyzw, (n, 4) of all objects of a kind, by the kind's name.
        """
        pos, quat = self.pos, self.quat
        for kind, (kind_pos, kind_quat) in poses.items():
            indices = np.array([self.names.index(f"{kind}:{k}") for k in range(kind_pos.shape[0])])
            pos = pos.at[indices].set(kind_pos.astype(pos.dtype))
            quat = quat.at[indices].set(kind_quat.astype(quat.dtype))
        return self.replace(pos=pos, quat=quat)


class SimData(Record):
    """Complete data of a simulation: the argument and the result of a step."""

    states: SimState
    """Rigid-body and rotor state of the drones."""
    controls: SimControls
    """Commands, internal states and gains of the controllers."""
    params: Any
    """Physical parameters of the drones; ``SimParams`` of the dynamics model."""
    core: SimCore
    """Time, sizes, seed and flags."""
    plugins: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Records of plugins and of user stages, by name. Records (``PyTree``) declare the scopes of their leaves and are
    reset per world. Arrays outside of records are opaque: only resets of all worlds restore them."""
    objects: Objects | None = None
    """Movable objects of the scene; None if there are none."""

    @staticmethod
    def create(
        n_worlds: int,
        n_drones: int,
        dynamics: Dynamics,
        control: Control,
        airframe: Airframes,
        freq: int,
        freqs: dict[Control, int],
        drone_mocap_ids: ArrayLike,
        rng_key: int | Array,
        controller: Controller | None,
    ) -> SimData:
        """Return data of drones at rest, without plugins.

        ``airframe`` is one airframe for all drones, or a list with one for each. ``freqs`` are the rates of commands,
        Hz. ``controller`` is None if the commands need no controller.
        """
        airframes = as_airframes(airframe, n_drones)
        return SimData(
            states=SimState.create(n_worlds, n_drones, n_rotor_states(dynamics, airframes)),
            controls=SimControls.create(n_worlds, n_drones, control, dynamics, airframes, freqs, controller),
            params=create_params(dynamics, airframes, n_worlds),
            core=SimCore.create(freq, n_worlds, n_drones, drone_mocap_ids, rng_key),
        )

    def roles(self) -> Roles:
        """Return the leaves with a role in a step.

        NaN and infinity flag a world in states, controls and populations. NaN alone flags it in what other records of
        plugins hold for drones and worlds, except parameters and scratch; infinity may mean "none so far" there.
        Records with ``watched = False`` are left out. What a user passes to compiled code ends up in one of these
        leaves.
        """
        indices: Any = leaf_indices(self)
        records = {name: x for name, x in self.plugins.items() if getattr(x, "watched", isinstance(x, PyTree))}
        populations = {name: x for name, x in records.items() if isinstance(x, Members)}

        def finite_flags(tree: Any) -> Any:
            return jax.tree.map(lambda scope: True if has_members(scope) else _UNWATCHED, scopes(tree))

        flags = jax.tree.map(lambda _: _UNWATCHED, self)
        nan_flags = jax.tree.map(
            lambda x: False if x else _UNWATCHED, {k: watched_flags(x) for k, x in records.items()}
        )
        flags = flags.replace(
            states=finite_flags(self.states), controls=finite_flags(self.controls),
            plugins=flags.plugins | nan_flags | {name: finite_flags(x) for name, x in populations.items()},
        )  # fmt: skip
        return Roles(
            population="drone",
            clock=indices.core.steps,
            nonfinite=indices.core.nonfinite,
            watched={i: flag for i, flag in enumerate(jax.tree.leaves(flags)) if flag is not _UNWATCHED},
            parameters=frozenset(jax.tree.leaves((indices.params, indices.controls))),
            cleared=indices.core.mjx_synced,
        )

    def check(self) -> None:
        require_states(self)
        require_arrays(self)
        check_axes(self, self.core.n_worlds, self.core.n_drones)

    def without_sizes(self) -> SimData:
        return self.replace(core=self.core.replace(n_worlds=0, n_drones=0))


def create_params(dynamics: Dynamics, airframe: Airframes, n_worlds: int = 1) -> SimParams:
    """Return the parameters of drones for a dynamics model: shared, or one per drone where airframes differ.

    Args:
        airframe: One airframe for all drones, or a list with one for each.
    """
    n_rotors = max_n_rotors(airframe)

    def create(airframe: Airframe) -> SimParams:
        if dynamics == Dynamics.first_principles:
            return first_principles.pad_rotors(first_principles.Params.create(airframe), n_rotors)
        return fitted.Params.create(airframe, dynamics)

    return create_per_drone(airframe, create, n_worlds)


def n_rotor_states(dynamics: Dynamics, airframes: Airframes) -> int:
    """Return the length of ``states.rotor_vel``: the largest number of rotors, or 4 in fitted models."""
    return max_n_rotors(airframes) if dynamics == Dynamics.first_principles else 4


def controls_of(data: SimData) -> Any:
    """Return ``data.controls``, for type checkers as ``Any``: command level and model decide which fields are None."""
    return data.controls


def command_shape(data: SimData, control: Control) -> tuple[int, int, int]:
    """Return the shape of a command to all drones, (n_worlds, n_drones, k)."""
    n_worlds, n_drones, n_rotors = data.states.rotor_vel.shape
    return n_worlds, n_drones, command_size(control, n_rotors)


def object_names(data: SimData) -> tuple[str, ...]:
    return () if data.objects is None else data.objects.names


def require_data(data: object) -> None:
    if not isinstance(data, SimData):
        raise ConfigError(f"expected the data of a simulation, got {short_repr(data)}. Use sim.data.")


def require_states(data: object, names: Iterable[str] = STATE_SIZES, *, batched: bool = True) -> None:
    """Check that an argument is the data of a simulation, and shapes and types of its states.

    Args:
        batched: False to accept data of one world or of one drone, as functions of them receive it.
    """
    require_data(data)
    states, core = data.states, data.core  # type: ignore[attr-defined]  # checked
    batch: tuple[int, ...] = (core.n_worlds, core.n_drones)
    n_axes = getattr(getattr(states, "pos", None), "ndim", 3) - 1
    batch = batch if batched else batch[2 - min(max(n_axes, 0), 2) :]
    for name in names:
        x = getattr(states, name, None)
        shape, dtype = getattr(x, "shape", None), getattr(x, "dtype", np.dtype(object))
        rotor_vel = data.controls.rotor_vel if name == "rotor_vel" else None  # type: ignore[attr-defined]
        expected = (*batch, STATE_SIZES[name] if rotor_vel is None else rotor_vel.shape[-1])
        if shape != expected or dtype not in (np.float32, float_dtype()):
            actual = short_repr(x) if shape is None else f"shape {shape} and type {dtype}"
            raise ConfigError(
                f"expected data.states.{name} as an array of shape {expected} and type float32, got {actual}. Use "
                f"data.replace(states=data.states.replace({name}=...)) with an array like the one it replaces."
            )


def as_key(seed: int | Array) -> Array:
    """Return the typed random key of a seed; a key is returned unchanged."""
    dtype = getattr(seed, "dtype", np.dtype(int) if type(seed) is int else None)
    is_key = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)
    is_integer = dtype is not None and jnp.issubdtype(dtype, jnp.integer)
    if getattr(seed, "shape", ()) != () or not (is_key or is_integer):
        raise ConfigError(f"expected an integer or one key as seed, got {seed!r}; use an integer or jax.random.key(0)")
    try:
        return seed if is_key else jax.random.key(seed)  # type: ignore[return-value]
    except OverflowError as error:
        raise ConfigError(f"the seed {seed} needs more than 64 bits; use a smaller integer") from error


def grid_2d(n: int, spacing: float = 1.0, center: ArrayLike = (0.0, 0.0)) -> np.ndarray:
    """Return the ``n`` points of a square grid nearest to its centre, nearest first, m. (n, 2)"""
    side = math.isqrt(n - 1) + 1
    line = spacing * (np.arange(side) - (side - 1) / 2)
    x, y = np.meshgrid(line, line)
    points = np.stack([x.ravel(), y.ravel()], axis=-1)
    return points[np.argsort(np.linalg.norm(points, axis=-1), kind="stable")[:n]] + np.asarray(center)


def require_memory_of_worlds(
    create: Callable[[int], SimData], n_worlds: int, n_drones: int, device: jax.Device, n_devices: int
) -> None:
    """Check that data before and after a step fits into the memory; ``create`` makes the data of some worlds."""
    if n_worlds * n_drones <= 2**20:  # less than a gigabyte
        return
    world_bytes = 0
    with suppress(ConfigError):  # one number per drone of all worlds does not fit one world
        one_world = create(1)
        is_batched = jax.tree.map(n_batch_axes, scopes(one_world))
        world_bytes = tree_bytes(jax.tree.map(lambda x, n: x if n else None, one_world, is_batched))
    what = f"n_worlds={n_worlds}, before and after a step"
    require_memory(what, 2 * n_worlds * world_bytes, "Use fewer worlds.", device, n_devices)
