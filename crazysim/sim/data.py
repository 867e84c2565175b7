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

__all__ = [
    "AttitudeControlData",
    "BodyRateControlData",
    "ForceTorqueControlData",
    "SimControls",
    "SimCore",
    "SimData",
    "SimParams",
    "SimState",
    "SimStateDeriv",
    "StateControlData",
]
