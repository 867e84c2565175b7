"""Base class of tasks."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, dataclass_transform

import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.plugin import FunctionPlugin, StagePlacement, state
from crazysim.core.settings import check_settings, setting
from crazysim.engine.pytree import PyTree, device_array, static
from crazysim.engine.stage import Stage
from crazysim.envs.actions import Actions, actions_of
from crazysim.envs.state import Obs
from crazysim.errors import ConfigError, expect, require
from crazysim.plugins.sensors.image_sensor import ImageSensor
from crazysim.sim.sim import Sim

MAX_SECONDS = 1e5
"""Longest episode, s. A 32-bit counter of its physics steps does not overflow at up to 10,000 Hz."""
TASK_RECORD_NAME = "task"
"""Name of a task's record in ``data.plugins``."""


@dataclasses.dataclass(frozen=True, kw_only=True)
@dataclass_transform(
    frozen_default=True, kw_only_default=True, field_specifiers=(setting, state, static, dataclasses.field)
)
class Task:
    """A task: settings, states and methods that are pure functions of one world.

    Subclasses define ``name``, ``spawn``, ``observe``, ``rewards``, ``terminated`` and ``error``, and whatever else
    they need; each becomes a frozen dataclass of its settings, without a decorator. A state between steps is declared
    with ``crazysim.state``, as in a plugin: ``self.read(data).passed`` reads it, and ``self.write(data, passed=...)``
    returns data with another value. In the data that methods receive, arrays per drone are (n_drones, ...), and arrays
    per world have no batch axes.
    """

    name: ClassVar[str] = ""
    """Name in messages and files; also the name of its random stream."""
    Record: ClassVar[type[PyTree] | None] = None
    """Type of ``data.plugins["task"]``, which has the states; None if there are none."""
    batched: ClassVar[bool] = False
    """True for a task that needs all worlds at once. Its methods then receive the data of all worlds, with all batch
    axes, and one key per world. The phases of an environment step are then not fused."""

    control: ClassVar[str] = "attitude"
    """Default command level."""
    n_drones: ClassVar[int] = 1
    """Default number of drones."""
    drone: ClassVar[str | None] = None
    """Name or file of the default airframe; None for that of ``Sim``."""
    freq: ClassVar[int] = 50
    """Default number of environment steps per second, Hz."""
    recipe: ClassVar[Mapping[str, Any]] = {}
    """Changes of the recipe with which ``crazysim train`` solves the task, such as ``{"discount": 0.99}``:
    hyperparameters, ``n_worlds``, ``algorithm``, ``evaluate_every``, and options of the training alone as
    ``"practice": {"radius": 0.6}``. A class that extends a built-in task begins with its recipe."""
    unit: ClassVar[str] = "m"
    """Unit of ``error``."""
    film_view: ClassVar[Mapping[str, Any] | None] = None
    """Settings of the camera of films, if they do not depend on the number of drones; see ``camera``."""

    seconds: float = setting(default=5.0, positive=True, high=MAX_SECONDS)
    """Length of an episode, s."""
    tolerance: float = setting(default=0.05, positive=True)
    """Limit of the error for success, in ``unit``."""
    hold: float = setting(default=1.0, low=0.0)
    """Time at the end of an episode during which the error must stay below the tolerance, s."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        _move_states_to_record(cls)
        dataclasses.dataclass(frozen=True, kw_only=True)(cls)

    def __post_init__(self) -> None:
        check_settings(self)

    def install(self, sim: Sim) -> None:
        """Add states and stages of the task to a simulation, once, before ``DroneEnv``.

        Override it for objects, plugins, and stages that need them; end with ``self.add_states(sim, ...)``.
        """
        self.add_states(sim)

    def actions(self, sim: Sim) -> Actions:
        """Return the meaning of actions, for ``DroneEnv(..., actions=None)``."""
        return actions_of(sim.airframes, sim.default_data.params, sim.control)

    def add_states(self, sim: Sim, placements: Sequence[StagePlacement] = (), **initial: Any) -> None:
        """Add the states and stages of the task to a simulation; for use in ``install``.

        Args:
            placements: Stages with their positions, such as ``StagePlacement(stage, before="increment_steps")``.
            initial: First values of states, and values of ``static`` fields; other states are zero at first.
        """
        record = None if self.Record is None else self.Record(**_initial_states(sim, self.Record, initial))
        if type(self).after_substep is not Task.after_substep:
            judge = Stage(self.after_substep, "drone", name=TASK_RECORD_NAME)
            placements = [*placements, StagePlacement(judge, before="increment_steps")]
        sim.add(FunctionPlugin(TASK_RECORD_NAME, record, placements))

    def read(self, data: SimData) -> Any:
        """Read the states of the task in data of any scope, as attributes."""
        return data.plugins[TASK_RECORD_NAME]

    def write(self, data: SimData, **changes: Any) -> SimData:
        """Return data of any scope with other values of some states."""
        record = self.read(data)
        names = [f.name for f in dataclasses.fields(record)]
        unknown = ", ".join(changes.keys() - set(names))
        expect(not unknown, f"states of task {self.name!r} among {', '.join(names)}", unknown, "Correct the name.")
        return data.replace(plugins=data.plugins | {TASK_RECORD_NAME: record.replace(**changes)})

    def after_substep(self, data: SimData) -> SimData:
        """Return the data of one drone after a physics step; count, measure or judge here what must not be missed."""
        return data

    def spawn(self, data: SimData, key: Array) -> SimData:
        """Return the data at the start of an episode, goals included.

        Args:
            data: The world after its reset.
            key: Random key of the episode, for ``crazysim.envs.random`` or ``jax.random``. ()
        """
        raise NotImplementedError(self._undefined("spawn(data, key)"))

    def set_goal(self, data: SimData, pos: Array) -> SimData:
        """Return the data with new goals, for ``env.set_goal``. Tasks whose goals are positions define this method.

        Args:
            pos: Goal of every drone, or of its load, world frame, m. (n_drones, 3)
        """
        raise ConfigError(
            f"expected a task whose goals are positions, got {self.name!r}. Define set_goal(data, pos) in "
            f"{type(self).__name__}, or use a task that has it, such as hover."
        )

    def before_step(self, data: SimData) -> SimData:
        """Return the data before an environment step. Store quantities here whose change is rewarded."""
        return data

    def observe(self, data: SimData) -> Obs:
        """Return the observations of every drone. (n_drones, k) each"""
        raise NotImplementedError(self._undefined("observe(data)"))

    def privileged(self, data: SimData) -> Obs:
        """Return further observations for a critic, which policies must not use. (n_drones, k) each"""
        return {}

    def rewards(self, data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
        """Return the terms of the reward of an environment step, by name; the reward is their sum. (n_drones,) each

        Args:
            data: The world after the step.
            action: Action of this step, in [-1, 1]. (n_drones, k)
            last_action: Action of the step before; zero at the start of an episode. (n_drones, k)
        """
        raise NotImplementedError(self._undefined("rewards(data, action, last_action)"))

    def terminated(self, data: SimData) -> Array:
        """Whether the episode ended by success or failure. ()"""
        raise NotImplementedError(self._undefined("terminated(data)"))

    def error(self, data: SimData) -> Array:
        """Return the task error of every drone, in ``unit``. (n_drones,)"""
        raise NotImplementedError(self._undefined("error(data)"))

    def info(self, data: SimData) -> dict[str, Array]:
        """Return further quantities for ``state.info``, by name. () or (n_drones, ...) each"""
        return {}

    def target(self, data: SimData) -> Array | None:
        """Return the target position of each drone, or several marks per drone, to draw in images, m; None if none.

        By default it is the state ``goal``, if the task has one that is declared ``state((3,))``.

        Returns:
            (n_drones, 3) or (n_drones, n_marks, 3)
        """
        goal = getattr(self.Record, "__dataclass_fields__", {}).get("goal")
        return None if goal is None or goal.metadata["shape"] != (3,) else self.read(data).goal

    def rings(self, data: SimData) -> Array | None:
        """Return rings to draw in images, such as hoops, as middle, m, unit vector along the axis, and radius, m; None
        for no rings.

        Returns:
            (n_rings, 7)
        """
        return None

    def subjects(self, data: SimData) -> Array | None:
        """Return points that films keep in view besides drones and marks, such as a pad's rim, m; None for no points.

        Returns:
            (n_points, 3)
        """
        return None

    def camera(self, n_drones: int) -> Mapping[str, Any] | None:
        """Return lookat, distance, azimuth and elevation of the camera of films; None to frame all starts.

        With the entry ``follow``, the index of a drone, the camera follows that drone at the distance. By default it is
        ``film_view``.
        """
        return self.film_view

    def policy_camera(self) -> ImageSensor | None:
        """Return the camera on every drone whose images the policy observes, which ``make`` adds; None for none."""
        return None

    @property
    def criterion(self) -> str:
        """What success means, in messages."""
        if type(self).succeeded is not Task.succeeded:
            return "as the task judges it"
        return f"error below {self.tolerance:g} {self.unit} for the last {self.hold:g} s"

    def succeeded(self, data: SimData) -> Array | None:
        """Whether a drone has succeeded; None if success means that ``error`` stays small. (n_drones,)"""
        return None

    def _undefined(self, method: str) -> str:
        return f"task {self.name!r}: expected class {type(self).__name__} to define {method}; see docs/guides/tasks.md"


class _State:
    """Attribute of a task's class in place of a state, whose values are in the data."""

    def __init__(self, name: str):
        self._name = name

    def __get__(self, task: Task | None, owner: type[Task]) -> Any:
        raise AttributeError(
            f"expected data from which to read {self._name!r}, a state of {owner.__name__}. Use "
            f"self.read(data).{self._name}, and self.write(data, {self._name}=...)."
        )


