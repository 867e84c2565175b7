"""State of a ground vehicle, and quantities that follow from it."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from crazysim import rotation
from crazysim.eager import jit_eager_calls


class CarState(NamedTuple):
    """State of one vehicle on level ground, with any leading axes."""

    pos: Array
    """Position of the centre of mass, world frame, m. (..., 3)"""
    yaw: Array
    """Heading, rad, not wrapped. (..., 1)"""
    body_vel: Array
    """Forward and left velocity of the centre of mass, body frame, m/s. (..., 2)"""
    yaw_rate: Array
    """Rate of the heading, rad/s. (..., 1)"""
    steer: Array
    """Steering angle of a wheel in the middle of the front axle, rad, positive to the left. (..., 1)"""
    distance: Array
    """Distance that the wheels rolled, m; backwards it decreases. (..., 1)"""
    joints: Array | None = None
    """Headings of drawbar and trailer, rad, not wrapped; None without a trailer. (..., 2)"""


def heading_quat(yaw: Array) -> Array:
    """Return the rotation about z by an angle, (..., 1), as a quaternion, xyzw. (..., 4)"""
    zero = jnp.zeros_like(yaw)
    return jnp.concatenate([zero, zero, jnp.sin(yaw / 2), jnp.cos(yaw / 2)], axis=-1)


@jit_eager_calls()
def tilted_quat(yaw: Array, normal: Array) -> Array:
    """Return the attitude of a vehicle on a slope: turned by its heading, then by the tilt of the ground. (..., 4)

    Args:
        yaw: Heading, rad. (..., 1)
        normal: Unit normal of the ground, upwards. (..., 3)
    """
    x, y, z = normal[..., :1], normal[..., 1:2], normal[..., 2:]
    tilt = jnp.concatenate([-y, x, jnp.zeros_like(x), 1 + z], axis=-1)
    tilt = tilt * lax.rsqrt(jnp.sum(tilt * tilt, axis=-1, keepdims=True))
    return rotation.multiply(tilt, heading_quat(yaw))


def to_world_frame(yaw: Array, vector: Array) -> Array:
    """Return a level vector of the body frame, (..., 2), in the world frame. (..., 2)"""
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    x, y = vector[..., :1], vector[..., 1:]
    return jnp.concatenate([cos * x - sin * y, sin * x + cos * y], axis=-1)


def to_body_frame(yaw: Array, vector: Array) -> Array:
    """Return a level vector of the world frame, (..., 2), in the body frame. (..., 2)"""
    return to_world_frame(-yaw, vector)


def ackermann(steer: Array, wheelbase: float, kingpin_track: float) -> Array:
    """Steer left and right wheel so that the axes of all wheels meet in one point; return the angles, rad. (..., 2)

    ``tan(left) = L tan / (L - (t / 2) tan)`` and ``tan(right) = L tan / (L + (t / 2) tan)`` where tan is the tangent of
    the steering angle in the middle, L the wheelbase and t the distance of the kingpins.

    Args:
        steer: Steering angle of a wheel in the middle, rad, positive to the left. (..., 1)
        wheelbase: Distance of the axles, m.
        kingpin_track: Distance of the kingpins, m.
    """
    tan = jnp.tan(steer)
    wheelbase_tan, half_track_tan = wheelbase * tan, kingpin_track / 2 * tan
    return jnp.concatenate(
        [
            jnp.arctan2(wheelbase_tan, wheelbase - half_track_tan),
            jnp.arctan2(wheelbase_tan, wheelbase + half_track_tan),
        ],
        axis=-1,
    )
