"""Airframe parameters of the dynamics, under Crazyflow's import path."""

from crazysim.dynamics.parameter_tables import load_fn_params, load_params, rotor_vel_limits

__all__ = ["load_fn_params", "load_params", "rotor_vel_limits"]
