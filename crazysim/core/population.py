"""Populations: all objects of one kind in a world other than drones, such as cars, loads or free bodies.

A population is a plugin whose numbers and states have one row for each member. Most methods are written for one member.
Scopes, masks, seeds, sharding, engines and gradients treat members as they treat drones.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Self, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import SimData
from crazysim.core.influence import plugin_rates
from crazysim.core.integration import Integrator, advance_record
from crazysim.core.plugin import Plugin, Simulation, StagePlacement, state
from crazysim.core.settings import Setting, dividing_rate
from crazysim.engine.pytree import Members, device_array
from crazysim.engine.stage import RESERVED_SCOPES, Stage, is_tick
from crazysim.errors import ConfigError, require
from crazysim.tables import range_between

MAX_MEMBERS = 100_000
"""Largest number of members of a population in a world."""

R = TypeVar("R", bound=Members)


class Population(Plugin, Members):
    """Base class of populations, which ``sim.add`` adds.

    A population is declared like any plugin, with numbers and states of the scope ``"member"``. ``control``,
    ``derivative`` and ``reset_episode`` are written for one member: leaves of the population and of worlds have no
    batch axes. Leaves of drones are (n_drones, ...), leaves of other populations are (n_members, ...), and both may
    only be read. ``influence`` is written for one drone, as in other plugins.

    A population has up to two stages with its name as their scope. The stage of its controller runs before the
    integration of the drones, and the stage of its integration runs after it.
    """

    members: int | Sequence[str] = 1
    """Number of members in each world, or their names, such as ``("Fleet1Tenth_0", "Fleet1Tenth_7")``."""
    name: str = "population"
    """Name of the population: key in ``data.plugins``, and scope of its leaves and stages."""
    population: str = dataclasses.field(default="", kw_only=True, repr=False, metadata={"static": True})
    n_members: int = dataclasses.field(
        default=0, kw_only=True, repr=False, metadata={"static": True, "setting": Setting(range_between(0))}
    )
    """Number of members in each world."""
    member_id: Array = state((), scope="member", dtype=np.int32)
    prefix: ClassVar[str] = "Member"
    """Beginning of the names of members that are given by number: ``Member_0``."""
    positions: ClassVar[tuple[str, ...]] = ("pos",)
    """Fields that the scheme ``symplectic_euler`` advances with the new values of the other states."""
    command_field: ClassVar[str | None] = None
    """Field that ``with_command`` writes; None for a population without commands."""

    @property
    def scope(self) -> str:
        return self.name

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the members, in order."""
        members, class_name = self.members, type(self).__name__
        if isinstance(members, (int, np.integer)) and not isinstance(members, bool):
            require(
                members <= MAX_MEMBERS,
                f"expected at most {MAX_MEMBERS} members of {class_name} in a world, got {members}",
            )
            names = tuple([f"{self.prefix}_{k}" for k in range(members)])
        else:
            names = tuple(members) if isinstance(members, Sequence) and not isinstance(members, str) else ()
        if not names or not all(isinstance(name, str) and name for name in names):
            raise ConfigError(
                f"expected members of {class_name} as a positive number or a list of names, got {members!r}. Use "
                f"{class_name}(2) or {class_name}(['{self.prefix}_0'])."
            )
        if len(set(names)) < len(names):
            repeated_name = next(name for name in names if names.count(name) > 1)
            raise ConfigError(f"expected distinct names of members, got {repeated_name!r} twice. Rename one.")
        return names

    @property
    def control_freq(self) -> int | None:
        """Rate of ``control``, Hz, a divisor of the rate of physics steps; None for that rate."""
        return None

    @property
    def is_dynamic(self) -> bool:
        return type(self).influence is not Plugin.influence or self.constrains

    def check_settings(self) -> None:
        super().check_settings()
        object.__setattr__(self, "population", self.name)
        object.__setattr__(self, "n_members", len(self.names))

    def check_simulation(self, sim: Simulation) -> None:
        super().check_simulation(sim)
        require(
            self.name not in (*RESERVED_SCOPES, "drone", "world"),
            f"expected a name of a population, got {self.name!r}, a scope of stages. Use name=.",
        )
        if self.control_freq is not None:
            dividing_rate(f"control_freq of {self.name!r}", self.control_freq, sim.data.core.freq)

    def with_arrays(self, sim: Simulation, **values: Any) -> Self:
        ids = np.broadcast_to(np.arange(self.n_members), (sim.n_worlds, self.n_members))
        return super().with_arrays(sim, member_id=device_array(ids, np.int32), **values)

    def control(self, data: SimData) -> Self:
        """Return one member with the outputs of its controller; called at ``control_freq``."""
        return self

    def derivative(self, data: SimData) -> Mapping[str, Array]:
        """Return the time derivatives of the states of one member, per second, by field.

        The integration advances them in the scheme of the simulation. The rate of a unit quaternion is the derivative
        of its four numbers; ``finish`` restores its length.
        """
        return {}

    def scheme(self, integrator: Integrator) -> Callable[..., Any]:
        """Return the function ``(member, rates_fn, dt) -> member`` by which the integration advances one member.

        Override it for states that another method advances better, such as fast rotation under Euler's schemes.
        """
        return choose_scheme(integrator, self.positions)

    def finish(self) -> Self:
        """Return one member at the end of a step: unit quaternions restored, states limited."""
        return self

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        cls, placements = type(self), []
        if cls.control is not Population.control:
            control_freq = self.bound(sim.data).control_freq
            condition = None if control_freq is None else functools.partial(is_tick, freq=control_freq)
            name = f"{self.name}_control"
            placements.append(StagePlacement(Stage(self._run_controller, self.name, condition, name=name), name=name))
        if cls.derivative is not Population.derivative:
            name = f"{self.name}_integration"
            step = functools.partial(self._integrate, self.scheme(sim.integrator))
            placements.append(StagePlacement(Stage(step, self.name, name=name), before="measurements", name=name))
        return placements

    def with_poses(self, pos: Array, quat: Array) -> Self:
        """Return the population with arrays at other poses; by default in fields ``pos`` and ``quat``, if it has them.

        Args:
            pos: Positions, world frame, m. (n_worlds, n_members, 3)
            quat: Attitudes, body to world, xyzw. (n_worlds, n_members, 4)
        """
        fields = self.__dataclass_fields__  # type: ignore[attr-defined]
        return self.replace(**{k: x for k, x in (("pos", pos), ("quat", quat)) if k in fields})

    def with_command(self, data: SimData, command: ArrayLike) -> SimData:
        """Return the data of all worlds with a new command for every member. (n_worlds, n_members, k)"""
        record, field = self.read(data), self.command_field
        if field is None:
            raise ConfigError(f"expected a population that takes commands, got {self.name!r}, which takes none")
        old_command = getattr(record, field)
        command = check_command(self.name, old_command.shape, command, old_command.dtype)
        is_inside_jit = isinstance(old_command, jax.core.Tracer) or isinstance(command, jax.core.Tracer)
        device_command = jnp.asarray(command) if is_inside_jit else jax.device_put(command, old_command.sharding)
        return self.write(data, record.replace(**{field: device_command}))

    def _run_controller(self, data: SimData) -> SimData:
        return self.write(data, self.bound(data).control(data))

    def _integrate(self, scheme: Callable[..., Self], data: SimData) -> SimData:
        def rates_fn(member: Self) -> dict[str, Array]:
            return plugin_rates(self, self.write(data, member))

        advanced_member = scheme(self.read(data), rates_fn, 1 / data.core.freq)
        return self.write(data, advanced_member.finish())


