"""Latency: commands that reach the drone a fixed number of steps after they were sent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.control import Control
from crazysim.core.data import SimData
from crazysim.core.functional import stage_command, staged_leaves
from crazysim.core.plugin import Param, Plugin, Simulation, StagePlacement, check_parameter, param, state
from crazysim.core.settings import setting
from crazysim.engine.pytree import device_array
from crazysim.engine.stage import Stage, as_stages
from crazysim.errors import ConfigError
from crazysim.tables import range_between

MAX_DELAY = 100_000
"""Upper limit of the delay, steps."""


class Latency(Plugin):
    """A delay of the commands, for the command level of the simulation.

    A command that is sent before step i reaches the controller at step i + delay; a rotor command reaches the motors in
    that step. Until the first command arrives, the drone follows the command that was staged when the plugin was added,
    or after a reset the command of the default data.
    """

    delay: Param = param(low=0, high=MAX_DELAY, dtype=np.int32)
    """Delay, a whole number of steps. (1,)"""
    max_delay: int | None = setting(default=None, low=0, high=MAX_DELAY)
    """Largest delay to which the record can be changed later, steps; None for the largest value of ``delay``."""
    queue: Array = state(("rows", "command"))
    """Commands of the last steps; the command of step i is in row i modulo n_rows. n_rows is the largest possible delay
    plus one. (n_worlds, n_drones, n_rows, k)"""
    arrived: Array = state(("command",))
    """Latest command that has arrived. (n_worlds, n_drones, k)"""
    name: str = "latency"
    order: ClassVar[int] = -1  # before the effects that limit commands, so that they also limit late commands

    def bind(self, sim: Simulation) -> Latency:
        return self._with_queue(sim, sim.data)

    def default_record(self, sim: Simulation) -> Latency:
        return self._with_queue(sim, sim.default_data)

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        queue_stage = self.stage(self.move_queue)
        if sim.data.controls.mode == Control.rotor_vel:
            return [StagePlacement(queue_stage)]
        name = _controller_stage(sim)
        (controller,) = as_stages({name: sim.step_pipeline[name]})
        return [
            StagePlacement(queue_stage, before=name),
            StagePlacement(self._delayed_controller(controller), replaces=name, name=name),
        ]

    def known_data(self, data: SimData) -> SimData:
        return data  # the delayed controller reads numbers as drawn itself

    def influence(self, data: SimData) -> SimData:
        return _with_command(data, self.arrived) if data.controls.mode == Control.rotor_vel else data

    def move_queue(self, data: SimData) -> SimData:
        """Put the staged command of one drone into its queue, and take the arriving command out."""
        step, length = data.core.steps, self.queue.shape[0]
        queue = self.queue.at[step % length].set(_staged_command(data))
        arrived = queue[(step - self.delay[0]) % length]
        return self.write(data, self.replace(queue=queue, arrived=arrived))

    def _delayed_controller(self, controller: Stage) -> Stage:
        scope: Any = controller.scope

        def run_on_delayed_command(data: SimData) -> SimData:
            return _with_command(controller.fn(_with_command(data, self.read(data).arrived)), _staged_command(data))

        return Stage(run_on_delayed_command, scope, controller.when, controller.batched, controller.__name__)

    def _with_queue(self, sim: Simulation, data: SimData) -> Latency:
        delay, max_delay = np.asarray(self.delay), self.max_delay
        max_delay = int(np.max(delay)) if max_delay is None else max_delay
        steps = check_parameter(sim, "delay", delay, (1,), range_between(0, max_delay), jnp.int32)
        command = _staged_command(data)
        queue = np.repeat(np.asarray(command)[..., None, :], int(max_delay) + 1, axis=-2)
        return self.with_arrays(sim, delay=steps, queue=device_array(queue, command.dtype), arrived=command)


def _controller_stage(sim: Simulation) -> str:
    mode = sim.data.controls.mode.value
    for name in (f"{mode}_controller", f"commit_{mode}"):
        if name in sim.step_pipeline:
            return name
    raise ConfigError(
        f"expected a stage '{mode}_controller', whose commands could be delayed, got a step pipeline without it"
    )


def _staged_command(data: SimData) -> Array:
    return jnp.concatenate(staged_leaves(data), axis=-1)


def _with_command(data: SimData, command: Array) -> SimData:
    n = staged_leaves(data)[0].shape[-1]
    return stage_command(data, command[..., :n], command[..., n:])
