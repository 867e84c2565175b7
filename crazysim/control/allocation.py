"""Control allocation, the last step of the cascade: from a wrench to rotor speeds."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.control.levels import allocation_matrix
from crazysim.drones import Airframe
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.dynamics.models import AirframeParams
from crazysim.dynamics.rotor import rotor_vel_of_thrust
from crazysim.engine.pytree import leaf
from crazysim.rotation import clip, matvec


class AllocationParams(AirframeParams):
    """Parameters of the allocation, each shared by all drones or with one value per drone."""

    thrust_min: Array = leaf("parameter", 1, (1,), airframe="rotors.thrust_min")
    """Minimum thrust of a rotor that is on, N. (1,)"""
    thrust_max: Array = leaf("parameter", 1, (1,), airframe="rotors.thrust_max")
    """Maximum thrust of one rotor, N. (1,)"""
    torque_arms: Array = leaf("parameter", 1, (3,), airframe=lambda airframe: torque_arms(airframe))
    """Torque per thrust about x and y (the arm) and about z (drag torque over thrust), m. (3,)"""
    rpm2thrust: Array = leaf("parameter", 2, airframe="rotors.thrust_curve")
    """Coefficients of the thrust curve that the controller assumes, N, N/rpm, N/rpm^2. (1, 3)"""
    allocation_matrix: Array = leaf("parameter", 2, airframe=allocation_matrix)
    """Matrix from collective thrust, and torque divided by ``torque_arms``, to rotor thrusts, 1. (n_rotors, 4)"""
    rotors: Array | None = leaf("parameter", 1, default=None)
    """True for the rotors that the drone has; None if all drones have the same number of rotors. (n_rotors,)"""
    weight: Array | None = leaf("parameter", 1, (1,), default=None)
    """Weight, N, to which roll and pitch torque may raise the collective thrust in ``crazysim.control.priority``; None
    for no such limit. (1,)"""


def hover_rotor_vel(airframe: Airframe) -> np.ndarray:
    """Solve for the rotor speeds at which all rotors lift equal shares of the weight, rpm.

    Returns:
        (1,), or (n_rotors,) if each rotor has its own thrust curve
    """
    thrust = float(airframe.value("rigid_body.mass", ())) * GRAVITY_MAGNITUDE / airframe.n_rotors
    return airframe.rotor_vel([thrust])


def max_thrust_without_torque(airframe: Airframe) -> float:
    """Return the collective thrust without torque, N, at which the most loaded rotor is at its maximum thrust."""
    return float(airframe.value("rotors.thrust_max", ()) / np.max(allocation_matrix(airframe)[:, 0]))


def torque_arms(airframe: Airframe) -> np.ndarray:
    """Return the torque per thrust about x, y and z, m. (3,)

    The third entry is the value ``controller.thrust2torque`` of the airframe, or ``yaw_arm`` if there is no such value.
    """
    thrust2torque = airframe.values.get("controller.thrust2torque")
    return np.array([airframe.arm, airframe.arm, yaw_arm(airframe) if thrust2torque is None else float(thrust2torque)])


def yaw_arm(airframe: Airframe) -> float:
    """Return the change of a rotor's drag torque per change of its thrust around hover, m, averaged over the rotors."""
    hover = hover_rotor_vel(airframe)
    slopes = []
    for key in ("torque_curve", "thrust_curve"):
        _, k1, k2 = np.atleast_2d(airframe.value(f"rotors.{key}")).T
        slopes.append(k1 + 2 * k2 * hover)
    return float(np.mean(slopes[0] / slopes[1]))


def hover_torque_arms(airframe: Airframe) -> np.ndarray:
    """Return the torque per thrust about x, y and z around hover, m, with ``yaw_arm`` as the third entry. (3,)"""
    return np.array([airframe.arm, airframe.arm, yaw_arm(airframe)])


def wrench_matrix(airframe: Airframe) -> np.ndarray:
    """Return the matrix from rotor thrusts to collective thrust, 1, and torque around hover, m. (4, n_rotors)"""
    return np.vstack([np.ones(airframe.n_rotors), hover_torque_arms(airframe)[:, None] * airframe.mixing_matrix])


def force_torque2rotor_vel(cmd: Array, *, params: AllocationParams) -> Array:
    """Allocate a wrench to rotor speeds, rpm, each within its limits. (..., n_rotors)

    The wrench is allocated with the least-norm inverse of the mixing matrix. Each rotor thrust is then clipped
    independently, as in Crazyflow. The Crazyflie firmware instead lowers all motors by the excess of the highest motor,
    which keeps the torque; see ``crazysim.control.power_distribution``. If the collective thrust is zero or less, the
    motors are off.

    Args:
        cmd: Collective thrust, N, and body torque, N m. (..., 4)
        params: Parameters, shared or with the same leading axes as the command.
    """
    p = params
    force = cmd[..., :1]
    thrusts = matvec(p.allocation_matrix, jnp.concatenate([force, cmd[..., 1:] / p.torque_arms], axis=-1))
    rotor_vel = rotor_vel_of_thrust(clip(thrusts, p.thrust_min, p.thrust_max), p.rpm2thrust)
    return jnp.where(force <= 0, 0.0, rotor_vel)  # a NaN remains, so that the world is flagged as non-finite
