"""The command levels of the cascade, and what a drone knows of its own rotors."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from crazysim.drones import Airframe


class Control(StrEnum):
    """Command level: what the user commands; everything below runs on board."""

    state = "state"
    """Position, velocity, acceleration, quaternion (of which yaw counts) and body rates: 16 numbers."""
    attitude = "attitude"
    """Roll, pitch, yaw, rad, and collective thrust, N."""
    body_rate = "body_rate"
    """Body rates, rad/s, and collective thrust, N."""
    force_torque = "force_torque"
    """Collective thrust, N, and body torque, N m."""
    rotor_vel = "rotor_vel"
    """Rotor speeds, rpm."""
    default = attitude


COMMAND_FIELDS = {
    Control.state: "x, y, z [m], vx, vy, vz [m/s], ax, ay, az [m/s^2], qx, qy, qz, qw, wx, wy, wz [rad/s]",
    Control.attitude: "roll, pitch, yaw [rad], collective thrust [N]",
    Control.body_rate: "wx, wy, wz [rad/s], collective thrust [N]",
    Control.force_torque: "collective thrust [N], tx, ty, tz [N m]",
    Control.rotor_vel: "one rotor speed each [rpm]",
}
"""What the numbers of a command are, for messages and docs."""


def command_size(control: Control, n_rotors: int) -> int:
    """Return how many numbers a command of one drone has."""
    return {Control.state: 16, Control.rotor_vel: n_rotors}.get(control, 4)


def allocation_matrix(airframe: Airframe) -> np.ndarray:
    """Return the least-norm inverse of thrusts to (collective, torque signs), 1. (n_rotors, 4)

    For a quadrotor in X this is each rotor's signs over four; for any other layout the pseudoinverse, which
    shares a wrench out with the smallest thrusts.
    """
    mixing = airframe.mixing_matrix
    return np.linalg.pinv(np.vstack([np.ones(mixing.shape[1]), mixing]))
