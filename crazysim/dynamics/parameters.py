"""Parameters of airframes for dynamics, where Crazyflow has them."""

from crazysim.dynamics.parameter_tables import load_fn_params, load_params, rotor_vel_limits

__all__ = ["load_fn_params", "load_params", "rotor_vel_limits"]
