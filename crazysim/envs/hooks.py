"""Hooks: functions that wrappers add to the phases of an environment step, most of them of one world."""

from __future__ import annotations

from typing import Any

from jax import Array

from crazysim.core.data import SimData
from crazysim.envs.state import EnvState


class Hooks:
    """Functions of one world that the phases of an environment step call; wrappers override them.

    | Hook | When it is called |
    | --- | --- |
    | ``prepare(data)`` | once in ``reset``, with the data of all worlds |
    | ``after_spawn(data)`` | at the start of an episode, after the task has placed drones and goals |
    | ``after_reset(state)`` | at the start of an episode, after the task has been observed |
    | ``before_step(state, action)`` | before the physics; the outermost wrapper is called first |
    | ``after_step(state)`` | after observations and reward; the innermost wrapper is called first |
    | ``look(state)`` | at the end of ``reset`` and ``step``, with the state of all worlds |

    All hooks but ``prepare`` and ``look`` receive one world, without the axis of worlds: (n_drones, k). The memory of a
    wrapper is ``state.memory[self.name]``; see ``remember`` and ``recall``. It is stored per world, except fields that
    a record declares with ``leaf("drone")``, which a fused step divides among the drones.
    """

    name: str = ""
    """Key of the wrapper's memory in ``state.memory``; the name of the class if empty. A second wrapper of that name
    around an environment gets a number appended."""
    batched: bool = False
    """True for a wrapper that needs all worlds at once: its hooks then receive the axis of worlds, and steps are not
    fused. Leaves of its memory without that axis must be declared ``leaf("shared")``."""

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
        """Return the state and the action to pass to the next inner wrapper or the task. (n_drones, k)"""
        return state, action

    def after_step(self, state: EnvState) -> EnvState:
        """Return the state after the step."""
        return state

    def look(self, state: EnvState) -> EnvState:
        """Return the state of all worlds with new images in ``state.record.images``, which are observations.

        They are taken once per step, after new episodes have begun, by separate kernels. The wrapper's memory may
        change, too; before the first episode it is empty.
        """
        return state

    def describe_images(self) -> dict[str, dict[str, Any]]:
        """Return the format of each image that ``look`` takes, by name, for networks and exports.

        Each is a dict that JSON can hold: ``height`` and ``width`` in pixels, ``unit`` of a pixel, ``"m"`` for depths,
        and the model of the camera.
        """
        return {}

    def recall(self, state: EnvState) -> Any:
        """Return the memory of this wrapper."""
        return state.memory[self.name]

    def remember(self, state: EnvState, memory: Any, **changes: Any) -> EnvState:
        """Return the state with new memory of this wrapper, and with other changed fields."""
        return state.replace(memory=state.memory | {self.name: memory}, **changes)
