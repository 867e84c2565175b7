"""Drones and members of populations by name: ``sim["Crazyflie_0"]``."""

from __future__ import annotations

import dataclasses
import difflib
import functools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, NDArray

from crazysim.arguments import check_arguments, check_array
from crazysim.control import Control
from crazysim.core import functional as F
from crazysim.core.data import command_shape
from crazysim.core.plugin import Simulation
from crazysim.core.population import Population
from crazysim.eager import is_on_host, jit_eager_calls
from crazysim.engine import jaxcompat
from crazysim.engine.jaxcompat import require_unforked_process
from crazysim.engine.pytree import PyTree
from crazysim.errors import ConfigError, UnknownNameError, require
from crazysim.plugins.plugin_registry import PluginRegistry

Method = TypeVar("Method", bound=Callable[..., Any])
StageCommand = Callable[[Array | NDArray, Array | NDArray | None], None]
"""Function that stages a command for all drones, with its feedforward or None."""

DRONE_POPULATION = "drone"
"""Name of the population of drones."""


def locked(method: Method) -> Method:
    """Return a method that holds ``self.lock`` while it runs; the lock must be re-entrant."""

    @functools.wraps(method)
    def locked_method(self: Any, *args: Any, **kwargs: Any) -> Any:
        require_unforked_process()
        with self.lock:
            return method(self, *args, **kwargs)

    return locked_method  # type: ignore[return-value]


class Member:
    """One drone, or one member of a population, in all worlds: a view that reads and writes the simulation's data.

    Fields of the record, such as ``pos``, ``quat`` and ``vel``, are attributes. (n_worlds, ...) each
    """

    population: str
    """Name of its population; ``"drone"`` for a drone."""

    def __init__(self, sim: Simulation, name: str, index: int, plugin: Population | None, stage_command: StageCommand):
        self._sim, self.name, self.index, self._plugin, self._stage_command = sim, name, index, plugin, stage_command
        self.population, self.lock = DRONE_POPULATION if plugin is None else plugin.name, sim.lock

    def __getattr__(self, field: str) -> Array:
        value: Any = None if field.startswith("_") else getattr(self._record(), field, None)
        if np.ndim(value) < 2:
            raise AttributeError(f"expected a field of {self.name!r}, got {field!r}. Use one of {self._fields()}.")
        return _read_row(value, self.index)

    @locked
    def set(self, **values: ArrayLike) -> None:
        """Write fields of the record, such as ``pos``: (...) for all worlds, or (n_worlds, ...) for each world."""
        record, new_values = self._record(), {}
        for field, value in values.items():
            if field not in self._fields():
                raise UnknownNameError(
                    f"expected a field of {self.name!r}, got {field!r}. Use one of {self._fields()}."
                )
            check_array(f"{field} of {self.name}", value)
            new_values[field] = self._replace_checked_row(f"{field} of {self.name}", getattr(record, field), value)
        data, record = self._sim.data, record.replace(**new_values)
        plugin = self._plugin
        self._sim.data = data.replace(states=record) if plugin is None else plugin.write(data, record)

    @locked
    @check_arguments
    def command(self, command: ArrayLike) -> None:
        """Stage a command for this drone or member only: (k,) for all worlds, or (n_worlds, k) for each world.

        A drone takes a command of the simulation's command level, and a member takes a command of its population.
        """
        data, plugin = self._sim.data, self._plugin
        if plugin is not None:
            if plugin.command_field is None:
                raise ConfigError(f"expected a population that takes commands, got {self.population!r}, which does not")
            record = plugin.read(data)
            staged_command = self._replace_checked_row(
                f"command of {self.name}", getattr(record, plugin.command_field), command
            )
            self._sim.data = plugin.write(data, record.replace(**{plugin.command_field: staged_command}))
            return
        level = data.controls.mode
        staged_command, *feedforward_leaves = F.staged_leaves(data)
        if level == Control.rotor_vel:
            command = self._pad_rotors(command, command_shape(data, level)[-1])
        staged_command = self._replace_checked_row(f"{level.value} command of {self.name}", staged_command, command)
        # The feedforward of other drones does not change.
        feedforward = [
            _replace_row(x, self.index, _read_row(F.default_feedforward(staged_command), self.index))
            for x in feedforward_leaves
        ]
        self._stage_command(staged_command, *feedforward)

    def _pad_rotors(self, command: ArrayLike, n_rotors: int) -> ArrayLike:
        n_own_rotors = self._sim.airframes[self.index].n_rotors
        if np.shape(command)[-1:] != (n_own_rotors,) or n_own_rotors == n_rotors:
            return command
        return np.pad(np.asarray(command), [(0, 0)] * (np.ndim(command) - 1) + [(0, n_rotors - n_own_rotors)])

    def _replace_checked_row(self, label: str, x: Array, value: ArrayLike) -> Array | NDArray:
        shape = x.shape[:1] + x.shape[2:]
        if np.shape(value) not in (shape[1:], shape):
            raise ValueError(
                f"expected the {label} of shape {shape[1:]}, or {shape} with one for each world, got {np.shape(value)}"
            )
        if not isinstance(value, jax.Array):
            value = np.asarray(value, x.dtype)
            require(
                np.all(np.isfinite(value)),
                f"expected finite numbers as {label}, got NaN or infinity. Check its computation.",
                ValueError,
            )
        return _replace_row(x, self.index, value)

    def _record(self) -> PyTree:
        return self._sim.data.states if self._plugin is None else self._plugin.read(self._sim.data)

    def _fields(self) -> list[str]:
        record = self._record()
        excluded = ("population", "n_members", "member_id")
        names = [field.name for field in dataclasses.fields(record) if field.name not in excluded]  # type: ignore[arg-type]
        return [name for name in names if getattr(getattr(record, name), "ndim", 0) >= 2]

    def __repr__(self) -> str:
        return f"<{self.name}: {self.population} {self.index}>"


