"""Poses of objects that follow from the records of plugins, such as loads, in queries of the scene."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from crazysim.core.data import SimData
from crazysim.core.plugin import Plugin
from crazysim.core.stage import vmap_worlds
from crazysim.errors import ConfigError

Placing = Callable[[], Iterable[Plugin]]
"""Returns plugins, of which those that place objects count."""


def placed_by(plugins: Iterable[Plugin], names: Sequence[str]) -> dict[str, Plugin]:
    """Return the plugin that places each of some objects, by the object's name, for objects that a plugin places."""
    found = {}
    for plugin in plugins:
        kinds = plugin.placed_kinds
        for name in names if plugin.places else ():
            if kinds is None or name.rpartition(":")[0] in kinds:
                found[name] = plugin
    return found


def place(data: SimData, placed: Mapping[str, Plugin]) -> SimData:
    """Return the data of all worlds, or of one world, with objects at the poses of their plugins.

    Recorded poses stay.

    Raises:
        ConfigError: If the data are of one drone, which do not contain the other drones' objects.
    """
    if not placed or data.objects is None or data.objects.recorded:
        return data
    if data.states.pos.ndim == 1:
        name, plugin = next(iter(placed.items()))
        raise ConfigError(
            f"expected the data of a world, got those of one drone, from which the pose of {name!r}, an object of "
            f"plugin {plugin.name!r}, does not follow. Declare the stage @stage('world'), or leave the object out with "
            f"objects=."
        )
    for plugin in dict.fromkeys(placed.values()):
        where = vmap_worlds(plugin.place) if data.states.pos.ndim == 3 else plugin.place
        data = data.replace(objects=where(data))
    return data
