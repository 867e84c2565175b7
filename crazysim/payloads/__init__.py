"""Loads that hang from drones: on rods and cables, on hooks, and below several drones."""

from crazysim.payloads.core import LoadData, direction, load_pos, load_vel
from crazysim.payloads.flatness import LoadedState, flat_states
from crazysim.payloads.hook import Hook, HookData
from crazysim.payloads.shared import SharedLoad, SharedLoadData
from crazysim.payloads.slung import SlungLoad

__all__ = [
    "Hook",
    "HookData",
    "LoadData",
    "LoadedState",
    "SharedLoad",
    "SharedLoadData",
    "SlungLoad",
    "direction",
    "flat_states",
    "load_pos",
    "load_vel",
]
