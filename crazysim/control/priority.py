"""Rotor thrusts and wrenches within the limits of the rotors, by priority: roll and pitch, then thrust, then yaw."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax.numpy as jnp
from jax import Array

from crazysim.control.allocation import AllocationParams
from crazysim.control.levels import mask_rotors
from crazysim.rotation import clip, matvec

UNLIMITED_THRUST = 1e9
"""Collective thrust that is larger than the limit of any drone, N."""


def prioritized_wrench(wrench: Array, *, params: AllocationParams) -> Array:
    """Return a desired wrench limited to what the rotors can give, with the priority of ``prioritized_thrusts``.

    A wrench is returned unchanged if the rotors can give it, and could also give it with the opposite yaw torque.

    Args:
        wrench: Collective thrust, N, and body torque, N m. (..., 4)
        params: Parameters of the allocation, shared or with the leading axes of the wrench.

    Returns:
        Collective thrust, N, and body torque, N m. (..., 4)
    """
    force, scale, yaw_force, _ = _prioritize(wrench, params)
    return jnp.concatenate([force, scale * wrench[..., 1:3], yaw_force * params.torque_arms[..., 2:]], axis=-1)


def prioritized_thrusts(wrench: Array, *, params: AllocationParams) -> Array:
    """Return rotor thrusts within their limits that give a desired wrench by priority, N. (..., n_rotors)

    ``force_torque2rotor_vel`` clips each rotor independently, which changes the torque. Here roll and pitch torque have
    the highest priority, because they determine the direction of the thrust. This keeps a drone with saturated rotors
    stable (Faessler, Falanga and Scaramuzza 2017). Roll and pitch torque are scaled down only if the rotors cannot give
    them at any collective thrust. The collective thrust is clipped to the range in which the rotors can give roll and
    pitch torque. The yaw torque is limited to what the remaining range of every rotor allows in both directions. Rotors
    are never switched off.

    Roll and pitch torque raise the collective thrust at most to the weight. Without this limit, rotors that can carry
    ten times the weight would accelerate the drone upwards while they turn it.

    The scale of roll and pitch torque is the largest possible scale if all rotors carry the same fraction of the
    collective thrust and the weight does not limit it. Otherwise it may be smaller.

    Args:
        wrench: Collective thrust, N, and body torque, N m. (..., 4)
        params: Parameters of the allocation, shared or with the leading axes of the wrench.
    """
    force, scale, yaw_force, tilt_thrusts = _prioritize(wrench, params)
    lift_shares, yaw_shares = params.allocation_matrix[..., 0], params.allocation_matrix[..., 3]
    return lift_shares * (force + scale * tilt_thrusts) + yaw_shares * yaw_force


def _prioritize(wrench: Array, params: AllocationParams) -> tuple[Array, Array, Array, Array]:
    p = params
    # Thrust of each rotor divided by the collective thrust, positive.
    lift_shares = mask_rotors(p.rotors, p.allocation_matrix[..., 0], 1.0)
    # Largest change of a rotor's thrust over its lift share, per yaw force.
    max_yaw_share = _reduce_rotors(jnp.maximum, jnp.abs(p.allocation_matrix[..., 3] / lift_shares))
    tilt_thrusts = matvec(
        p.allocation_matrix[..., 1:3] / lift_shares[..., None] / p.torque_arms[..., None, :2], wrench[..., 1:3]
    )

    # The thrust of rotor i is lift_shares_i (F + s tilt_thrusts_i), with the collective thrust F and the scale s of
    # roll and pitch torque. It is within its limits if low_i <= F + s tilt_thrusts_i <= high_i. Rotors that the drone
    # lacks get limits that allow any F.
    low = mask_rotors(p.rotors, p.thrust_min / lift_shares, -UNLIMITED_THRUST)
    high = mask_rotors(p.rotors, p.thrust_max / lift_shares, UNLIMITED_THRUST)
    low_untilted, high_untilted = _reduce_rotors(jnp.maximum, low), _reduce_rotors(jnp.minimum, high)
    low_tilted, high_tilted = (
        _reduce_rotors(jnp.maximum, low - tilt_thrusts),
        _reduce_rotors(jnp.minimum, high - tilt_thrusts),
    )
    weight = high_untilted if p.weight is None else p.weight
    force_limit = jnp.maximum(wrench[..., :1], jnp.maximum(weight, low_untilted))

    # The length of the interval of allowed F ("room") is a concave function of s. Therefore it is at least the linear
    # interpolation between s = 0, where it is positive, and s = 1. The scale is 1 if the room at s = 1 is not negative,
    # and otherwise the s at which the interpolation is zero.
    room_untilted, room_tilted = (
        jnp.minimum(high_untilted, force_limit) - low_untilted,
        jnp.minimum(high_tilted, force_limit) - low_tilted,
    )
    scale = room_untilted / jnp.maximum(room_untilted - jnp.minimum(room_tilted, 0.0), 1 / UNLIMITED_THRUST)
    force_low = low_untilted + scale * (low_tilted - low_untilted)
    force = clip(
        wrench[..., :1], force_low, jnp.where(room_tilted < 0, force_low, jnp.minimum(high_tilted, force_limit))
    )

    yaw_room = jnp.maximum(jnp.minimum(force - force_low, high_tilted - force), 0.0) / max_yaw_share
    return force, scale, clip(wrench[..., 3:] / p.torque_arms[..., 2:], -yaw_room, yaw_room), tilt_thrusts


def _reduce_rotors(function: Callable[[Array, Array], Array], x: Array) -> Array:
    # The gradient of ``jnp.max`` divides by the number of entries that equal the result. Where XLA computes the entries
    # twice, with different rounding, that number may be zero.
    return functools.reduce(function, [x[..., k : k + 1] for k in range(x.shape[-1])])
