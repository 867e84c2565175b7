"""Ground effect: rotors near the floor give more thrust at the same speed."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Plugin, param
from crazysim.plugins.effects.ground import ground_below
from crazysim.plugins.effects.moving_air import needs_rotors


class GroundEffect(Plugin, replaces=("ground effect",), requires=needs_rotors):
    """Increase of every rotor's thrust near the ground, flat floor or terrain; needs rotors."""

    propeller_radius: Param = param(default=None, airframe="shape.propeller_radius", positive=True)
    """Radius of a propeller, m; None for the airframe's. (1,)"""
    rotor_pos: Param = param(default=None, core=("rotors", 3), airframe="rotors.position")
    """Positions of the rotors, body frame, m; None for the airframe's. (n_rotors, 3)"""
    name: str = "ground_effect"

    def influence(self, data: SimData) -> SimData:
        s, p = data.states, data.params
        height = s.pos[..., 2:] - ground_below(data) + rotation.rotate(s.quat[..., None, :], self.rotor_pos)[..., 2]
        upright = rotation.z_axis(s.quat)[..., 2:]
        gain = thrust_gain(height, upright, self.propeller_radius)
        return data.replace(params=p.replace(rpm2thrust=gain[..., None] * p.rpm2thrust))


def thrust_gain(height: Array, upright: Array, radius: Array) -> Array:
    """Return the ratio of the rotors' thrust near the ground to their thrust far from it, at the same speed.

    ``1 / (1 - (R / 4 z)^2)`` (Cheeseman and Bennett 1955, ARC R&M 3021, for hover). Their image source has a pole at
    z = R / 4; ``z^2 + R^2 / 4`` replaces ``z^2`` here, so that the ratio is at most 4/3, on the floor. At z = R the
    ratio is 1.3 % below theirs; the difference shrinks with height. To first order, the increase is proportional to the
    cosine of the tilt. The replacement and the dependence on the tilt are assumptions.

    Args:
        height: Height of the rotors above the floor, m; negative heights are treated as zero. (..., n_rotors)
        upright: Cosine of the tilt; below zero, upside down, thrust does not increase. (..., 1)
        radius: Radius of a propeller, m. (..., 1)
    """
    height = jnp.where(height > 0, height, 0.0)
    upright = jnp.where(upright > 0, upright, 0.0)
    return 1 / (1 - upright * (radius * radius / 16) / (height * height + radius * radius / 4))
