"""Worlds spread over devices, under the path that Crazyflow uses."""

from crazysim.core.sharding import (
    shard,
    shardings_of,
    world_mesh,
)

__all__ = [
    "shard",
    "shardings_of",
    "world_mesh",
]
