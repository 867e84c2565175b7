"""Ground effect: rotors near the floor push more at the same speed."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.effects.core import Simulation, as_setting, install, require_rotors
from crazysim.pytree import PyTree, leaf


class GroundEffect(PyTree):
    """What the gain in thrust depends on; nothing of it changes with time."""

    propeller_radius: Array = leaf("parameter", 1, (1,))
    """Radius of a propeller, m. (1,)"""
    rotor_pos: Array = leaf("parameter", 2)
    """Places of the rotors, body frame, m. (n_rotors, 3)"""


def add(sim: Simulation, propeller_radius: Any = None) -> None:
    """Let the thrust of every rotor grow as it comes near the floor, at z = 0.

    Args:
        sim: The simulation, with first-principles dynamics.
        propeller_radius: Radius of a propeller, m; None for the airframe's. () or (n_worlds, n_drones)

    Raises:
        ConfigError: If a setting cannot be, the dynamics have no rotors, or the effect is on already.
    """
    require_rotors(sim, "ground effect")
    if propeller_radius is None:
        propeller_radius = sim.airframe.value("shape.propeller_radius", ())
    radius = as_setting(sim, "propeller_radius", propeller_radius, positive=True)
    rotor_pos = jnp.asarray(sim.airframe.value("rotors.position"), radius.dtype)
    install(sim, "ground_effect", GroundEffect(radius, rotor_pos), influence=lift)


def lift(data: SimData) -> SimData:
    """Return the data with the thrust curves that rotors have at their present height."""
    record, s, p = data.plugins["ground_effect"], data.states, data.params
    height = s.pos[..., 2:] + rotation.rotate(s.quat[..., None, :], record.rotor_pos)[..., 2]
    upright = rotation.z_axis(s.quat)[..., 2:]
    gain = thrust_gain(height, upright, record.propeller_radius)
    return data.replace(params=p.replace(rpm2thrust=gain[..., None] * p.rpm2thrust))


def thrust_gain(height: Array, upright: Array, radius: Array) -> Array:
    """Return the thrust of rotors near the ground over that far from it, at the same speed, 1.

    ``1 / (1 - (R / 4 z)^2)`` (Cheeseman and Bennett 1955, ARC R&M 3021, for hover). Their image source has a pole at
    z = R / 4; here ``z^2 + R^2 / 4`` stands in for ``z^2``, so that the gain ends at 4/3 on the floor, and is 1.3 %
    below theirs at z = R, less farther up. Tilting takes the effect away with the cosine of the tilt. Both are
    assumptions.

    Args:
        height: Height of the rotors above the floor, m; below zero counts as zero. (..., n_rotors)
        upright: Cosine of the tilt; below zero, upside down, there is no gain. (..., 1)
        radius: Radius of a propeller, m. (..., 1)
    """
    height = jnp.where(height > 0, height, 0.0)
    upright = jnp.where(upright > 0, upright, 0.0)
    return 1 / (1 - upright * (radius * radius / 16) / (height * height + radius * radius / 4))
