"""Worlds spread over devices, under the path that Crazyflow uses."""

from crazysim.core.sharding import (
    placement,
    shard,
    world_mesh,
)

__all__ = [
    "placement",
    "shard",
    "world_mesh",
]
