"""Ground effect: rotors near the floor give more thrust at the same speed."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Plugin, Simulation, airframe_numbers, parameter
from crazysim.drones import Airframe
from crazysim.plugins.effects.ground import ground_below
from crazysim.plugins.effects.moving_air import checked_propeller_radius, require_rotors
from crazysim.pytree import PyTree, device_array, leaf


class GroundEffectData(PyTree):
    """Parameters of the gain in thrust, constant in time."""

    propeller_radius: Array = leaf("parameter", 1, (1,))
    """Radius of a propeller, m. (1,)"""
    rotor_pos: Array = leaf("parameter", 2)
    """Positions of the rotors, body frame, m. (n_rotors, 3)"""


class GroundEffect(Plugin):
    """Increase of every rotor's thrust near the ground, flat floor or terrain; needs rotors."""

    propeller_radius: ArrayLike | None = parameter(default=None, positive=True)
    """Radius of a propeller, m; None for the airframe's. () or (n_worlds, n_drones)"""
    name: str = "ground_effect"

    @property
    def replaced_terms(self) -> tuple[str, ...]:
        return ("ground effect",)

    def record(self, sim: Simulation) -> GroundEffectData:
        require_rotors(sim, "ground effect")
        radius = checked_propeller_radius(sim, self.propeller_radius)
        return GroundEffectData(radius, rotor_positions(sim))

    def influence(self, data: SimData) -> SimData:
        record, s, p = self.read(data), data.states, data.params
        height = s.pos[..., 2:] - ground_below(data) + rotation.rotate(s.quat[..., None, :], record.rotor_pos)[..., 2]
        upright = rotation.z_axis(s.quat)[..., 2:]
        gain = thrust_gain(height, upright, record.propeller_radius)
        return data.replace(params=p.replace(rpm2thrust=gain[..., None] * p.rpm2thrust))


def rotor_positions(sim: Simulation) -> Array:
    """Return the positions of the rotors, body frame, m; zero for rotors that a drone lacks. (..., n_rotors, 3)"""
    n_rotors = sim.data.states.rotor_vel.shape[-1]

    def read_airframe(airframe: Airframe) -> np.ndarray:
        positions = airframe.value("rotors.position")
        return np.pad(positions, [(0, n_rotors - len(positions)), (0, 0)])  # missing rotors have no thrust

    return device_array(airframe_numbers(sim, read_airframe), sim.data.states.pos.dtype)


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
