"""Devices that hold worlds, and the distribution of worlds over them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple, TypeVar, cast

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec, Sharding, SingleDeviceSharding

from crazysim.engine.jaxcompat import gather_from_hosts, is_key
from crazysim.engine.pytree import n_batch_axes, replace_leaves, scopes
from crazysim.errors import ConfigError

T, R = TypeVar("T"), TypeVar("R")

WORLD_AXIS = "worlds"
"""Name of the mesh axis over which worlds are distributed."""


class Location(NamedTuple):
    """Devices that hold the data of a simulation, and the distribution of worlds over them."""

    platform: str
    """``"cpu"`` or ``"gpu"``."""
    devices: tuple[jax.Device, ...] | None = None
    """The devices; None for any of the platform."""
    mesh: Mesh | None = None
    """Mesh of the devices; None for a single one, or where an array's sharding names no mesh."""
    axis: Any = WORLD_AXIS
    """Axis or axes of the mesh over which worlds are split; None if each device has all worlds."""

    @property
    def is_distributed(self) -> bool:
        """True for several devices, or with a mesh."""
        return self.mesh is not None or (self.devices is not None and len(self.devices) > 1)


def find_location(x: jax.Array) -> Location:
    """Return the devices of an array with a first axis over worlds, and the distribution of worlds over them."""
    devices = tuple(sorted(x.sharding.device_set, key=lambda d: d.id))
    platform = devices[0].platform
    if len(devices) == 1 or not isinstance(x.sharding, NamedSharding):
        return Location(platform, devices)
    spec = x.sharding.spec
    return Location(platform, devices, cast(Mesh, x.sharding.mesh), spec[0] if len(spec) else None)


def put_on_device(tree: T, device: jax.Device) -> T:
    """Return the tree committed to a device. Trees and leaves that are already committed to it stay the same objects.

    JAX compiles a function of uncommitted arrays for its default device. If that is another device, traced leaves get a
    constraint, so that the compiled function runs on ``device``. Under a mesh, traced leaves get no constraint.
    """
    sharding = SingleDeviceSharding(device)
    leaves, treedef = jax.tree.flatten(tree)
    traced_indices = [i for i, x in enumerate(leaves) if isinstance(x, jax.core.Tracer)]
    moved_indices = [i for i, x in enumerate(leaves) if i not in traced_indices and not _is_on(x, sharding)]
    if not moved_indices and not traced_indices:
        return tree
    if moved_indices:  # one call for all leaves takes half the time
        leaves = replace_leaves(leaves, moved_indices, jax.device_put([leaves[i] for i in moved_indices], sharding))
    if traced_indices and not _runs_on(device):
        leaves = replace_leaves(
            leaves, traced_indices, jax.lax.with_sharding_constraint([leaves[i] for i in traced_indices], sharding)
        )
    return treedef.unflatten(leaves)


def _is_on(x: object, sharding: SingleDeviceSharding) -> bool:
    return isinstance(x, jax.Array) and x.committed and x.sharding == sharding


def _runs_on(device: jax.Device) -> bool:
    with jax.ensure_compile_time_eval():
        default_devices = jax.device_put(np.int8(0)).devices()
    return default_devices == {device} or not jax.sharding.get_abstract_mesh().empty


def use_device_of(x: object) -> AbstractContextManager[object]:
    """Return a context manager that makes the device of an array the default device.

    It has no effect for an array on several devices, or for a traced array: its program runs on the device of its
    arguments.
    """
    devices = () if isinstance(x, jax.core.Tracer) or not isinstance(x, jax.Array) else tuple(x.devices())
    return jax.default_device(devices[0]) if len(devices) == 1 else nullcontext()


def world_mesh(devices: Sequence[jax.Device]) -> Mesh:
    """Make a one-dimensional mesh of devices for ``Sim(mesh=...)``."""
    return jax.make_mesh((len(devices),), (WORLD_AXIS,), axis_types=(AxisType.Auto,), devices=list(devices))


