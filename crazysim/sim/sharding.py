"""Functions that spread worlds over devices, where Crazyflow has them."""

from crazysim.core.sharding import shard, shardings_of, world_mesh

__all__ = ["shard", "shardings_of", "world_mesh"]
