"""Rotors in moving air: rotor drag, thrust that depends on the flow, flapping, and a ceiling."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Plugin, Simulation, airframe_numbers, check_parameter, derived, param
from crazysim.drones import Airframe
from crazysim.drones.airframe_estimate import AIR_DENSITY
from crazysim.dynamics.inflow import blade_coefficient, ceiling_factor, disc_factor, thrust_in_flight
from crazysim.dynamics.models import GRAVITY
from crazysim.dynamics.rotor import RPM_TO_RAD_S, quadratic_curve
from crazysim.engine.pytree import device_array
from crazysim.errors import ConfigError
from crazysim.plugins.effects.moving_air import (
    air_velocity,
    drag_factor,
    needs_rotors,
    rotor_positions,
)
from crazysim.tables import range_between


class RotorAerodynamics(Plugin, replaces=("drag",), requires=needs_rotors):
    """Forces of the air on every rotor, which replace the airframe's linear drag; needs rotors.

    The forces follow from the velocity of each hub relative to the air, including all winds and downwash. Across its
    axis a rotor has a drag ``-k_d omega v`` at the hub, which tips the drone back. Along its axis it has the thrust of
    blade element and momentum theory: less in climbs, more in forward flight. The defaults of ``drag`` and ``inflow``
    give the airframe's linear drag for small velocities around hover.
    """

    drag: Param = param(default=None, low=0.0)
    """Drag of a rotor per velocity across its axis and rotor speed (k_d of RotorPy), N s^2/(m rad) = kg/rad; None for
    the value that matches the airframe's linear drag in hover, the mean of x and y; zero for no drag. (1,)"""
    inflow: Param = param(default=None, keep=False, low=0.0)
    """Loss of thrust of a hovering rotor per axial velocity and rotor speed (k_z of RotorPy), N s^2/(m rad) = kg/rad;
    None for the value that matches the airframe's linear drag along z in hover; zero for the thrust of still air."""
    flapping: Param = param(default=0.0, low=0.0)
    """Moment of flapping blades at a hub per velocity across its axis and rotor speed, which tips the drone back,
    N s^2/rad = kg m/rad. The default is zero because airframes do not contain the stiffness of blades and hubs. (1,)"""
    hub_height: Param = param(default=None, keep=False)
    """Height of the hubs above the centre of mass, m, the lever arm of the drag; None for the airframe's
    ``shape.propeller_height`` above ``rotors.position``."""
    ceiling: Param = param(default=None, positive=True)
    """Height of a flat ceiling, below which rotors give more thrust, world frame, m; rotors above it give the thrust of
    free air. Needs ``inflow``; None for no ceiling. (1,)"""
    propeller_radius: Param = param(default=None, airframe="shape.propeller_radius", positive=True)
    """Radius of a propeller, m; None for the airframe's. (1,)"""
    air_density: Param = param(default=AIR_DENSITY, positive=True)
    """Density of air, kg/m^3. (1,)"""
    blade: Array = derived()
    """Coefficient of the blades (``dynamics.inflow``): loss of thrust per velocity of the air through the rotor and
    rotor speed, N s^2/(m rad). (1,)"""
    hub_pos: Array = derived(("rotors", 3))
    """Positions of the hubs, body frame, m. (n_rotors, 3)"""
    name: str = "rotor_aerodynamics"
    order: ClassVar[int] = 1  # after winds, whose drag it replaces, and after effects that change the thrust curves

    def bind(self, sim: Simulation) -> RotorAerodynamics:
        bound = self.with_arrays(sim)
        inflow = np.asarray(self._setting_or_drag_value(sim, "inflow", lambda drag: -drag[2, 2]), np.float64)
        thrust, speed = airframe_numbers(sim, hover_thrust)[..., None], airframe_numbers(sim, hover_speed)[..., None]
        disc = np.asarray(disc_factor(bound.propeller_radius, bound.air_density), np.float64)
        blade = blade_coefficient(inflow * speed, thrust, speed, disc)
        if self.ceiling is not None and not np.all(inflow > 0):
            raise ConfigError(
                "expected inflow above zero with a ceiling, which acts through the inflow, got zero. Use another "
                "inflow=, or ceiling=None."
            )
        if not np.all((blade >= 0) & np.isfinite(blade)):
            limit = np.min(np.sqrt(thrust * disc) / speed)
            raise ConfigError(
                f"expected inflow below {limit:.3g} N s^2/(m rad), the limit of momentum theory at this propeller "
                f"radius and air density, got {np.max(inflow):.3g}. Use RotorAerodynamics(inflow=...) with a "
                f"smaller number."
            )
        return bound.replace(
            drag=self._setting_or_drag_value(sim, "drag", lambda drag: -0.5 * (drag[0, 0] + drag[1, 1])),
            blade=check_parameter(sim, "blade", blade),
            hub_pos=self._hub_positions(sim),
        )

    def _setting_or_drag_value(self, sim: Simulation, name: str, drag_value: Callable[[np.ndarray], float]) -> Array:
        value = getattr(self, name)
        if value is None:
            drag = airframe_numbers(
                sim, lambda a: drag_value(a.matrix("drag.coefficients")) / (a.n_rotors * hover_speed(a))
            )
            value = drag[..., None] if drag.ndim else drag
            if not np.all(value > 0):
                raise ConfigError(
                    f"expected {name}, got none, and drone {sim.airframes[0].name!r} has no linear drag from which it "
                    f"would follow. Use RotorAerodynamics({name}=...); RotorPy has drag 1.0e-6 and inflow 7.6e-7 "
                    f"N s^2/(m rad) for the Crazyflie 2.0."
                )
        return check_parameter(sim, name, value, allowed=range_between(0.0))

    def _hub_positions(self, sim: Simulation) -> Array:
        height = self.hub_height
        if height is None:
            height = airframe_numbers(sim, lambda airframe: airframe.value("shape.propeller_height", ()))
        hub_z = np.asarray(check_parameter(sim, "hub_height", height))[..., None]
        pos = np.asarray(rotor_positions(sim))
        return device_array(pos + hub_z * np.array([0.0, 0.0, 1.0]), sim.data.states.pos.dtype)

    def influence(self, data: SimData) -> SimData:
        s, p = data.states, data.params
        # Velocity of each hub through the air.
        vel = rotation.rotate_inverse(s.quat, s.vel - air_velocity(data))
        hub_vel = vel + rotation.cross(s.ang_vel, self.hub_pos)
        u, v, axial_vel = hub_vel[..., 0], hub_vel[..., 1], hub_vel[..., 2]
        # Thrust in moving air, minus the thrust that the model already has.
        speed = RPM_TO_RAD_S * s.rotor_vel
        static_thrust = quadratic_curve(s.rotor_vel, p.rpm2thrust)
        blade, drag = drag_factor(data) * self.blade, drag_factor(data) * self.drag
        ceiling_gain: Array | float = 1.0
        if self.ceiling is not None:
            height = s.pos[..., 2:] + rotation.rotate(s.quat[..., None, :], self.hub_pos)[..., 2]
            ceiling_gain = ceiling_factor(self.ceiling - height, self.propeller_radius)
        thrust = thrust_in_flight(
            static_thrust,
            speed,
            axial_vel,
            u * u + v * v,
            blade,
            self.propeller_radius,
            self.air_density,
            ceiling_gain,
        )
        thrust_change = jnp.where(blade > 0, thrust - jnp.where(static_thrust > 0, static_thrust, 0.0), 0.0)

        # Drag and flapping moment of each rotor.
        drag_per_vel, moment_per_vel = drag * speed, self.flapping * speed
        forces = jnp.stack([-drag_per_vel * u, -drag_per_vel * v, thrust_change], axis=-1)
        moments = jnp.stack([moment_per_vel * v, -moment_per_vel * u, jnp.zeros_like(moment_per_vel)], axis=-1)
        # The product with the drag matrix takes the airframe's linear drag back.
        force = jnp.sum(forces, axis=-2) - rotation.matvec(p.drag_matrix, vel)
        torque = jnp.sum(rotation.cross(self.hub_pos, forces) + moments, axis=-2)
        return data.replace(
            states=s.replace(
                force=rotation.rotate(s.quat, force, offset=s.force),
                torque=rotation.rotate(s.quat, torque, offset=s.torque),
            )
        )


def hover_thrust(airframe: Airframe) -> float:
    """Return the thrust of each rotor in hover, N."""
    return float(airframe.value("rigid_body.mass")) * float(np.linalg.norm(GRAVITY)) / airframe.n_rotors


def hover_speed(airframe: Airframe) -> float:
    """Return the mean speed of the rotors in hover, rad/s."""
    return float(np.mean(RPM_TO_RAD_S * airframe.rotor_vel([hover_thrust(airframe)])))
