"""Scenery: layouts of obstacles, drawn again in every world and episode, each a plugin that ``sim.add`` adds."""

from crazysim.plugins.scenery.forest import Forest

__all__ = ["Forest"]
