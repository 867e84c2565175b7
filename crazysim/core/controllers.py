"""Stages of the controllers that take the place of Crazyflow's cascade."""

from __future__ import annotations

from typing import Any

from jax import Array

from crazysim.control import Control, Controller, Setpoint
from crazysim.core.data import SimData, controls_of
from crazysim.core.pipeline import Pipeline
from crazysim.core.stage import Stage, tick


def controller_stages(controller: Controller, control: Control) -> Pipeline:
    """Return the stages of a controller, in order.

    One stage puts the staged command in force and commands the rotors or the allocation. With an outer loop there are
    two: the first puts the setpoint in force at the rate of the outer loop, the second commands at the controller's.
    """
    level = control.value

    def command_ticks(data: SimData) -> Array | None:
        return tick(data, getattr(data.controls, level).freq)

    def controller_ticks(data: SimData) -> Array | None:
        return tick(data, data.controls.controller.freq)

    def outer(data: SimData) -> SimData:
        data = with_staged_command(data)
        own = data.controls.controller
        setpoint: Any = command_in_force(data)
        memory = controller.outer(data, setpoint, own.memory, own.params)
        return data.replace(controls=data.controls.replace(controller=own.replace(memory=memory)))

    def inner(data: SimData) -> SimData:
        own, controls = data.controls.controller, data.controls
        command, memory = controller.update(data, command_in_force(data), own.memory, own.params)
        if controller.output == Control.rotor_vel:
            controls = controls.replace(rotor_vel=command)
        elif controller.output == Control.attitude:
            controls = controls.replace(attitude=controls.attitude.replace(staged_cmd=command))
        else:
            controls = controls.replace(force_torque=controls.force_torque.replace(staged_cmd=command))
        return data.replace(controls=controls.replace(controller=own.replace(memory=memory)))

    def both(data: SimData) -> SimData:
        return inner(with_staged_command(data))

    name = f"{level}_controller"
    if control == Control.state and controller.has_outer:
        return {
            name: Stage(outer, "drone", command_ticks, name=name),
            "attitude_controller": Stage(inner, "drone", controller_ticks, name="attitude_controller"),
        }
    return {name: Stage(both, "drone", controller_ticks, name=name)}


def with_staged_command(data: SimData) -> SimData:
    """Return the data of one drone with the staged command in force."""
    controls = controls_of(data)
    ctrl = getattr(controls, controls.mode.value)
    ctrl = ctrl.replace(cmd=ctrl.staged_cmd)
    if controls.mode == Control.state:
        ctrl = ctrl.replace(feedforward=ctrl.staged_feedforward)
    return data.replace(controls=controls.replace(**{controls.mode.value: ctrl}))


def command_in_force(data: SimData) -> Setpoint | Array:
    """Return the command in force of one drone: a setpoint at the level ``state``, otherwise four numbers."""
    controls = controls_of(data)
    if controls.mode == Control.state:
        return Setpoint.of_command(controls.state.cmd, controls.state.feedforward)
    return getattr(controls, controls.mode.value).cmd
