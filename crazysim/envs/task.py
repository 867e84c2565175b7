"""Base class of tasks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from jax import Array

from crazysim.core.data import SimData
from crazysim.core.plugin import FunctionPlugin, StagePlacement
from crazysim.core.settings import check_settings, setting
from crazysim.engine.pytree import PyTree
from crazysim.envs.state import Obs
from crazysim.errors import ConfigError
from crazysim.plugins.sensors.image_sensor import ImageSensor
from crazysim.sim.sim import Sim

MAX_SECONDS = 1e5
"""Longest episode, s. A 32-bit counter of its physics steps does not overflow at up to 10,000 Hz."""
TASK_RECORD_NAME = "task"
"""Name of a task's record in ``data.plugins``."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """A task: settings in a frozen dataclass, and methods that are pure functions of one world.

    Subclasses are frozen dataclasses. They define ``name``, ``spawn``, ``observe``, ``rewards``, ``terminated`` and
    ``error``, and whatever else they need. In the data that they receive, arrays per drone are (n_drones, ...), and
    arrays per world have no batch axes. A task keeps state between steps in a record ``data.plugins["task"]``, which
    ``install`` adds.
    """

    name: ClassVar[str] = ""
    """Name in messages and files; also the name of its random stream."""
    Record: ClassVar[type[PyTree] | None] = None
    """Type of the record in ``data.plugins["task"]``; None if there is none."""
    batched: ClassVar[bool] = False
    """True for a task that needs all worlds at once. Its methods then receive the data of all worlds, with all batch
    axes, and one key per world. The phases of an environment step are then not fused."""

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

    def __post_init__(self) -> None:
        """Check the settings that do not depend on a simulation."""
        check_settings(self)

    def install(self, sim: Sim) -> None:
        """Add the objects, the record and the stages of the task to a simulation. Call it once, before ``DroneEnv``."""

    def add_record(self, sim: Sim, record: PyTree, placements: Sequence[StagePlacement] = ()) -> None:
        """Add the task's record, for all worlds, and stages that update it; for use in ``install``.

        Args:
            sim: The simulation.
            record: The record, for ``data.plugins["task"]``.
            placements: Stages with their positions, such as ``StagePlacement(stage, before="increment_steps")``.
        """
        sim.add(FunctionPlugin(TASK_RECORD_NAME, record, placements))

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
            data: The world.
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
        """Return True where the episode ended by success or failure. ()"""
        raise NotImplementedError(self._undefined("terminated(data)"))

    def error(self, data: SimData) -> Array:
        """Return the task error of every drone, in ``unit``. (n_drones,)"""
        raise NotImplementedError(self._undefined("error(data)"))

    def info(self, data: SimData) -> dict[str, Array]:
        """Return further quantities for ``state.info``, by name. () or (n_drones, ...) each"""
        return {}

    def target(self, data: SimData) -> Array | None:
        """Return the target position of each drone, or several marks per drone, to draw in images, m; None if none.

        Returns:
            (n_drones, 3) or (n_drones, n_marks, 3)
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

    def succeeded(self, data: SimData) -> Array | None:
        """Return True where a drone has succeeded; None if success means that ``error`` stays small. (n_drones,)"""
        return None

    def _undefined(self, method: str) -> str:
        return f"task {self.name!r}: expected class {type(self).__name__} to define {method}; see docs/guides/tasks.md"


def sum_terms(terms: Mapping[str, Array]) -> Array:
    """Return the sum of the terms of a reward, in their order. (...)"""
    reward, *other_terms = terms.values()
    for term in other_terms:
        reward = reward + term
    return reward
