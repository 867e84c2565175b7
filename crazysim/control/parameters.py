"""Parameters of the firmware's controllers, where Crazyflow has them."""

from crazysim.dynamics.parameter_tables import load_controller_fn_params as load_fn_params
from crazysim.dynamics.parameter_tables import load_controller_params as load_params

__all__ = ["load_fn_params", "load_params"]
