"""Latency: commands that reach the drone a whole number of steps after they were sent."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.control import Control
from crazysim.core.data import SimData
from crazysim.core.pipeline import replace_fn
from crazysim.core.stage import Stage, as_stages, stage
from crazysim.effects.core import Simulation, as_setting, controls_of, install
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree, leaf


class Latency(PyTree):
    """Commands on their way."""

    delay: Array = leaf("parameter", 1, (1,))
    """Steps from sending a command to its arrival. (1,)"""
    queue: Array = leaf("drone", 2)
    """What was sent in the last steps, that of step i in row i modulo n_rows. (n_worlds, n_drones, n_rows, k)"""
    arrived: Array = leaf("drone", 1)
    """Command that has arrived by now. (n_worlds, n_drones, k)"""


def add(sim: Simulation, delay: Any, max_delay: int | None = None) -> None:
    """Let commands of the simulation's own level arrive late.

    A command that is sent before step i is what the controller finds staged at step i + delay; at the level of rotor
    speeds it is what the motors are told in that step. Until the first one arrives, the command that was staged when
    the effect was added (after a reset, that of the default data) stays in force.

    Args:
        sim: The simulation.
        delay: Steps, whole numbers. () or (n_worlds, n_drones)
        max_delay: Largest delay that the record can be given later on; None for the largest of ``delay``.

    Raises:
        ConfigError: If a setting cannot be, or there is latency already.
    """
    longest = int(np.max(delay)) if max_delay is None and np.size(delay) else max_delay
    if isinstance(longest, bool) or not isinstance(longest, (int, np.integer)) or longest < 0:
        raise ConfigError(
            f"max_delay is {max_delay!r} and delay {delay!r}; needed are whole numbers of steps from 0 on"
        )
    steps = as_setting(sim, "delay", delay, (1,), 0, longest, jnp.int32)
    record, default = (_waiting(data, steps, int(longest) + 1) for data in (sim.data, sim.default_data))
    if sim.data.controls.mode == Control.rotor_vel:
        install(sim, "latency", record, queue_up, late_rotor_vel, default, felt_first=True)
        return
    name = _controller(sim)
    (controller,) = as_stages({name: sim.step_pipeline[name]})
    install(sim, "latency", record, queue_up, default=default, before=name)
    replace_fn(sim.step_pipeline, _late(controller), name)
    sim.build_step_fn()


@stage("drone")
def queue_up(data: SimData) -> SimData:
    """Put what was sent to one drone at the end of its queue, and take out what has arrived."""
    latency, step = data.plugins["latency"], data.core.steps
    length = latency.queue.shape[0]
    queue = latency.queue.at[step % length].set(_sent(data))
    arrived = queue[(step - latency.delay[0]) % length]
    return data.replace(plugins=data.plugins | {"latency": latency.replace(queue=queue, arrived=arrived)})


def late_rotor_vel(data: SimData) -> SimData:
    """Return the data with the rotor speeds that have arrived in place of those that were sent."""
    return _send(data, data.plugins["latency"].arrived)


def _late(controller: Stage) -> Stage:
    """Return a controller that finds staged what has arrived, and leaves staged what was sent."""
    scope: Any = controller.scope

    def late(data: SimData) -> SimData:
        return _send(controller.fn(_send(data, data.plugins["latency"].arrived)), _sent(data))

    return Stage(late, scope, controller.when, controller.batched, controller.__name__)


def _controller(sim: Simulation) -> str:
    """Return the name of the stage that takes over commands of the simulation's own level."""
    mode = sim.data.controls.mode.value
    for name in (f"{mode}_controller", f"commit_{mode}"):
        if name in sim.step_pipeline:
            return name
    raise ConfigError(f"the step has no stage '{mode}_controller' to which commands could come late")


def _sent(data: SimData) -> Array:
    """Return the command of the simulation's own level as it was sent. (..., k)"""
    controls = controls_of(data)
    return controls.rotor_vel if controls.mode == Control.rotor_vel else getattr(controls, controls.mode).staged_cmd


def _send(data: SimData, command: Array) -> SimData:
    """Return the data with another command of the simulation's own level."""
    controls = controls_of(data)
    if controls.mode == Control.rotor_vel:
        return data.replace(controls=controls.replace(rotor_vel=command))
    level = getattr(controls, controls.mode).replace(staged_cmd=command)
    return data.replace(controls=controls.replace(**{controls.mode.value: level}))


def _waiting(data: SimData, delay: Array, length: int) -> Latency:
    """Return a queue that is full of the command that is staged now."""
    command = _sent(data)
    return Latency(delay, jnp.repeat(command[..., None, :], length, axis=-2), command)