def _move_states_to_record(cls: type[Task]) -> None:
    fields = {name: f for name, f in vars(cls).items() if isinstance(f, dataclasses.Field)}
    states = {name: f for name, f in fields.items() if "scope" in f.metadata or f.metadata.keys() == {"static"}}
    hints = inspect.get_annotations(cls)
    for name in states:
        require(
            name in hints, f"expected an annotation of state {name!r}, got none. Use {name}: jax.Array = state(...)."
        )
        require(
            not any(hasattr(base, name) for base in cls.__bases__),
            f"expected a state of another name than {name!r}, which is a method or a setting of a task. Rename it.",
        )
    plain = {f.name: f.type for f in dataclasses.fields(cls) if f.name in vars(cls)}  # such as ``seconds = 8.0``
    cls.__annotations__ = {name: hint for name, hint in (plain | hints).items() if name not in states}
    records = tuple(dict.fromkeys(base.Record for base in cls.__bases__ if getattr(base, "Record", None)))
    if not states and len(records) < 2:
        return
    for name in states:
        setattr(cls, name, _State(name))
    namespace = {"__module__": cls.__module__, "__qualname__": f"{cls.__qualname__}.Record"}  # where pickles look
    hints = {"__annotations__": {name: hints[name] for name in states}}
    cls.Record = type("Record", records or (PyTree,), {**namespace, **hints, **states})


