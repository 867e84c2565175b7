"""Hooks: functions that wrappers add to resets and environment steps. Most hooks receive the state of one world."""

from __future__ import annotations

from typing import Any

from jax import Array

from crazysim.core.data import SimData
from crazysim.envs.state import EnvState


class Hooks:
    """Functions that resets and the phases of an environment step call; wrappers override them.

    | Hook | When it is called |
    | --- | --- |
    | ``prepare(data)`` | once in ``reset``, with the data of all worlds |
    | ``after_spawn(data)`` | at the start of an episode, after the task has placed drones and goals |
    | ``after_reset(state)`` | at the start of an episode, after the observations of the task have been computed |
    | ``before_step(state, action)`` | before the physics; the outermost wrapper is called first |
    | ``after_step(state)`` | after observations and reward; the innermost wrapper is called first |
    | ``look(state)`` | at the end of ``reset`` and ``step``, with the state of all worlds |

    Unless ``batched`` is set, all hooks but ``prepare`` and ``look`` receive one world, without the axis of worlds. The
    memory of a wrapper is ``state.memory[self.name]``; see ``remember`` and ``recall``. It has one entry per world. If
    it is a record (``PyTree``), its fields declared ``leaf("drone")`` have one entry per drone.
    """

    name: str = ""
    """Key of the wrapper's memory in ``state.memory``; the name of the class if empty. If another wrapper of an
    environment has the same name, a number is appended."""
    batched: bool = False
    """True for a wrapper that needs all worlds at once: its hooks then receive the axis of worlds, and the phases of an
    environment step are not fused; the stages of the physics still are. Fields of its memory without that axis must be
    declared ``leaf("shared")``."""

    def prepare(self, data: SimData) -> SimData:
        """Return the data of all worlds before their first episode."""
        return data

    def after_spawn(self, data: SimData) -> SimData:
        """Return the data at the start of an episode, after the task has placed drones and goals."""
        return data

    def after_reset(self, state: EnvState) -> EnvState:
        """Return the state at the start of an episode, with the wrapper's observations and initial memory."""
        return state

    def before_step(self, state: EnvState, action: Array) -> tuple[EnvState, Array]:
        """Return the state and the action to pass to the next inner wrapper or the task.

        The action has shape (n_drones, k), with k numbers per drone.
        """
        return state, action

    def after_step(self, state: EnvState) -> EnvState:
        """Return the state after the step."""
        return state

    def look(self, state: EnvState) -> EnvState:
        """Return the state of all worlds with new images in ``state.record.images``, which are observations.

        Images are taken by separate kernels, once at the end of each step. New episodes have begun by then. A wrapper
        may also change its memory, which has no entry in the first call unless ``after_reset`` made one.
        """
        return state

    def describe_images(self) -> dict[str, dict[str, Any]]:
        """Return the format of each image that ``look`` takes, by name, for networks and exports.

        A format is a dict that can be written as JSON: ``height`` and ``width``, pixels; ``unit``, the unit of a
        pixel's value, such as ``"m"`` for depths; ``has_gradient``, whether it has derivatives, by default True; and
        entries that describe the camera (``ImageSensor.describe``).
        """
        return {}

    def recall(self, state: EnvState) -> Any:
        """Return the memory of this wrapper."""
        return state.memory[self.name]

    def remember(self, state: EnvState, memory: Any, **changes: Any) -> EnvState:
        """Return the state with new memory of this wrapper, and with other changed fields."""
        return state.replace(memory=state.memory | {self.name: memory}, **changes)
