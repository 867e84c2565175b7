"""Controllers by name."""

from __future__ import annotations

import importlib
from typing import Any

from crazysim.control.protocol import Controller
from crazysim.control.switch import make_switch
from crazysim.errors import UnknownNameError, expect

DEFAULT_CONTROLLER = "auto"
"""Name of the default controller."""
CONTROLLERS = {
    "auto": "crazysim.control.auto:Auto",
    "crazyflow": "crazysim.control.crazyflow:Crazyflow",
    "pid": "crazysim.control.pid:PID",
    "mellinger": "crazysim.control.mellinger:Mellinger",
    "geometric": "crazysim.control.geometric:Geometric",
    "indi": "crazysim.control.indi:INDI",
    "lqr": "crazysim.control:LQR",
    "load_lqr": "crazysim.control:LoadLQR",
    "tracking_lqr": "crazysim.control:TrackingLQR",
    "any": "crazysim.control:AnyAirframe",
}
"""Controllers by name, as ``"module:class"``, which ``find_controller`` imports."""


def find_controller(controller: Any, switch: Any = None) -> Controller:
    """Return the controller of a simulation.

    Args:
        controller: Name, ``Controller``, or a list of these from which ``switch`` chooses.
        switch: Function or indices, as for ``Switch``; None for a single controller.
    """
    if isinstance(controller, (list, tuple)):
        return make_switch([find_controller(item) for item in controller], switch)
    expect(switch is None, "a list of controllers for a switch", controller, "Use controller=[...].")
    if isinstance(controller, Controller):
        return controller
    expect(
        isinstance(controller, str),
        "a controller as a name or a Controller",
        controller,
        "Use controller='pid', or an instance of a subclass of crazysim.control.Controller.",
    )
    if controller not in CONTROLLERS:
        names = ", ".join(repr(name) for name in sorted(CONTROLLERS))
        is_library = controller.endswith((".so", ".dylib"))
        remedy = f" Use CFirmware({controller!r}) for a compiled controller." if is_library else ""
        raise UnknownNameError(f"expected controller as one of {names}, got {controller!r}.{remedy}")
    module, _, name = CONTROLLERS[controller].partition(":")
    return getattr(importlib.import_module(module), name)()
