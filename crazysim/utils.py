"""Helpers, under Crazyflow's import path."""

from crazysim.core.data import grid_2d
from crazysim.engine.cache import enable_cache
from crazysim.engine.pytree import CORE_NDIM_KEY
from crazysim.sim.crazyflow import leaf_replace, pytree_replace, world_mask

__all__ = ["CORE_NDIM_KEY", "enable_cache", "grid_2d", "leaf_replace", "pytree_replace", "world_mask"]
