"""Loads that hang from one drone or several, on rods, cables or hooks, and the jets of rotors on these loads."""

from crazysim.plugins.payloads.hook import Hook
from crazysim.plugins.payloads.jet_table import JetTable, load_jet_table
from crazysim.plugins.payloads.load_flatness import LoadedState, load_flat_state
from crazysim.plugins.payloads.point_load import direction, load_pos, load_vel
from crazysim.plugins.payloads.rotor_jet import RotorJet
from crazysim.plugins.payloads.shared import SharedLoad
from crazysim.plugins.payloads.slung import SlungLoad

__all__ = [
    "Hook",
    "JetTable",
    "LoadedState",
    "RotorJet",
    "SharedLoad",
    "SlungLoad",
    "direction",
    "load_flat_state",
    "load_jet_table",
    "load_pos",
    "load_vel",
]
