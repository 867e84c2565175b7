"""Controllers: pure functions for one drone, with any leading axes, and the protocol of ``Sim(controller=...)``."""

from crazysim.control.allocation import AllocationParams, force_torque2rotor_vel
from crazysim.control.attitude import AttitudeParams, attitude2force_torque, body_rate2force_torque
from crazysim.control.core import COMMAND_FIELDS, Control, command_size
from crazysim.control.mellinger import Mellinger
from crazysim.control.parameters import load_fn_params, load_params
from crazysim.control.pid import PID
from crazysim.control.protocol import Controller
from crazysim.control.setpoint import Setpoint
from crazysim.control.state import StateParams, state2attitude
from crazysim.control.switch import Switch

__all__ = [
    "COMMAND_FIELDS",
    "PID",
    "AllocationParams",
    "AttitudeParams",
    "Control",
    "Controller",
    "Mellinger",
    "Setpoint",
    "StateParams",
    "Switch",
    "attitude2force_torque",
    "body_rate2force_torque",
    "command_size",
    "force_torque2rotor_vel",
    "load_fn_params",
    "load_params",
    "state2attitude",
]
