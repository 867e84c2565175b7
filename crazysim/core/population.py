"""Populations: all objects of one kind in a world other than drones, such as cars, loads or free bodies.

A population is a plugin with a record that has one row for each member. Most methods are written for one member.
Scopes, masks, seeds, sharding, engines and gradients treat members as they treat drones.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import SimData
from crazysim.core.influence import plugin_rates
from crazysim.core.integration import Integrator, advance_record
from crazysim.core.plugin import Plugin, Simulation, StagePlacement
from crazysim.core.settings import dividing_rate
from crazysim.engine.pytree import Members, PyTree, float_dtype
from crazysim.engine.stage import RESERVED_SCOPES, Stage, is_tick
from crazysim.errors import ConfigError, require

MAX_MEMBERS = 100_000
"""Largest number of members of a population in a world."""

R = TypeVar("R", bound=Members)


class Population(Plugin):
    """Base class of populations, which ``sim.add`` adds.

    A subclass overrides ``record``, ``derivative`` and any other method it needs. ``control``, ``derivative`` and
    ``reset_episode`` are written for one member: leaves of the population and of worlds have no batch axes, and
    ``self.read(data)`` is the record of the member. Leaves of drones are (n_drones, ...), leaves of other populations
    are (n_members, ...), and both may only be read. ``influence`` is written for one drone, as in other plugins.

    A population has up to two stages with its name as their scope. The stage of its controller runs before the
    integration of the drones, and the stage of its integration runs after it.
    """

    members: int | Sequence[str] = 1
    """Number of members in each world, or their names, such as ``("Fleet1Tenth_0", "Fleet1Tenth_7")``."""
    name: str = "population"
    """Name of the population: key of its record in ``data.plugins``, and scope of its leaves and stages."""
    prefix: ClassVar[str] = "Member"
    """Beginning of the names of members that are given by number: ``Member_0``."""
    positions: ClassVar[tuple[str, ...]] = ("pos",)
    """Fields that the scheme ``symplectic_euler`` advances with the new values of the other states."""
    command_field: ClassVar[str | None] = None
    """Field of the record that ``with_command`` writes; None for a population without commands."""

    @property
    def scope(self) -> str:
        """Scope of its states and stages: its name."""
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
    def n_members(self) -> int:
        """Number of members in each world."""
        return len(self.names)

    @property
    def control_freq(self) -> int | None:
        """Rate of ``control``, Hz, a divisor of the rate of physics steps; None for that rate."""
        return None

    @property
    def is_dynamic(self) -> bool:
        """True if the drones' integration must call ``influence``; populations integrate their own states."""
        return type(self).influence is not Plugin.influence or self.constrains

    def create(self, sim: Simulation, kind: type[R], **fields: Any) -> R:
        """Return a record for all worlds. Values without axes of worlds or members are repeated along them.

        Args:
            sim: The simulation.
            kind: Class of the record.
            fields: Values of the fields. The value of a leaf of members has the shape (*core), (n_members, *core) or
                (n_worlds, n_members, *core). Values of other leaves and nested records are used unchanged.
        """
        self.check(sim)
        counts = sim.n_worlds, self.n_members
        values = {}
        for name, value in fields.items():
            metadata = kind.__dataclass_fields__[name].metadata  # type: ignore[attr-defined]
            is_member_leaf = metadata.get("scope") == "member" and value is not None and not isinstance(value, PyTree)
            values[name] = _repeat_for_members(name, value, metadata, counts) if is_member_leaf else value
        ids = np.array(np.broadcast_to(np.arange(self.n_members, dtype=np.int32), counts))
        return kind(population=self.name, n_members=self.n_members, member_id=ids, **values)  # type: ignore[call-arg]

    def check(self, sim: Simulation) -> None:
        """Check the name of the population and the rate of its controller."""
        require(
            self.name not in (*RESERVED_SCOPES, "drone", "world"),
            f"expected a name of a population, got {self.name!r}, a scope of stages. Use name=.",
        )
        if self.control_freq is not None:
            dividing_rate(f"control_freq of {self.name!r}", self.control_freq, sim.data.core.freq)

    def control(self, data: SimData) -> Members:
        """Return the record of one member with the outputs of its controller; called at ``control_freq``."""
        return self.read(data)

    def derivative(self, data: SimData) -> Mapping[str, Array]:
        """Return the time derivatives of the states of one member, per second, by field of its record.

        The integration advances them in the scheme of the simulation. The rate of a unit quaternion is the derivative
        of its four numbers; ``finish`` restores its length.
        """
        return {}

    def scheme(self, integrator: Integrator) -> Callable[..., Any]:
        """Return the function ``(record, rates_fn, dt) -> record`` by which the integration advances one member.

        Override it for states that another method advances better, such as fast rotation under Euler's schemes.
        """
        return choose_scheme(integrator, self.positions)

    def finish(self, record: Members) -> Members:
        """Return the record of one member at the end of a step: unit quaternions restored, states limited."""
        return record

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        """Return a stage for ``control`` and a stage for ``derivative``, if the class overrides these methods."""
        cls, placements = type(self), []
        if cls.control is not Population.control:
            control_freq = self.control_freq
            condition = None if control_freq is None else functools.partial(is_tick, freq=control_freq)
            name = f"{self.name}_control"
            placements.append(StagePlacement(Stage(self._run_controller, self.name, condition, name=name), name=name))
        if cls.derivative is not Population.derivative:
            name = f"{self.name}_integration"
            step = functools.partial(self._integrate, self.scheme(sim.integrator))
            placements.append(StagePlacement(Stage(step, self.name, name=name), before="measurements", name=name))
        return placements

    def with_poses(self, record: R, pos: Array, quat: Array) -> R:
        """Return a record of all worlds with other poses; by default in fields ``pos`` and ``quat``, if it has them.

        Args:
            record: The record.
            pos: Positions, world frame, m. (n_worlds, n_members, 3)
            quat: Attitudes, body to world, xyzw. (n_worlds, n_members, 4)
        """
        fields = record.__dataclass_fields__  # type: ignore[attr-defined]
        return record.replace(**{k: x for k, x in (("pos", pos), ("quat", quat)) if k in fields})

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
        return self.write(data, self.control(data))

    def _integrate(self, scheme: Callable[..., Members], data: SimData) -> SimData:
        def rates_fn(record: Members) -> dict[str, Array]:
            return plugin_rates(self, self.write(data, record))

        advanced_record = scheme(self.read(data), rates_fn, 1 / data.core.freq)
        return self.write(data, self.finish(advanced_record))


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


def _repeat_for_members(name: str, value: Any, metadata: Mapping[str, Any], counts: tuple[int, int]) -> np.ndarray:
    """Return a value repeated for every member of every world."""
    array = np.asarray(value)
    is_integer = array.dtype.kind in "iu" and hasattr(value, "dtype")  # a Python int such as 1 becomes the float 1.0
    dtype = np.int32 if is_integer else float_dtype() if array.dtype.kind in "iuf" else array.dtype
    core_ndim = metadata["core_ndim"]
    core = array.shape[max(array.ndim - core_ndim, 0) :] if array.ndim >= core_ndim else None
    batch = array.shape[: array.ndim - core_ndim] if core is not None else ()
    if core is None or metadata["core"] not in (None, core) or batch not in ((), counts[1:], counts):
        raise ConfigError(
            f"expected {name} with {core_ndim} dimensions for all members, or behind {counts[1:]} = (n_members,) or "
            f"{counts} = (n_worlds, n_members), got shape {array.shape}. Use np.broadcast_to."
        )
    return np.array(np.broadcast_to(array, (*counts, *core)), dtype)