def shardings_of(data: Any, mesh: Mesh) -> Any:
    """Return the sharding of every leaf: leaves of members and worlds are split, shared leaves are replicated."""
    if not isinstance(mesh, Mesh):
        raise ConfigError(f"expected a mesh, got {mesh!r}; use world_mesh(jax.devices()), or --devices of a training")
    n_devices = mesh.shape.get(WORLD_AXIS)
    if n_devices is None:
        raise ConfigError(
            f"expected a mesh with an axis {WORLD_AXIS!r}, got axes {mesh.axis_names}; make it with world_mesh"
        )
    if data.core.n_worlds % n_devices:
        raise ConfigError(
            f"{data.core.n_worlds} worlds cannot be split evenly over {n_devices} devices; use a multiple of "
            f"{n_devices}"
        )
    split_sharding = NamedSharding(mesh, PartitionSpec(WORLD_AXIS))
    replicated_sharding = NamedSharding(mesh, PartitionSpec())
    return jax.tree.map(lambda scope: split_sharding if n_batch_axes(scope) else replicated_sharding, scopes(data))


def shard(data: Any, mesh: Mesh) -> Any:
    """Distribute the data over a mesh; under a trace, constrain the compiled function to distribute it."""
    distribute_fn = jax.lax.with_sharding_constraint if isinstance(data.states.pos, jax.core.Tracer) else distribute
    return distribute_fn(data, shardings_of(data, mesh))


def map_devices(fn: Callable[[T], R], data: T, mesh: Mesh) -> R:
    """Return the results of a function for all worlds; each device of a mesh computes the results of its worlds.

    Args:
        fn: Function of data; its results have a leading axis over worlds.
    """
    split_spec, replicated_spec = PartitionSpec(WORLD_AXIS), PartitionSpec()
    specs = jax.tree.map(lambda scope: split_spec if n_batch_axes(scope) else replicated_spec, scopes(data))
    return jax.shard_map(fn, mesh=mesh, in_specs=(specs,), out_specs=split_spec, check_vma=False)(data)


def distribute(tree: T, shardings: Any) -> T:
    """Return arrays distributed over devices like ``jax.device_put``, also over devices of several hosts.

    Args:
        tree: Pytree of arrays. An array that is not yet distributed must be the same on all hosts; each host puts
            its own part of it on its devices.
        shardings: Sharding of every array, as a pytree of the same structure, or one sharding for all arrays.
    """
    shardings = jax.tree.broadcast(shardings, tree)
    if all(sharding.is_fully_addressable for sharding in jax.tree.leaves(shardings)):
        return jax.device_put(tree, shardings)
    return jax.tree.map(_distribute_over_hosts, tree, shardings)


def _distribute_over_hosts(x: Any, sharding: Sharding) -> jax.Array:
    if isinstance(x, jax.Array) and not x.is_fully_addressable:
        return jax.device_put(x, sharding)
    if isinstance(x, jax.Array) and is_key(x):
        return jax.random.wrap_key_data(
            _distribute_over_hosts(jax.random.key_data(x), sharding), impl=jax.random.key_impl(x)
        )
    value = np.asarray(x)
    return jax.make_array_from_callback(value.shape, sharding, lambda part: value[part])


def fetch_arrays(tree: T) -> T:
    """Return the tree with host arrays, and with the data of random keys.

    Arrays that are distributed over several hosts are sent to all hosts, which must all call this function.
    """
    leaves, treedef = jax.tree.flatten(tree)
    leaves = [jax.random.key_data(x) if isinstance(x, jax.Array) and is_key(x) else x for x in leaves]
    remote_indices = [i for i, x in enumerate(leaves) if isinstance(x, jax.Array) and not _is_readable(x)]
    if remote_indices:
        leaves = replace_leaves(leaves, remote_indices, gather_from_hosts([leaves[i] for i in remote_indices]))
    return treedef.unflatten([np.asarray(x) for x in leaves])


def _is_readable(x: jax.Array) -> bool:
    return x.is_fully_addressable or x.is_fully_replicated


def shard_scene(mjx_data: T, mesh: Mesh) -> T:
    return distribute(mjx_data, NamedSharding(mesh, PartitionSpec(WORLD_AXIS)))
