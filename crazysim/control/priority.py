"""Rotor thrusts and wrenches within the limits of the rotors, by priority: roll and pitch, then thrust, then yaw."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax.numpy as jnp
from jax import Array

from crazysim.control.allocation import AllocationParams
from crazysim.control.levels import where_present
from crazysim.rotation import matvec, safe_clip

BOUNDLESS = 1e9
"""Collective thrust beyond any rotor's limit, N."""


def prioritized_wrench(wrench: Array, *, params: AllocationParams) -> Array:
    """Return a wrench that every rotor can give, from a desired one by the priority of ``prioritized_thrusts``.

    A wrench within the limits is returned unchanged.

    Args:
        wrench: Collective thrust, N, and body torque, N m. (..., 4)
        params: Parameters of the allocation, shared or with the leading axes of the wrench.

    Returns:
        Collective thrust, N, and body torque, N m. (..., 4)
    """
    force, scale, yaw_scale, _, _ = _prioritized(wrench, params)
    return jnp.concatenate([force, scale * wrench[..., 1:3], yaw_scale * wrench[..., 3:]], axis=-1)


def prioritized_thrusts(wrench: Array, *, params: AllocationParams) -> Array:
    """Return the thrusts within the limits of the rotors that give a desired wrench by priority, N. (..., n_rotors)

    ``force_torque2rotor_vel`` clips each rotor on its own, which changes the torque. Roll and pitch decide where the
    thrust points and yaw does not, so that order of priority keeps a saturated drone stable (Faessler, Falanga and
    Scaramuzza 2017): roll and pitch torque are scaled down only if no collective thrust makes room for
    them, the collective thrust is moved to where they fit, and the yaw torque gets the rest. Rotors are never switched
    off.

    If all rotors carry the same part of the collective thrust, roll and pitch torque keep the largest scale that fits,
    otherwise one that is at most as large.

    Args:
        wrench: Collective thrust, N, and body torque, N m. (..., 4)
        params: Parameters of the allocation, shared or with the leading axes of the wrench.
    """
    _, _, yaw_scale, thrusts, turn = _prioritized(wrench, params)
    return thrusts + yaw_scale * turn


def _prioritized(wrench: Array, params: AllocationParams) -> tuple[Array, Array, Array, Array, Array]:
    """Return collective thrust, scales of tilt and yaw torque, rotor thrusts without yaw torque, and those of yaw."""
    p = params
    low, high = p.thrust_min, p.thrust_max
    lift = p.allocation_matrix[..., 0]  # thrust of each rotor per collective thrust, positive
    tilt = matvec(p.allocation_matrix[..., 1:3], wrench[..., 1:3] / p.arms[..., :2])
    turn = p.allocation_matrix[..., 3] * (wrench[..., 3:] / p.arms[..., 2:])

    # Rotor i allows collective thrusts F with low <= lift_i F + s tilt_i <= high; one that a drone lacks, any.
    inverse = 1 / where_present(p.rotors, lift, 1.0)
    most, least = where_present(p.rotors, high * inverse, BOUNDLESS), where_present(p.rotors, low * inverse, -BOUNDLESS)
    ratio = tilt * inverse

    def bounds(scale: Array | float) -> tuple[Array, Array]:
        """Return the smallest and largest collective thrust that all rotors allow."""
        return _of_all(jnp.maximum, least - scale * ratio), _of_all(jnp.minimum, most - scale * ratio)

    # The room between the bounds is concave in s, so it is at least the chord from s = 0, where it is positive, to 1.
    (still_low, still_high), (full_low, full_high) = bounds(0.0), bounds(1.0)
    still, full = still_high - still_low, full_high - full_low
    lacks = full < 0
    scale = jnp.where(lacks, still / jnp.where(lacks, still - full, 1.0), 1.0)
    force = safe_clip(wrench[..., :1], *bounds(scale))

    thrusts = lift * force + scale * tilt
    room = jnp.where(turn > 0, high, low) - thrusts
    over = jnp.abs(turn) > jnp.abs(room)
    share = jnp.where(over, room / jnp.where(over, turn, 1.0), 1.0)
    yaw_scale = jnp.maximum(_of_all(jnp.minimum, share), 0.0)
    return force, scale, yaw_scale, thrusts, turn


def _of_all(function: Callable[[Array, Array], Array], x: Array) -> Array:
    """Return the largest or smallest entry, rotor by rotor. (..., 1)

    The gradient of ``jnp.max`` divides by the number of entries that equal the result. Where XLA computes the entries
    twice, with different rounding, that may be none.
    """
    return functools.reduce(function, [x[..., k : k + 1] for k in range(x.shape[-1])])