def _initial_states(sim: Sim, record: type[PyTree], initial: Mapping[str, Any]) -> dict[str, Any]:
    fields = {f.name: f.metadata for f in dataclasses.fields(record)}  # type: ignore[arg-type]
    expect(
        initial.keys() <= fields.keys(), f"states among {', '.join(fields)}", ", ".join(initial.keys() - fields.keys())
    )
    values = dict(initial)
    for name, metadata in fields.items():
        value = values.get(name)
        if "scope" not in metadata or (value is None and metadata["optional"]):
            values.setdefault(name, None)
            continue
        batch, core = (sim.n_worlds, 1 if metadata["scope"] == "world" else sim.n_drones), metadata["shape"]
        number = 0 if value is None else value
        if any(isinstance(n, str) for n in core):
            expect(
                value is not None,
                f"a first value of {name}, of shape {core}",
                None,
                f"Use add_states(sim, {name}=...).",
            )
            core = np.shape(number)
        values[name] = device_array(
            np.broadcast_to(number, (*batch, *core)), metadata["dtype"] or sim.data.states.pos.dtype
        )
    return values


def sum_terms(terms: Mapping[str, Array]) -> Array:
    """Return the sum of the terms of a reward, in their order. (...)"""
    reward, *other_terms = terms.values()
    for term in other_terms:
        reward = reward + term
    return reward
