"""Functions that distribute worlds over devices, under Crazyflow's import path."""

from crazysim.engine.sharding import shard, shardings_of, world_mesh

__all__ = ["shard", "shardings_of", "world_mesh"]
