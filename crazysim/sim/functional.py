"""Commands as pure functions, under Crazyflow's import path."""

from crazysim.core.functional import (
    attitude_control,
    body_rate_control,
    controllable,
    force_torque_control,
    rotor_vel_control,
    state_control,
)

__all__ = [
    "attitude_control",
    "body_rate_control",
    "controllable",
    "force_torque_control",
    "rotor_vel_control",
    "state_control",
]
