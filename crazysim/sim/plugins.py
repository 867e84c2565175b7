"""The methods of ``Sim`` that add, replace and remove plugins."""

from __future__ import annotations

from crazysim.core.plugin import Plugin
from crazysim.core.registry import P, PluginRegistry


class PluginMethods:
    """Methods of ``Sim`` for plugins."""

    plugins: PluginRegistry
    """The plugins by name, in the order in which they were added."""

    def add(self, plugin: P, name: str | None = None) -> P:
        """Add an effect, a sensor, a log or any other plugin, and return it.

        Its record goes into ``data.plugins`` of the data and the default data, of which nothing else changes, its
        stages into the step pipeline, its influences and states into the integration. The step is compiled again.

        Args:
            plugin: The plugin, such as ``crazysim.Wind(velocity=(2, 0, 0))``.
            name: Name to add it under; None for ``plugin.name``.

        Raises:
            ConfigError: If the name is taken, a setting is invalid, or the simulation lacks what the plugin needs.
        """
        return self.plugins.add(plugin, name)

    def remove(self, plugin: Plugin | str) -> None:
        """Remove a plugin, with its record and its stages; stages that it had replaced return.

        Raises:
            UnknownNameError: If it has not been added.
            ConfigError: If one of its stages has been replaced since.
        """
        self.plugins.remove(plugin)

    def replace(self, plugin: P) -> P:
        """Replace the settings of the plugin of the same name; its states continue.

        Where only numbers change (the fields declared with ``parameter``), nothing is compiled.

        Raises:
            UnknownNameError: If there is no plugin of that name.
            ConfigError: If it is of another class, or a setting is invalid.
        """
        return self.plugins.replace(plugin)
