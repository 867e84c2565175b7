"""Records of a simulation, under the path that Crazyflow uses."""

from crazysim.core.data import (
    AttitudeControlData,
    BodyRateControlData,
    ForceTorqueControlData,
    SimControls,
    SimCore,
    SimData,
    SimParams,
    SimState,
    SimStateDeriv,
    StateControlData,
)

ControlData = StateControlData | AttitudeControlData | BodyRateControlData | ForceTorqueControlData
"""Records of controllers."""

__all__ = [
    "AttitudeControlData",
    "BodyRateControlData",
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
