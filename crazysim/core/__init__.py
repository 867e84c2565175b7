"""The core: records, stages, pipelines, integrators, plugins, random numbers and settings.

The package exports the functions with which users write plugins, stages and resets, and the functions that distribute
worlds over devices.
"""

from crazysim.core.pipeline import append_fn, insert_fn_after, insert_fn_before, prepend_fn, remove_fn, replace_fn
from crazysim.core.plugin import (
    FunctionPlugin,
    Param,
    Plugin,
    StagePlacement,
    check_parameter,
    derived,
    param,
    state,
)
from crazysim.core.random import drone_key, drone_keys, seed_sim, world_key, world_keys
from crazysim.core.settings import dividing_rate, setting
from crazysim.engine.pytree import map_batched, scopes, select_worlds
from crazysim.engine.sharding import shard, world_mesh

__all__ = [
    "FunctionPlugin",
    "Param",
    "Plugin",
    "StagePlacement",
    "append_fn",
    "check_parameter",
    "derived",
    "dividing_rate",
    "drone_key",
    "drone_keys",
    "insert_fn_after",
    "insert_fn_before",
    "map_batched",
    "param",
    "prepend_fn",
    "remove_fn",
    "replace_fn",
    "scopes",
    "seed_sim",
    "select_worlds",
    "setting",
    "shard",
    "state",
    "world_key",
    "world_keys",
    "world_mesh",
]
