"""Loads that hang from one drone or several, on rods, cables or hooks."""

from typing import TYPE_CHECKING

from crazysim.names import lazy_getattr
from crazysim.plugins.payloads.hook import Hook
from crazysim.plugins.payloads.point_load import direction, load_pos, load_vel
from crazysim.plugins.payloads.slung import SlungLoad

if TYPE_CHECKING:
    from crazysim.lab.control.load_flatness import LoadedState, load_flat_state
    from crazysim.lab.plugins.jet_table import JetTable, load_jet_table
    from crazysim.lab.plugins.rotor_jet import RotorJet
    from crazysim.lab.plugins.shared_load import SharedLoad

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

__getattr__ = lazy_getattr(__name__)
