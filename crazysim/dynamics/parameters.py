"""Airframe parameters of the dynamics, importable under the same module path as in Crazyflow."""

from crazysim.dynamics.parameter_tables import load_fn_params, load_params, rotor_vel_limits

__all__ = ["load_fn_params", "load_params", "rotor_vel_limits"]
