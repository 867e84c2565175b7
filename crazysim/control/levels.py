"""Command levels of the control cascade, and the allocation matrix."""

from __future__ import annotations

from enum import StrEnum

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.drones import Airframe


class Control(StrEnum):
    """Command level: the kind of command that the user sends. Controllers compute the commands of the lower levels."""

    state = "state"
    """Position, velocity, acceleration, quaternion (only its yaw is used) and body rates: 16 numbers."""
    attitude = "attitude"
    """Roll, pitch, yaw, rad, and collective thrust, N."""
    body_rate = "body_rate"
    """Body rates, rad/s, and collective thrust, N. Controller ``"crazyflow"`` also levels the drone."""
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
    Control.rotor_vel: "speed of each rotor [rpm]",
}
"""Entries of a command of each level with their units, for messages and docs."""


def command_size(control: Control, n_rotors: int) -> int:
    """Return the number of entries of one drone's command."""
    return {Control.state: 16, Control.rotor_vel: n_rotors}.get(control, 4)


def count_rotors(rotors: Array | None, n: int) -> Array | int:
    """Return the number of rotors in a mask, (..., 1), or ``n`` if the mask is None."""
    return n if rotors is None else jnp.sum(jnp.where(rotors, 1.0, 0.0), axis=-1, keepdims=True)


def mask_rotors(rotors: Array | None, x: Array, fill_value: float) -> Array:
    """Return values of rotors, with ``fill_value`` for rotors that a drone lacks. (..., n_rotors)"""
    return x if rotors is None else jnp.where(rotors, x, fill_value)


def allocation_matrix(airframe: Airframe) -> np.ndarray:
    """Return the matrix that maps collective thrust, and torque divided by the torque arms, to rotor thrusts.

    It is the pseudoinverse of the mixing matrix with a row of ones on top, so that rotor thrusts have the least norm.
    For a quadrotor in X its entries are the signs of the rotors divided by four.

    Returns:
        (n_rotors, 4)
    """
    mixing = airframe.mixing_matrix
    return np.linalg.pinv(np.vstack([np.ones(mixing.shape[1]), mixing]))
