"""Downwash: the jet of air below every drone, and what it does to the drones in it."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.stage import stage
from crazysim.dynamics import first_principles
from crazysim.dynamics.rotor import curve
from crazysim.effects.core import Simulation, as_setting, blown_upon, install, require_drag, zeros
from crazysim.pytree import PyTree, leaf

DECAY, SPREAD = 5.8, 0.094
"""Velocity decay constant B and spreading rate S of a round turbulent jet, 1 (Hussein, Capp and George 1994; Pope,
Turbulent Flows, 2000, table 5.1)."""
AIR_DENSITY = 1.225
"""Density of air at sea level, kg/m^3 (ISO 2533)."""


class Downwash(PyTree):
    """Velocity of the air that the other drones of its world blow at every drone."""

    diameter: Array = leaf("parameter", 1, (1,))
    """Diameter of the jet of a drone where it is fully contracted, m. (1,)"""
    air_density: Array = leaf("parameter", 1, (1,))
    """Density of air, kg/m^3. (1,)"""
    air_vel: Array = leaf("drone", 1)
    """Velocity of the air that others blow at the drone, world frame, m/s. (n_worlds, n_drones, 3)"""


def add(sim: Simulation, propeller_radius: Any = None, air_density: Any = AIR_DENSITY) -> None:
    """Let drones feel the downwash of the others of their world, as drag of their velocity relative to the air.

    Args:
        sim: The simulation; its model must have drag.
        propeller_radius: Radius of a propeller, m; None for the airframe's. () or (n_worlds, n_drones)
        air_density: Density of air, kg/m^3. () or (n_worlds, n_drones)

    Raises:
        ConfigError: If a setting cannot be, the model has no drag, or there is downwash already.
    """
    require_drag(sim, "downwash")
    if propeller_radius is None:
        propeller_radius = sim.airframe.value("shape.propeller_radius", ())
    radius = as_setting(sim, "propeller_radius", propeller_radius, positive=True)
    density = as_setting(sim, "air_density", air_density, positive=True)
    # Far below a rotor its stream has half the area of its disc (momentum theory).
    record = Downwash(math.sqrt(2 * sim.airframe.n_rotors) * radius, density, zeros(sim, 3))
    install(sim, "downwash", record, downwash, drag_in_downwash)


def drag_in_downwash(data: SimData) -> SimData:
    """Return the data with the force that the air from other drones adds to the drag."""
    return blown_upon(data, data.plugins["downwash"].air_vel)


@stage("world")
def downwash(data: SimData) -> SimData:
    """Sum up the jets of all drones of one world at each of them; none reaches its own drone."""
    record, s = data.plugins["downwash"], data.states
    axis = rotation.z_axis(s.quat)
    apart = s.pos[:, None] - s.pos[None]
    speed = jet(apart, axis, collective_thrust(data), record.diameter, record.air_density)
    air_vel = jnp.sum(-speed * axis, axis=1)
    return data.replace(plugins=data.plugins | {"downwash": record.replace(air_vel=air_vel)})


def jet(apart: Array, axis: Array, thrust: Array, diameter: Array, air_density: Array) -> Array:
    """Return the speed of the air in the jet of a hovering drone, m/s.

    From 2.5 drone diameters downwards the mean flow below a quadrotor is that of one round turbulent jet (Bauersfeld
    et al., Robotics meets Fluid Dynamics, RA-L 2025), whose speed falls as one over the distance and whose profile
    keeps its shape (Pope 2000, sections 5.1 and 5.2):

        u = u_0 / (1 + s / (B d)) / (1 + (sqrt(2) - 1) (r / b)^2)^2,  b = S (s + B d)

    at s below the rotors and r off their axis. Momentum theory gives the speed at the start, ``u_0^2 = 4 T / (pi rho
    d^2)`` with d the diameter of the contracted stream. That the virtual origin lies where the speed of the jet is u_0
    in the plane of the rotors, is an assumption, and so is the smooth start from nothing within one diameter below.
    Above the drone there is no jet.

    Args:
        apart: Place relative to the drone, world frame, m. (..., 3)
        axis: The drone's body z axis, along which it thrusts, world frame. (..., 3)
        thrust: Its collective thrust, N; below zero counts as none. (..., 1)
        diameter: Diameter d of its contracted stream, m. (..., 1)
        air_density: Density of air, kg/m^3. (..., 1)

    Returns:
        Speed against the axis. (..., 1)
    """
    below = -rotation.dot(apart, axis)
    off_axis = apart + below * axis
    pushes = thrust > 0
    start = jnp.sqrt(jnp.where(pushes, thrust, 1.0) * 4 / (math.pi * air_density)) / diameter
    # Only below: above, the distance to the virtual origin would pass through zero.
    down = jnp.where(below > 0, below, 0.0)
    half_width = SPREAD * (down + DECAY * diameter)
    profile = 1 + (math.sqrt(2) - 1) * rotation.dot(off_axis, off_axis) / (half_width * half_width)
    x = rotation.safe_clip(below / diameter, 0.0, 1.0)
    begins = x * x * (3 - 2 * x)
    speed = begins * start / ((1 + down / (DECAY * diameter)) * profile * profile)
    return jnp.where(pushes, speed, 0.0)


def collective_thrust(data: SimData) -> Array:
    """Return what the rotors of a drone push by now, N: from their speeds, or as the fitted model has it. (..., 1)"""
    p: Any = data.params
    rotor_vel = data.states.rotor_vel
    if isinstance(p, first_principles.Params):
        return jnp.sum(curve(rotor_vel, p.rpm2thrust), axis=-1, keepdims=True)
    thrust = data.controls.attitude.cmd[..., 3:] if p.thrust_dyn_coef is None else rotor_vel[..., :1]
    return p.acc_coef + p.cmd_f_coef * thrust
