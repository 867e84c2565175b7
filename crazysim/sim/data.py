"""Records of a simulation, under Crazyflow's import path."""

from crazysim.control import Control
from crazysim.core.controls import (
    AttitudeControlData,
    BodyRateControlData,
    ForceTorqueControlData,
    SimControls,
    StateControlData,
)
from crazysim.core.data import SimCore, SimData, SimParams, SimState, SimStateDeriv
from crazysim.sim.crazyflow import ControlData

__all__ = [
    "AttitudeControlData",
    "BodyRateControlData",
    "Control",
    "ControlData",
    "ForceTorqueControlData",
    "SimControls",
    "SimCore",
    "SimData",
    "SimParams",
    "SimState",
    "SimStateDeriv",
    "StateControlData",
]
