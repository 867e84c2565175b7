"""Loads that hang from drones, on rods, cables and hooks or below several drones, and jets of rotors on them."""

from crazysim.payloads.core import LoadData, direction, load_pos, load_vel
from crazysim.payloads.flatness import LoadedState, load_flat_state
from crazysim.payloads.hook import Hook, HookData
from crazysim.payloads.jet_table import JetTable, load_jet_table
from crazysim.payloads.rotor_jet import RotorJet, RotorJetData
from crazysim.payloads.shared import SharedLoad, SharedLoadData
from crazysim.payloads.slung import SlungLoad

__all__ = [
    "Hook",
    "HookData",
    "JetTable",
    "LoadData",
    "LoadedState",
    "RotorJet",
    "RotorJetData",
    "SharedLoad",
    "SharedLoadData",
    "SlungLoad",
    "direction",
    "load_flat_state",
    "load_jet_table",
    "load_pos",
    "load_vel",
]
