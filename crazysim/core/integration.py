"""Integrators: from a state and its derivative to the next state, plugins' own states included."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import jax
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData, SimStateDeriv
from crazysim.core.plugin import Plugin
from crazysim.core.stage import Stage

DerivFn = Callable[[SimData], SimStateDeriv]


class Integrator(StrEnum):
    """Integration scheme."""

    euler = "euler"
    """Explicit Euler, order 1: the fastest."""
    symplectic_euler = "symplectic_euler"
    """Velocities first, then positions with the new ones, order 1: as fast, and keeps energy better."""
    rk4 = "rk4"
    """Runge and Kutta, order 4; four derivatives a step."""
    default = euler

    @property
    def order(self) -> int:
        """Order of convergence."""
        return 4 if self == Integrator.rk4 else 1


def euler(data: SimData, deriv_fn: DerivFn) -> SimData:
    """Return the data one explicit Euler step later."""
    deriv, dt = deriv_fn(data), 1 / data.core.freq
    return advance(data, deriv, dt, dt * deriv.ang_vel)


def symplectic_euler(data: SimData, deriv_fn: DerivFn) -> SimData:
    """Return the data one semi-implicit Euler step later: positions move with the new velocities."""
    deriv, dt = deriv_fn(data), 1 / data.core.freq
    vel, ang_vel = deriv.vel + dt * deriv.acc, deriv.ang_vel + dt * deriv.ang_acc
    return advance(data, deriv.replace(vel=vel), dt, dt * ang_vel)


def rk4(data: SimData, deriv_fn: DerivFn) -> SimData:
    """Return the data one Runge-Kutta step of order 4 later.

    Rotations about different axes do not commute, so an attitude that moves along the averaged body rate is
    only of order 2. The two cross products are the commutators that restore order 4 (Munthe-Kaas 1999; in the
    form of Celledoni, Marthinsen and Owren 2014, section 3, with the signs of body rates).
    """
    dt = 1 / data.core.freq
    k1 = deriv_fn(data)
    r1 = dt * k1.ang_vel
    k2 = deriv_fn(advance(data, k1, dt / 2, r1 / 2, normalize=False))
    r2 = dt * k2.ang_vel
    k3 = deriv_fn(advance(data, k2, dt / 2, r2 / 2 + rotation.cross(r1, r2) / 8, normalize=False))
    r3 = dt * k3.ang_vel
    k4 = deriv_fn(advance(data, k3, dt, r3, normalize=False))
    r4 = dt * k4.ang_vel
    mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
    return advance(data, mean, dt, dt * mean.ang_vel + rotation.cross(r1, r4) / 12)


def advance(data: SimData, deriv: SimStateDeriv, dt: float, rotvec: Array, normalize: bool = True) -> SimData:
    """Return the data ``dt`` seconds along a derivative, the attitude turned by a body rotation vector, rad."""
    s = data.states
    states = s.replace(
        pos=s.pos + dt * deriv.vel,
        quat=rotation.turn(s.quat, rotvec, normalize),
        vel=s.vel + dt * deriv.acc,
        ang_vel=s.ang_vel + dt * deriv.ang_acc,
        rotor_vel=s.rotor_vel + dt * deriv.rotor_acc,
    )
    if not deriv.plugins:
        return data.replace(states=states)
    moved = {}
    for name, rates in deriv.plugins.items():
        record = data.plugins[name]
        moved[name] = record.replace(**{field: getattr(record, field) + dt * rate for field, rate in rates.items()})
    return data.replace(states=states, plugins=data.plugins | moved)


INTEGRATORS: dict[Integrator, Callable[..., SimData]] = {
    Integrator.euler: euler,
    Integrator.symplectic_euler: symplectic_euler,
    Integrator.rk4: rk4,
}


@dataclass(frozen=True)
class Integration:
    """The function of the stage ``integration``: one step of the drones' states and of plugins' own, together."""

    method: Callable[[SimData, DerivFn], SimData]
    """The integrator, one of ``INTEGRATORS``."""
    deriv_fn: DerivFn
    """Derivative of the drones' states."""
    plugins: tuple[Plugin, ...] = ()
    """Plugins whose influences and derivatives count, in the order in which they are applied."""

    def __call__(self, data: SimData) -> SimData:
        """Return the data one step later."""
        return self.method(data, self.derivative)

    def derivative(self, data: SimData) -> SimStateDeriv:
        """Return the derivative of the drones' states under all influences, and of the plugins' own states."""
        for plugin in self.plugins:
            data = plugin.influence(data)
        deriv = self.deriv_fn(data)
        own = {plugin.name: rates for plugin in self.plugins if (rates := dict(plugin.derivative(data)))}
        return deriv.replace(plugins=own) if own else deriv

    def stage(self) -> Stage:
        """Return the stage. Plugins are written for one drone, the rest takes any leading axes."""
        return Stage(self, "drone", batched=not self.plugins, name="integration")
