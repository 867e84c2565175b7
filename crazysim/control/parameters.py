"""Parameters of Crazyflow's controllers, importable under the same module path as in Crazyflow."""

from crazysim.dynamics.parameter_tables import load_controller_fn_params as load_fn_params
from crazysim.dynamics.parameter_tables import load_controller_params as load_params

__all__ = ["load_fn_params", "load_params"]
