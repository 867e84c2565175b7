"""Wrenches within the limits of the rotors, by priority: roll and pitch torque, then thrust, then yaw torque."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim.control.allocation import AllocationParams
from crazysim.control.core import where_present
from crazysim.rotation import matvec, safe_clip

BOUNDLESS = 1e9
"""Collective thrust beyond any rotor's limit, N."""


def prioritized_wrench(wrench: Array, *, params: AllocationParams) -> Array:
    """Return the wrench nearest to a desired one, by priority, that every rotor can give.

    ``force_torque2rotor_vel`` clips each rotor on its own, which changes the torque. Roll and pitch decide where the
    thrust points and yaw does not, so that order of priority keeps a saturated drone stable (Faessler, Falanga and
    Scaramuzza 2017): roll and pitch torque are scaled down only if no collective thrust makes room for
    them, the collective thrust is moved to where they fit, and the yaw torque gets the rest. Rotors are never switched
    off. A wrench within the limits is returned unchanged.

    Args:
        wrench: Collective thrust, N, and body torque, N m. (..., 4)
        params: Parameters of the allocation, shared or with the leading axes of the wrench.

    Returns:
        Collective thrust, N, and body torque, N m. (..., 4)
    """
    p = params
    low, high = p.thrust_min, p.thrust_max
    lift = p.allocation_matrix[..., 0]  # thrust of each rotor per collective thrust, positive
    tilt = matvec(p.allocation_matrix[..., 1:3], wrench[..., 1:3] / p.arms[..., :2])
    turn = p.allocation_matrix[..., 3] * (wrench[..., 3:] / p.arms[..., 2:])

    # Rotor i needs low <= lift_i F + s tilt_i <= high. Two rotors agree on F if s is at most their room over the need.
    # Rotors that a drone lacks have no limits.
    lift = where_present(p.rotors, lift, 1.0)
    most, least = where_present(p.rotors, high / lift, BOUNDLESS), where_present(p.rotors, low / lift, -BOUNDLESS)
    ratio = tilt / lift
    need = ratio[..., :, None] - ratio[..., None, :]
    room = most[..., :, None] - least[..., None, :]
    scale = jnp.min(jnp.where(need > room, room / jnp.where(need > room, need, 1.0), 1.0), axis=(-2, -1))[..., None]
    tilt = scale * tilt
    least = jnp.max(where_present(p.rotors, (low - tilt) / lift, -BOUNDLESS), axis=-1, keepdims=True)
    most = jnp.min(where_present(p.rotors, (high - tilt) / lift, BOUNDLESS), axis=-1, keepdims=True)
    force = safe_clip(wrench[..., :1], least, jnp.maximum(most, least))

    thrusts = lift * force + tilt
    limit = jnp.where(turn > 0, high, low)
    over = (turn > 0) & (thrusts + turn > high) | (turn < 0) & (thrusts + turn < low)
    share = jnp.where(over, (limit - thrusts) / jnp.where(over, turn, 1.0), 1.0)
    yaw_scale = jnp.maximum(jnp.min(share, axis=-1, keepdims=True), 0.0)
    return jnp.concatenate([force, scale * wrench[..., 1:3], yaw_scale * wrench[..., 3:]], axis=-1)