RatesFn = Callable[[R], dict[str, Array]]
"""Function from the record of one member to the time derivatives of its fields, by name."""


def euler(record: R, rates_fn: RatesFn, dt: float) -> R:
    """Return a record one explicit Euler step later."""
    return advance_record(record, rates_fn(record), dt)


def symplectic_euler(record: R, rates_fn: RatesFn, dt: float, positions: Sequence[str]) -> R:
    """Return a record one semi-implicit Euler step later: positions move with the new values of the other states."""
    advanced_record = advance_record(
        record, {k: rate for k, rate in rates_fn(record).items() if k not in positions}, dt
    )
    return advance_record(
        advanced_record, {k: rate for k, rate in rates_fn(advanced_record).items() if k in positions}, dt
    )


def rk4(record: R, rates_fn: RatesFn, dt: float) -> R:
    """Return a record one step of the classical Runge-Kutta method of order 4 later."""
    k1 = rates_fn(record)
    k2 = rates_fn(advance_record(record, k1, dt / 2))
    k3 = rates_fn(advance_record(record, k2, dt / 2))
    k4 = rates_fn(advance_record(record, k3, dt))
    return advance_record(record, jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4), dt)


def choose_scheme(integrator: Integrator, positions: Sequence[str]) -> Callable[..., Any]:
    """Return the function ``(record, rates_fn, dt) -> record`` of an integration scheme."""
    semi_implicit_euler = functools.partial(symplectic_euler, positions=positions)
    return {
        Integrator.euler: euler,
        Integrator.symplectic_euler: semi_implicit_euler,
        Integrator.rk4: rk4,
    }[integrator]


def populations(data: SimData) -> dict[str, Members]:
    """Return the records of all populations other than the drones, by name."""
    return {name: x for name, x in data.plugins.items() if isinstance(x, Members) and x.population == name}


def check_command(name: str, shape: tuple[int, ...], command: ArrayLike, dtype: Any) -> Array | np.ndarray:
    """Return a command as an array of the given shape and dtype."""
    is_on_host = not isinstance(command, jax.Array)
    array = np.asarray(command, dtype) if is_on_host else command
    require(
        array.shape == shape,
        f"expected a command of shape {shape} for {name!r}, got {array.shape}. For one command to all use "
        f"np.broadcast_to(command, {shape}).",
    )
    if is_on_host and not np.all(np.isfinite(array)):
        raise ConfigError(
            f"expected finite numbers as command of {name!r}, got NaN or infinity. Check its computation."
        )
    return array.astype(dtype)