def _read_row(x: Array | NDArray, index: int) -> Any:
    if isinstance(x, np.ndarray):
        return x[:, index]
    if is_on_host(x) and not jaxcompat.is_key(x):
        return jaxcompat.put_host_array(np.asarray(x)[:, index].copy(), x.sharding)
    return _read_row_on_device(x, index)


def _replace_row(x: Array, index: int, value: ArrayLike) -> Array | NDArray:
    # The result is a NumPy array if ``x`` is on the host and ``value`` is not a JAX array.
    if is_on_host(x) and not isinstance(value, jax.Array):
        rows = np.array(x)
        rows[:, index] = value
        return rows
    return _replace_row_on_device(x, index, value)


@jit_eager_calls()
def _read_row_on_device(x: Array, index: Array | int) -> Array:
    return x[:, index]


@jit_eager_calls()
def _replace_row_on_device(x: Array, index: Array | int, value: ArrayLike) -> Array:
    return x.at[:, index].set(value)


def find_member(sim: Simulation, plugins: PluginRegistry, name: str, stage_command: StageCommand) -> Member:
    """Return the view of a drone or member of a population among the plugins."""
    if name in (drones := sim.names[: sim.n_drones]):
        return Member(sim, name, drones.index(name), None, stage_command)
    for plugin in plugins.values():
        if isinstance(plugin, Population) and name in plugin.names:
            return Member(sim, name, plugin.names.index(name), plugin, stage_command)
    raise UnknownNameError(
        f"expected the name of a drone or member, got {name!r}. {_suggest_names(str(name), sim.names)}"
    )


def _suggest_names(name: str, names: Sequence[str]) -> str:
    if len(names) <= 8:
        return f"There are {', '.join(names)}."
    similar_names = difflib.get_close_matches(name, names) or names[:3]
    return f"Did you mean {' or '.join(similar_names)}? sim.names has all."
