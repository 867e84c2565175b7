"""Poses of the objects of plugins, such as loads, which queries compute from the records of the plugins."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from jax import Array

from crazysim.core.data import SimData, require_data
from crazysim.core.plugin import BoundMethod, Plugin
from crazysim.engine.stage import vmap_worlds
from crazysim.errors import ConfigError, require

ListPlugins = Callable[[], Iterable[Plugin]]
"""Function that returns the plugins of the simulation."""


def map_index_of(data: SimData) -> Array:
    """Return the index of the map that each world has, (n_worlds, 1), or () in one world or drone."""
    index = None if data.objects is None else data.objects.map_index
    require(index is not None, "expected data with maps, got data.objects.map_index None. Use sim.data after sim.add.")
    return index  # type: ignore[return-value]


def moving_plugins(plugins: Iterable[Plugin], names: Sequence[str]) -> dict[str, Plugin]:
    """Return a dict from the name of each object that a plugin moves to that plugin.

    Args:
        names: Names of objects, ``KIND:NUMBER``.
    """
    owners = {}
    for plugin in plugins:
        kinds = plugin.moved_kinds
        for name in names if plugin.moves_objects else ():
            if kinds is None or name.rpartition(":")[0] in kinds:
                owners[name] = plugin
    return owners


def with_moved_objects(data: SimData, plugins: Mapping[str, Plugin]) -> SimData:
    """Return the data of all worlds, or of one world, with the present poses of objects that plugins move.

    If ``data.objects.recorded`` is True, the data is returned unchanged.
    """
    require_data(data)
    if not plugins or data.objects is None or data.objects.recorded:
        return data
    if data.states.pos.ndim == 1:
        name, plugin = next(iter(plugins.items()))
        raise ConfigError(
            f"expected the data of a world, got the data of one drone, which do not determine the pose of {name!r}, an "
            f"object of plugin {plugin.name!r}. Declare the stage @stage('world'), or leave the object out with "
            f"objects=."
        )
    for plugin in dict.fromkeys(plugins.values()):
        move = BoundMethod(plugin, type(plugin).move_objects)
        data = data.replace(objects=(vmap_worlds(move) if data.states.pos.ndim == 3 else move)(data))
    return data
