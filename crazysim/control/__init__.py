"""Controllers as pure functions, and as objects for ``Sim(controller=...)``.

The functions are written for one drone, and accept arrays with any leading axes. ``load_params`` and ``load_fn_params``
return the parameters of Crazyflow's controllers, and have the names of Crazyflow.
"""

from typing import TYPE_CHECKING

from crazysim.control.allocation import AllocationParams, force_torque2rotor_vel
from crazysim.control.attitude_controller import AttitudeParams, attitude2force_torque, body_rate2force_torque
from crazysim.control.levels import COMMAND_FIELDS, Control, command_size
from crazysim.control.mellinger import Mellinger
from crazysim.control.pid import PID
from crazysim.control.protocol import Controller
from crazysim.control.setpoint import Setpoint
from crazysim.control.state_controller import StateParams, state2attitude
from crazysim.control.switch import Switch
from crazysim.dynamics.models import AirframeParams
from crazysim.names import lazy_getattr

if TYPE_CHECKING:
    from crazysim.control.auto import Auto
    from crazysim.control.geometric import Geometric, geometric_control
    from crazysim.control.indi import INDI, indi_control
    from crazysim.lab.control.any_airframe import AnyAirframe
    from crazysim.lab.control.firmware import CFirmware
    from crazysim.lab.control.load_lqr import LoadLQR, load_lqr_control
    from crazysim.lab.control.lqr import LQR, lqr_control
    from crazysim.lab.control.tracking_lqr import TrackingLQR, tracking_lqr_control
    from crazysim.sim.crazyflow import load_fn_params, load_params

__all__ = [
    "COMMAND_FIELDS",
    "INDI",
    "LQR",
    "PID",
    "AirframeParams",
    "AllocationParams",
    "AnyAirframe",
    "AttitudeParams",
    "Auto",
    "CFirmware",
    "Control",
    "Controller",
    "Geometric",
    "LoadLQR",
    "Mellinger",
    "Setpoint",
    "StateParams",
    "Switch",
    "TrackingLQR",
    "attitude2force_torque",
    "body_rate2force_torque",
    "command_size",
    "force_torque2rotor_vel",
    "geometric_control",
    "indi_control",
    "load_fn_params",
    "load_lqr_control",
    "load_params",
    "lqr_control",
    "state2attitude",
    "tracking_lqr_control",
]

__getattr__ = lazy_getattr(__name__)
