"""A small population for tests: point masses on springs, some of them tied to the drones of their world."""

from collections.abc import Sequence
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

import crazysim as cs
from crazysim.core.plugin import Param, StagePlacement, param, state
from crazysim.core.population import Population
from crazysim.engine.stage import stage

STIFFNESS = 40.0
"""Stiffness of the springs, N/m."""


class Springs(Population):
    """Masses of 1 kg. A spring pulls each mass to the command that its controller has taken over at a tick."""

    members: int | Sequence[str] = 1
    name: str = "springs"
    rate: int | None = 100
    pos: Param = param(default=None, core=(3,), scope="member")
    """Position, world frame, m. (3,)"""
    vel: jax.Array = state((3,), scope="member")
    """Velocity, world frame, m/s. (3,)"""
    cmd: jax.Array = state((3,), scope="member")
    """Position to which the spring pulls, world frame, m. (3,)"""
    ticks: jax.Array = state((), scope="member", dtype=np.int32)
    """Number of ticks of the controller. ()"""
    stiffness: Param = param(default=STIFFNESS)
    """Stiffness of the spring, N/m. (1,)"""
    prefix: ClassVar[str] = "Mass"
    command_field: ClassVar[str] = "cmd"

    @property
    def control_freq(self):
        return self.rate

    def bind(self, sim):
        start = np.arange(1.0, self.n_members + 1)[:, None] * np.ones(3)
        return self.replace(pos=start).with_arrays(sim)

    def control(self, data):
        return self.replace(ticks=self.ticks + 1)

    def derivative(self, data):
        assert self.pos.shape == (3,)
        assert data.states.pos.shape == (data.core.n_drones, 3)
        return {"pos": self.vel, "vel": self.stiffness * (self.cmd - self.pos)}


class Crowd(Springs):
    def derivative(self, data):
        rates, pos = super().derivative(data), self.pos

        def pull(other, is_self):
            return jnp.where(is_self, 0.0, other - pos)

        return rates | {"vel": rates["vel"] + cs.reduce_over_others(pull, pos, "sum")}


class Tied(Springs):
    def derivative(self, data):
        rates = super().derivative(data)
        return rates | {"vel": rates["vel"] + jnp.mean(data.states.pos - self.pos, axis=0)}


class Tying(Springs):
    def stages(self, sim):
        @stage("drone")
        def pull(data):
            offsets = self.read(data).pos - data.states.pos
            force = 0.01 * jnp.sum(offsets, axis=0)
            return data.replace(states=data.states.replace(force=force))

        @stage("world")
        def exchange(data):
            record, states = self.read(data), data.states
            vel_change = 0.01 * (states.vel[0] - record.vel[-1])
            data = data.replace(states=states.replace(vel=states.vel.at[0].add(-vel_change)))
            return self.write(data, record.replace(vel=record.vel.at[-1].add(vel_change)))

        placements = [
            StagePlacement(pull, name=f"{self.name}_pull"),
            StagePlacement(exchange, name=f"{self.name}_exchange"),
        ]
        return [*placements, *super().stages(sim)]


KINDS = (Springs, Crowd, Tied, Tying)
"""All populations of this module."""


def build_springs(kinds, n_worlds=2, n_drones=2, n_members=3, **settings):
    """Return a simulation of drones at different positions in the air, with populations of masses."""
    sim = cs.Sim(n_worlds, n_drones, control="rotor_vel", **settings)
    for kind in (kinds,) if isinstance(kinds, type) else kinds:
        name = "springs" if kind is kinds else kind.__name__.lower()
        sim.add(kind([f"{name}_{k}" for k in range(n_members)], name=name))
    rng = np.random.default_rng(0)
    pos = np.float32(rng.uniform(1, 2, (n_worlds, n_drones, 3)))
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
    cmd = np.random.default_rng(1).uniform(-1, 1, (n_worlds, n_members, 3))
    for population in sim.plugins.values():
        sim.data = population.with_command(sim.data, cmd)
    sim.build_default_data()
    sim.rotor_vel_control(np.tile([15000.0, 15000.0, 15100.0, 15000.0], (n_worlds, n_drones, 1)))
    return sim
