"""Records of a simulation, under the path that Crazyflow uses."""

from crazysim.control import Control
from crazysim.core.controls import (
    AttitudeControlData,
    BodyRateControlData,
    ForceTorqueControlData,
    SimControls,
    StateControlData,
)
from crazysim.core.data import SimCore, SimData, SimParams, SimState, SimStateDeriv

ControlData = StateControlData | AttitudeControlData | BodyRateControlData | ForceTorqueControlData
"""Records of controllers."""

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
