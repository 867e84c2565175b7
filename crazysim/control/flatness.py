"""Differential flatness: attitude, body rates and angular acceleration from a changing thrust vector and yaw."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.rotation import cross, dot

MIN_HEADING_SINE = 0.05
"""Sine of the angle between thrust and heading below which the body rate about z is limited.

As the angle approaches zero, the heading no longer determines the attitude, and the body rate that holds the heading
grows without bound. The limit takes effect below 3 degrees.
"""

MIN_SPECIFIC_THRUST = 1e-3
"""Thrust over mass below which the direction of the thrust is undefined, m/s^2. Hover needs 9.8."""


class Attitude(NamedTuple):
    """Attitude, angular velocity and angular acceleration."""

    matrix: Array
    """Rotation matrix, body to world. (..., 3, 3)"""
    ang_vel: Array
    """Angular velocity, body frame, rad/s. (..., 3)"""
    ang_acc: Array
    """Angular acceleration, body frame, rad/s^2. (..., 3)"""


def attitude_of_thrust(
    specific_thrust: Array,
    specific_thrust_rate: Array,
    specific_thrust_acc: Array,
    yaw: Array,
    yaw_rate: Array,
    yaw_acc: Array,
) -> Attitude:
    """Return the attitude with the z axis along a thrust vector and the x axis as close as possible to a heading.

    The angular velocity and acceleration follow from the derivatives of thrust and heading.

    With the thrust ``f``, the heading ``c = (cos yaw, sin yaw, 0)`` and ``l = e_z x c``, the axes are ``z = f / |f|``,
    ``y = z x c / |z x c|`` and ``x = y x z`` (Mellinger and Kumar 2011). The body rates ``w`` about x and y follow from
    ``z' = w_y x - w_x y``. The rate about z follows from the derivative of ``y . c = 0``:

        w_z x.c = w_x z.c + yaw' y.l

    The derivatives of these equations give the angular acceleration.

    A specific thrust below ``MIN_SPECIFIC_THRUST`` is replaced by a constant vertical thrust. Where thrust and heading
    are parallel, y is ``l``. Where they are nearly parallel, the rate about z is limited (``MIN_HEADING_SINE``).

    Args:
        specific_thrust: Thrust vector over the mass, world frame, m/s^2. (..., 3)
        specific_thrust_rate: First derivative of the specific thrust, m/s^3. (..., 3)
        specific_thrust_acc: Second derivative of the specific thrust, m/s^4. (..., 3)
        yaw: Heading, rad. (..., 1)
        yaw_rate: First derivative of the heading, rad/s. (..., 1)
        yaw_acc: Second derivative of the heading, rad/s^2. (..., 1)
    """
    forward, left = rotation.heading_axes(yaw)
    z, z_rate, z_acc = thrust_direction(specific_thrust, specific_thrust_rate, specific_thrust_acc)
    z_cross_forward = cross(z, forward)
    y = jnp.where(dot(z_cross_forward, z_cross_forward) < 1e-10, left, rotation.safe_normalize(z_cross_forward, left))
    x = rotation.safe_normalize(cross(y, z), forward)  # changes nothing unless thrust and heading are parallel

    x_forward = jnp.maximum(dot(x, forward), MIN_HEADING_SINE)
    z_forward, y_left, x_left, z_left = dot(z, forward), dot(y, left), dot(x, left), dot(z, left)
    wx, wy = -dot(y, z_rate), dot(x, z_rate)
    wz = (wx * z_forward + yaw_rate * y_left) / x_forward
    wx_rate, wy_rate = wy * wz - dot(y, z_acc), dot(x, z_acc) - wx * wz
    heading_terms = z_forward * (wx_rate + wy * wz) + 2 * yaw_rate * (wx * z_left - wz * x_left) + yaw_acc * y_left
    wz_rate = wx * wy + heading_terms / x_forward
    ang_vel = jnp.concatenate([wx, wy, wz], axis=-1)
    ang_acc = jnp.concatenate([wx_rate, wy_rate, wz_rate], axis=-1)
    return Attitude(jnp.stack([x, y, z], axis=-1), ang_vel, ang_acc)


def thrust_direction(
    specific_thrust: Array, specific_thrust_rate: Array, specific_thrust_acc: Array
) -> tuple[Array, Array, Array]:
    """Return the unit vector along a thrust vector, with its first two derivatives.

    Where the specific thrust is below ``MIN_SPECIFIC_THRUST``, the unit vector is e_z with derivatives of zero.

    Args:
        specific_thrust: Thrust vector over the mass, m/s^2. (..., 3)
        specific_thrust_rate: First derivative of the specific thrust, m/s^3. (..., 3)
        specific_thrust_acc: Second derivative of the specific thrust, m/s^4. (..., 3)

    Returns:
        Unit vector, its first derivative, 1/s, and its second derivative, 1/s^2. (..., 3) each
    """
    is_undefined = dot(specific_thrust, specific_thrust) < MIN_SPECIFIC_THRUST**2
    inverse = jnp.where(is_undefined, 0.0, 1 / rotation.safe_norm(jnp.where(is_undefined, 1.0, specific_thrust)))
    z = jnp.where(is_undefined, jnp.asarray([0.0, 0.0, 1.0], specific_thrust.dtype), specific_thrust * inverse)
    # ``growth`` is the relative rate of change of the thrust's magnitude, 1/s.
    growth = dot(z, specific_thrust_rate) * inverse
    z_rate = specific_thrust_rate * inverse - growth * z
    growth_rate = (dot(z_rate, specific_thrust_rate) + dot(z, specific_thrust_acc)) * inverse
    return z, z_rate, specific_thrust_acc * inverse - 2 * growth * z_rate - growth_rate * z
