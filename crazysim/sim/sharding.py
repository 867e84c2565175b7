"""Functions that distribute worlds over devices, importable under the same module path as in Crazyflow."""

from crazysim.core.sharding import shard, shardings_of, world_mesh

__all__ = ["shard", "shardings_of", "world_mesh"]
