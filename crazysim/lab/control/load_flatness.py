"""Differential flatness of a drone with a point load: states and inputs from the path of the load.

The load's position and the yaw are a flat output (Sreenath, Lee and Kumar 2013). With the load's mass m_L, the drone's
mass m and the rod's length L, the tension is ``T q = -m_L (x_L'' - g)``. So the load's acceleration gives the direction
q of the rod, and the next two derivatives of the path give q' and q''. The drone is at ``x = x_L - L q``, with the
thrust ``F = m (x'' - g) + m_L (x_L'' - g)``. The drone's jerk and snap need the fifth and sixth derivative of the path.
"""

from __future__ import annotations

from math import comb
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.control.flatness import attitude_of_thrust
from crazysim.eager import jit_eager_calls

MAX_ORDER = 6
"""Highest derivative of the load's path that is needed."""


class LoadedState(NamedTuple):
    """States and inputs of a drone that carries a load along a path, with the leading axes of the path."""

    pos: Array
    """Position of the drone, world frame, m. (..., 3)"""
    vel: Array
    """Velocity of the drone, m/s. (..., 3)"""
    acc: Array
    """Acceleration of the drone, m/s^2. (..., 3)"""
    direction: Array
    """Unit vector from drone to load. (..., 3)"""
    direction_rate: Array
    """Rate of the direction, 1/s. (..., 3)"""
    quat: Array
    """Attitude, body to world, xyzw. (..., 4)"""
    ang_vel: Array
    """Angular velocity, body frame, rad/s. (..., 3)"""
    ang_acc: Array
    """Angular acceleration, body frame, rad/s^2. (..., 3)"""
    tension: Array
    """Tension of the rod, N. (..., 1)"""
    thrust: Array
    """Collective thrust, N. (..., 1)"""
    torque: Array
    """Torque, body frame, N m. (..., 3)"""


@jit_eager_calls()
def load_flat_state(
    path: Array, yaw: Array, mass: Array, load_mass: Array, length: Array, inertia: Array, gravity_vec: Array
) -> LoadedState:
    """Solve for states and inputs with which a drone carries a point load along a path.

    The rod is attached at the drone's centre of mass. Where thrust and yaw do not determine the attitude, it is as in
    ``control.flatness.attitude_of_thrust``. For a load in free fall, which has no tension and no direction, the results
    are not finite.

    Args:
        path: Position of the load and its time derivatives up to the sixth, world frame, m, m/s, ... (..., 7, 3)
        yaw: Heading and its first two derivatives, rad, rad/s, rad/s^2. (..., 3)
        mass: Mass of the drone, kg. ()
        load_mass: Mass of the load, kg. ()
        length: Length of the rod, m. ()
        inertia: Inertia of the drone, body frame, kg m^2. (3, 3)
        gravity_vec: Gravitational acceleration, world frame, m/s^2. (3,)
    """
    gravity_derivatives = [gravity_vec, 0.0, 0.0, 0.0, 0.0]
    pull = [load_mass * (path[..., 2 + k, :] - g) for k, g in enumerate(gravity_derivatives)]
    tension, rod_axis = _norm_and_direction(pull)  # axis from load to drone
    pos = [path[..., k, :] + length * rod_axis[k] for k in range(MAX_ORDER - 1)]
    force = [mass * (pos[2 + k] - g) + pull[k] for k, g in enumerate(gravity_derivatives[:3])]
    specific_thrust, first_derivative, second_derivative = (f / mass for f in force)
    attitude = attitude_of_thrust(
        specific_thrust, first_derivative, second_derivative, yaw[..., :1], yaw[..., 1:2], yaw[..., 2:]
    )
    momentum = rotation.matvec(inertia, attitude.ang_vel)
    return LoadedState(
        pos=pos[0],
        vel=pos[1],
        acc=pos[2],
        direction=-rod_axis[0],
        direction_rate=-rod_axis[1],
        quat=rotation.quat_from_axes(*(attitude.matrix[..., k] for k in range(3))),
        ang_vel=attitude.ang_vel,
        ang_acc=attitude.ang_acc,
        tension=tension,
        thrust=jnp.linalg.norm(force[0], axis=-1, keepdims=True),
        torque=rotation.matvec(inertia, attitude.ang_acc) + rotation.cross(attitude.ang_vel, momentum),
    )


def _norm_and_direction(vector: list[Array]) -> tuple[Array, list[Array]]:
    # The equations ``norm norm = vector . vector`` and ``norm direction = vector`` are differentiated by Leibniz' rule
    # and solved for the highest derivatives.
    norms: list[Array] = [jnp.linalg.norm(vector[0], axis=-1, keepdims=True)]
    directions = [vector[0] / norms[0]]
    for n in range(1, len(vector)):
        square = sum(comb(n, k) * rotation.dot(vector[k], vector[n - k]) for k in range(n + 1))
        square = square - sum(comb(n, k) * norms[k] * norms[n - k] for k in range(1, n))
        norms.append(square / (2 * norms[0]))
        remainder = vector[n] - sum(comb(n, k) * norms[k] * directions[n - k] for k in range(1, n + 1))
        directions.append(remainder / norms[0])
    return norms[0], directions
