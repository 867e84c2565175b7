"""Scenery: layouts of obstacles, drawn again in every world and episode, each a plugin that ``sim.add`` adds."""

from crazysim.plugins.scenery.clutter import Clutter
from crazysim.plugins.scenery.forest import Forest, Pillars
from crazysim.plugins.scenery.gates import Gates
from crazysim.plugins.scenery.maps import Maps
from crazysim.plugins.scenery.rooms import Rooms
from crazysim.plugins.scenery.scenery import Scenery

__all__ = ["Clutter", "Forest", "Gates", "Maps", "Pillars", "Rooms", "Scenery"]
