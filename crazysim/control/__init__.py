"""Controllers: pure functions for one drone, with any leading axes, and the protocol of ``Sim(controller=...)``."""

from typing import TYPE_CHECKING

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
from crazysim.lazy import lazy

if TYPE_CHECKING:
    from crazysim.control.geometric import Geometric
    from crazysim.control.indi import INDI
    from crazysim.control.load_lqr import LoadLQR
    from crazysim.control.lqr import LQR
    from crazysim.control.tracking_lqr import TrackingLQR

__all__ = [
    "COMMAND_FIELDS",
    "INDI",
    "LQR",
    "PID",
    "AllocationParams",
    "AttitudeParams",
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
    "load_fn_params",
    "load_params",
    "state2attitude",
]

__getattr__ = lazy(
    __name__,
    {
        "Geometric": "crazysim.control.geometric",
        "INDI": "crazysim.control.indi",
        "LQR": "crazysim.control.lqr",
        "LoadLQR": "crazysim.control.load_lqr",
        "TrackingLQR": "crazysim.control.tracking_lqr",
    },
)


def __dir__() -> list[str]:
    """Return the public names, those not yet imported included."""
    return __all__
