"""Integrators, which advance the states of drones and plugins by one step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData, SimState, SimStateDeriv
from crazysim.core.influence import apply_constraint, apply_influence, plugin_rates
from crazysim.core.plugin import Plugin, drawn_data
from crazysim.engine.pytree import PyTree
from crazysim.engine.stage import Stage, vmap_drones

R = TypeVar("R", bound=PyTree)

DerivFn = Callable[[SimData], SimStateDeriv]
"""Function from data to the time derivative of the states."""

FLOOR_HEIGHT = -0.001
"""Height above the ground at which drones stop, m: slightly below zero, so that a negative height means a landing."""
MAX_ROTATION = 1.0
"""Largest rotation per step about a body axis, rad. Angular velocities are limited to ``MAX_ROTATION * freq``.

The model from first principles has no damping that would bound the angular velocity under a constant torque. This
limit bounds it, to 500 rad/s at 500 Hz. For comparison, the gyroscope of a Crazyflie measures up to 35 rad/s (2000
degrees per second; BMI088, data sheet).
"""


class Integrator(StrEnum):
    """Integration scheme."""

    euler = "euler"
    """Explicit Euler, order 1: the fastest."""
    symplectic_euler = "symplectic_euler"
    """Semi-implicit Euler, order 1: positions move with the new velocities. As fast as explicit Euler, with less energy
    drift."""
    rk4 = "rk4"
    """Classical Runge-Kutta, order 4: four evaluations of the derivative per step."""
    default = euler

    @property
    def order(self) -> int:
        """Order of convergence."""
        return 4 if self == Integrator.rk4 else 1


def hold_on_ground(s: SimState, deriv: SimStateDeriv, ground: Array | float) -> SimStateDeriv:
    """Return the derivative in which drones that stand on the ground and do not lift off have no acceleration.

    Integrators that move positions with the velocities of the same step need it. Explicit Euler moves positions with
    the velocities of the previous step, which the stage that stops drones at the ground has set to zero.

    Args:
        ground: Height of the ground, world frame, m. (..., 1)
    """
    is_on_ground = (s.pos[..., 2:] == ground) | (s.pos[..., 2:] == ground + FLOOR_HEIGHT)
    is_standing = is_on_ground & (s.vel[..., 2:] == 0) & (deriv.acc[..., 2:] <= 0)
    return deriv.replace(acc=jnp.where(is_standing, 0.0, deriv.acc), ang_acc=jnp.where(is_standing, 0.0, deriv.ang_acc))


def euler(data: SimData, deriv_fn: DerivFn) -> SimData:
    """Return the data one explicit Euler step later."""
    return apply_derivative(data, deriv_fn(data), 1 / data.core.freq)


def symplectic_euler(data: SimData, deriv_fn: DerivFn) -> SimData:
    """Return the data one semi-implicit Euler step later: positions move with the new velocities."""
    deriv, dt = deriv_fn(data), 1 / data.core.freq
    vel = data.states.vel + dt * deriv.acc
    ang_vel = limit_ang_vel(data.states.ang_vel + dt * deriv.ang_acc, data.core.freq)
    return apply_derivative(data, deriv.replace(vel=vel, ang_vel=ang_vel), dt)


def rk4(data: SimData, deriv_fn: DerivFn) -> SimData:
    """Return the data one Runge-Kutta step of order 4 later.

    Rotations about different axes do not commute, so an attitude advanced with the averaged body rate is only accurate
    to order 2. The two cross products are commutators that restore order 4 (Munthe-Kaas 1999; here in the form of
    Celledoni, Marthinsen and Owren 2014, section 3, with the signs for body rates).
    """
    dt = 1 / data.core.freq
    k1 = deriv_fn(data)
    k2 = deriv_fn(apply_derivative(data, k1, dt / 2, is_final=False))
    commutator = dt / 4 * rotation.cross(k1.ang_vel, k2.ang_vel)
    k3 = deriv_fn(apply_derivative(data, k2.replace(ang_vel=k2.ang_vel + commutator), dt / 2, is_final=False))
    k4 = deriv_fn(apply_derivative(data, k3, dt, is_final=False))
    mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
    commutator = dt / 12 * rotation.cross(k1.ang_vel, k4.ang_vel)
    return apply_derivative(data, mean.replace(ang_vel=mean.ang_vel + commutator), dt)


def apply_derivative(data: SimData, deriv: SimStateDeriv, dt: float, is_final: bool = True) -> SimData:
    """Return the data advanced by ``dt`` seconds along a derivative.

    Args:
        dt: Duration, s.
        is_final: True at the end of a step, to normalise quaternions and limit angular velocities. False at
            intermediate points of a step.
    """
    s = data.states
    ang_vel = s.ang_vel + dt * deriv.ang_acc
    states = s.replace(
        pos=s.pos + dt * deriv.vel,
        quat=rotation.integrate_attitude(s.quat, deriv.ang_vel, dt, normalize=is_final),
        vel=s.vel + dt * deriv.acc,
        ang_vel=limit_ang_vel(ang_vel, data.core.freq) if is_final else ang_vel,
        rotor_vel=s.rotor_vel + dt * deriv.rotor_acc,
    )
    if not deriv.plugins:
        return data.replace(states=states)
    records = {name: advance_record(data.plugins[name], rates, dt) for name, rates in deriv.plugins.items()}
    return data.replace(states=states, plugins=data.plugins | records)


def advance_record(record: R, rates: Mapping[str, Array], dt: float) -> R:
    """Return a record advanced by ``dt`` seconds, given the time derivatives of some of its fields by name."""
    return record.replace(**{field: getattr(record, field) + dt * rate for field, rate in rates.items()})


def limit_ang_vel(ang_vel: Array, freq: float) -> Array:
    """Return angular velocities, rad/s, limited to ``MAX_ROTATION`` per step about each body axis. (..., 3)"""
    limit = MAX_ROTATION * freq
    return rotation.clip(ang_vel, -limit, limit)


INTEGRATORS: dict[Integrator, Callable[..., SimData]] = {
    Integrator.euler: euler,
    Integrator.symplectic_euler: symplectic_euler,
    Integrator.rk4: rk4,
}
"""Function ``(data, deriv_fn) -> data`` of each scheme."""


@dataclass(frozen=True)
class Integration:
    """Function of the stage ``integration``, which advances the states of drones and plugins together by one step."""

    method: Callable[[SimData, DerivFn], SimData]
    """The integrator, one of ``INTEGRATORS``."""
    deriv_fn: DerivFn
    """Derivative of the drones' states."""
    plugins: tuple[Plugin, ...] = ()
    """Plugins with influences, derivatives or a constraint, in the order in which they are applied."""
    ground: Callable[[SimData], Array | float] | None = None
    """Height of the ground on which drones stand, world frame, m; None without ground."""

    def __call__(self, data: SimData) -> SimData:
        return self.method(data, self.derivative)

    def on_ground(self, ground: Callable[[SimData], Array | float] | None) -> Integration:
        return self if ground is self.ground else replace(self, ground=ground)

    @property
    def couples_world(self) -> bool:
        """Whether a plugin couples the drones of a world, so that the stage has the scope ``world``."""
        return any(plugin.constrains and plugin.coupling == "world" for plugin in self.plugins)

    def derivative(self, data: SimData) -> SimStateDeriv:
        """Return the derivative of the states of drones and plugins, under all influences and the constraint."""
        data = drawn_data(data)
        if self.couples_world:
            influenced_data, deriv = data, vmap_drones(lambda drone: self._unconstrained_derivative(drone)[1])(data)
        else:
            influenced_data, deriv = self._unconstrained_derivative(data)
        constraining_plugins = [plugin for plugin in self.plugins if plugin.constrains]
        if not constraining_plugins:
            return deriv
        dt = 1 / data.core.freq
        if self.method is symplectic_euler:  # the constraint acts on the velocities that move the positions
            vel, ang_vel = deriv.vel + dt * deriv.acc, deriv.ang_vel + dt * deriv.ang_acc
            deriv = deriv.replace(vel=vel, ang_vel=ang_vel)
        return apply_constraint(constraining_plugins[0], influenced_data, deriv, None if self.method is rk4 else dt)

    def _unconstrained_derivative(self, data: SimData) -> tuple[SimData, SimStateDeriv]:
        for plugin in self.plugins:
            data = apply_influence(plugin, data)
        deriv = self.deriv_fn(data)
        if self.ground is not None and self.method is not euler:
            deriv = hold_on_ground(data.states, deriv, self.ground(data))
        drone_plugins = [plugin for plugin in self.plugins if plugin.scope == "drone"]
        plugin_derivs = {plugin.name: rates for plugin in drone_plugins if (rates := plugin_rates(plugin, data))}
        return data, deriv.replace(plugins=plugin_derivs) if plugin_derivs else deriv

    def stage(self) -> Stage:
        """Return the stage of a step pipeline.

        Without plugins, the stage accepts any leading axes, and is traced once in a process; therefore ``deriv_fn``
        must be one of the derivatives of ``crazysim.core.stages``. Plugins are written for one drone or one world.
        """
        scope = "world" if self.couples_world else "drone"
        return Stage(self, scope, batched=not self.plugins, name="integration", trace_once=not self.plugins)
