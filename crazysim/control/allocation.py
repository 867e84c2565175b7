"""Allocation, the last step of the cascade: wrench to rotor speeds."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim.control.core import allocation_matrix
from crazysim.drones import Airframe
from crazysim.dynamics.rotor import rotor_vel_of_thrust
from crazysim.pytree import PyTree, as_parameter, leaf
from crazysim.rotation import matvec, safe_clip


class AllocationParams(PyTree):
    """Parameters of the allocation, each shared or one per drone."""

    thrust_min: Array = leaf("parameter", 1)
    """Minimum thrust of a rotor that is on, N. (1,)"""
    thrust_max: Array = leaf("parameter", 1)
    """Maximum thrust of one rotor, N. (1,)"""
    arms: Array = leaf("parameter", 1)
    """Torque per thrust about x and y (arm) and z (drag torque over thrust), m. (3,)"""
    rpm2thrust: Array = leaf("parameter", 2)
    """Thrust curve that the controller assumes, N, N/rpm, N/rpm^2. (1, 3)"""
    allocation_matrix: Array = leaf("parameter", 2)
    """Allocation matrix, wrench over the arms to rotor thrusts, 1. (n_rotors, 4)"""
    rotors: Array | None = leaf("parameter", 1, default=None)
    """True for the rotors that the drone has; None where all drones have equally many. (n_rotors,)"""

    @staticmethod
    def create(airframe: Airframe) -> AllocationParams:
        """Return the shared parameters of an airframe.

        Raises:
            ConfigError: If the airframe lacks one.
        """
        yaw_arm = airframe.value("controller.thrust2torque", ())
        curve = airframe.value("rotors.thrust_curve")
        return AllocationParams(
            thrust_min=as_parameter(airframe.value("rotors.thrust_min", ())),
            thrust_max=as_parameter(airframe.value("rotors.thrust_max", ())),
            arms=as_parameter([airframe.arm, airframe.arm, float(yaw_arm)]),
            rpm2thrust=as_parameter(curve.reshape(-1, 3)),
            allocation_matrix=as_parameter(allocation_matrix(airframe)),
        )


def force_torque2rotor_vel(cmd: Array, *, params: AllocationParams) -> Array:
    """Return the rotor speeds that produce a wrench, each within its limits.

    The wrench is allocated with the least-norm inverse of the mixing matrix, and each thrust is clipped on its own, as
    in Crazyflow. The firmware lowers all motors by the excess of the highest instead, which keeps the torque; see
    ``crazysim.control.power_distribution``. A collective thrust of zero or less switches the motors off.

    Args:
        cmd: Collective thrust, N, and body torque, N m. (..., 4)
        params: Parameters, shared or with the leading axes of the command.

    Returns:
        Rotor speeds, rpm. (..., n_rotors)
    """
    p = params
    force = cmd[..., :1]
    thrusts = matvec(p.allocation_matrix, jnp.concatenate([force, cmd[..., 1:] / p.arms], axis=-1))
    rotor_vel = rotor_vel_of_thrust(safe_clip(thrusts, p.thrust_min, p.thrust_max), p.rpm2thrust)
    return jnp.where(force <= 0, 0.0, rotor_vel)  # NaN passes through, so that it is flagged
