"""Distribution of worlds over devices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec, SingleDeviceSharding

from crazysim.core.data import SimData
from crazysim.errors import ConfigError
from crazysim.pytree import scopes

WORLD_AXIS = "worlds"
"""Name of the mesh axis over which worlds are distributed."""


def put(tree: Any, device: jax.Device) -> Any:
    """Return the tree committed to a device; leaves that already are remain the same arrays."""
    here = SingleDeviceSharding(device)

    def place(x: Any) -> Any:
        is_here = isinstance(x, jax.Array) and x.committed and x.sharding == here
        return x if is_here else jax.device_put(x, here)

    return jax.tree.map(place, tree)


def world_mesh(devices: Sequence[jax.Device]) -> Mesh:
    """Return a one-dimensional mesh of devices for ``Sim(mesh=...)``."""
    return jax.make_mesh((len(devices),), (WORLD_AXIS,), axis_types=(AxisType.Auto,), devices=list(devices))


def placement(data: SimData, mesh: Mesh) -> SimData:
    """Return the sharding of every leaf: leaves of drones and worlds are split, shared leaves are replicated.

    Raises:
        ConfigError: If the mesh has no axis of worlds, or the worlds cannot be split evenly.
    """
    if not isinstance(mesh, Mesh):
        raise ConfigError(f"expected a mesh, got {mesh!r}; use world_mesh(jax.devices())")
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
    split = NamedSharding(mesh, PartitionSpec(WORLD_AXIS))
    copied = NamedSharding(mesh, PartitionSpec())
    return jax.tree.map(lambda scope: split if scope in ("drone", "world") else copied, scopes(data))


def shard(data: SimData, mesh: Mesh) -> SimData:
    """Return the data distributed over a mesh."""
    return jax.device_put(data, placement(data, mesh))


def place_scene(mjx_data: Any, mesh: Mesh) -> Any:
    """Return the MJX data of all worlds distributed over a mesh."""
    return jax.device_put(mjx_data, NamedSharding(mesh, PartitionSpec(WORLD_AXIS)))
