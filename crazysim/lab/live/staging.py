"""Staging of the commands that processes write, once per control step, and compilation of the step."""

from __future__ import annotations

import jax
import numpy as np
from numpy.typing import NDArray

from crazysim.control import Control
from crazysim.core.functional import staged_leaves
from crazysim.sim.sim import Sim

DEFAULT_STATE_COMMAND = np.eye(16)[12]
"""State command of a drone that has not received one: level at the origin. (16,)"""


class StagedCommands:
    """The command of every drone, at the simulation's command level; nothing is staged before ``array`` is accessed."""

    def __init__(self, sim: Sim):
        self._sim = sim
        self._array: NDArray | None = None
        self._staged_copy: NDArray | None = None

    @property
    def array(self) -> NDArray:
        """Command of every drone, writable. (n_worlds, n_drones, k)"""
        if self._array is None:
            self._array = _initial_commands(self._sim)
        return self._array

    def stage(self) -> None:
        """Stage the commands if they have changed since the last call."""
        if self._array is None or (self._staged_copy is not None and np.array_equal(self._array, self._staged_copy)):
            return
        self._staged_copy = self._array.copy()
        getattr(self._sim, f"{self._sim.control.value}_control")(self._staged_copy)

    def copy(self) -> NDArray | None:
        return None if self._array is None else self._array.copy()

    def restore(self, array: NDArray | None) -> None:
        """Restore commands that ``copy`` returned; None restores the commands that are staged in the data."""
        self._staged_copy = None
        if array is not None:
            self.array[:] = array
        elif self._array is not None:
            self._array[:] = _initial_commands(self._sim)


def compile_step(sim: Sim, n_steps: int) -> None:
    """Compile the step ahead of time: run ``n_steps`` steps, and restore the data."""
    with sim.lock:
        data = sim.data
        sim.step(n_steps)
        jax.block_until_ready(sim.data.states.pos)
        sim.data = data


def _initial_commands(sim: Sim) -> NDArray:
    command = np.array(staged_leaves(sim.data)[0], float)
    if sim.control == Control.state:
        is_unset = (command == DEFAULT_STATE_COMMAND).all(-1)
        command[is_unset, :3] = np.asarray(sim.data.states.pos, float)[is_unset]
    return command
