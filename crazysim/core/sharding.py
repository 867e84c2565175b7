"""Where worlds live: on one device, or spread over several."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec, SingleDeviceSharding

from crazysim.core.data import SimData
from crazysim.errors import ConfigError
from crazysim.pytree import PER_WORLD, scopes

WORLD_AXIS = "worlds"
"""Name of the mesh axis that worlds are spread over."""


def put(tree: Any, device: jax.Device) -> Any:
    """Return the tree on a device, bound to it; leaves that are so already are not touched."""
    here = SingleDeviceSharding(device)

    def place(x: Any) -> Any:
        is_here = isinstance(x, jax.Array) and x.committed and x.sharding == here
        return x if is_here else jax.device_put(x, here)

    return jax.tree.map(place, tree)


def world_mesh(devices: Sequence[jax.Device]) -> Mesh:
    """Return a one-dimensional mesh of devices for ``Sim(mesh=...)``."""
    return jax.make_mesh((len(devices),), (WORLD_AXIS,), axis_types=(AxisType.Auto,), devices=list(devices))


def placement(data: SimData, mesh: Mesh) -> SimData:
    """Return where every leaf goes: what belongs to a world is split, what is shared is copied to each device.

    Raises:
        ConfigError: If the worlds cannot be split evenly.
    """
    if not isinstance(mesh, Mesh):
        raise ConfigError(f"a mesh is what world_mesh(jax.devices()) returns, not {mesh!r}")
    n_devices = mesh.shape.get(WORLD_AXIS)
    if n_devices is None:
        raise ConfigError(
            f"the mesh has axes {mesh.axis_names}; needed is one named {WORLD_AXIS!r}, as world_mesh makes"
        )
    if data.core.n_worlds % n_devices:
        raise ConfigError(f"{data.core.n_worlds} worlds cannot be split evenly over {n_devices} devices")
    split = NamedSharding(mesh, PartitionSpec(WORLD_AXIS))
    copied = NamedSharding(mesh, PartitionSpec())
    return jax.tree.map(lambda scope: split if scope in PER_WORLD else copied, scopes(data))


def shard(data: SimData, mesh: Mesh) -> SimData:
    """Return the data spread over a mesh."""
    return jax.device_put(data, placement(data, mesh))


def place_scene(mjx_data: Any, mesh: Mesh) -> Any:
    """Return the scene of every world spread over a mesh."""
    return jax.device_put(mjx_data, NamedSharding(mesh, PartitionSpec(WORLD_AXIS)))
