"""Stages of controllers: staged commands take effect, and the controller's command is staged for the level below."""

from __future__ import annotations

from typing import Any

from jax import Array

from crazysim.control import Control, Controller, Setpoint
from crazysim.core.data import SimData, controls_of
from crazysim.core.pipeline import Pipeline
from crazysim.core.plugin import drawn_data
from crazysim.engine.stage import Stage, is_tick


def controller_stages(controller: Controller, control: Control) -> Pipeline:
    """Return the stages of a controller that follows a command level, in order.

    One stage puts the staged command in force, and stages the command of the level below or sets the rotor speeds. A
    controller with an outer loop has two stages. The first runs at the rate of the outer loop and puts the setpoint in
    force; the second runs at the rate of the controller and stages the command or sets the rotor speeds.
    """
    level = control.value

    def is_command_tick(data: SimData) -> Array | None:
        return is_tick(data, getattr(data.controls, level).freq)

    def is_controller_tick(data: SimData) -> Array | None:
        return is_tick(data, getattr(data.controls, level).controller.freq)

    def run_outer(data: SimData) -> SimData:
        data = _apply_staged_command(data, control)
        record = getattr(drawn_data(data).controls, level).controller
        setpoint: Any = _command_in_force(data, control)
        return _replace_memory(data, control, controller.outer(data, setpoint, record.memory, record.params))

    def run_inner(data: SimData) -> SimData:
        record = getattr(drawn_data(data).controls, level).controller
        command, memory = controller.update(data, _command_in_force(data, control), record.memory, record.params)
        return _replace_memory(_stage_output(data, controller.output, command), control, memory)

    def run_controller(data: SimData) -> SimData:
        return run_inner(_apply_staged_command(data, control))

    name = f"{level}_controller"
    if control == Control.state and controller.has_outer:
        return {
            name: Stage(run_outer, "drone", is_command_tick, name=name),
            "attitude_controller": Stage(run_inner, "drone", is_controller_tick, name="attitude_controller"),
        }
    return {name: Stage(run_controller, "drone", is_controller_tick, name=name)}


def _apply_staged_command(data: SimData, level: Control) -> SimData:
    controls = controls_of(data)
    level_controls = getattr(controls, level.value)
    level_controls = level_controls.replace(cmd=level_controls.staged_cmd)
    if level == Control.state:
        level_controls = level_controls.replace(feedforward=level_controls.staged_feedforward)
    return data.replace(controls=controls.replace(**{level.value: level_controls}))


def _command_in_force(data: SimData, level: Control) -> Setpoint | Array:
    level_controls = getattr(data.controls, level.value)
    return (
        Setpoint.of_command(level_controls.cmd, level_controls.feedforward)
        if level == Control.state
        else level_controls.cmd
    )


def _stage_output(data: SimData, level: Control, command: Array) -> SimData:
    controls = controls_of(data)
    if level == Control.rotor_vel:
        return data.replace(controls=controls.replace(rotor_vel=command))
    level_controls = getattr(controls, level.value).replace(staged_cmd=command)
    if level == Control.attitude and level_controls.staged_ang_vel_des is not None:
        level_controls = level_controls.replace(staged_ang_vel_des=controls.state.cmd[..., 13:16])
    return data.replace(controls=controls.replace(**{level.value: level_controls}))


def _replace_memory(data: SimData, level: Control, memory: Any) -> SimData:
    level_controls = getattr(data.controls, level.value)
    level_controls = level_controls.replace(controller=level_controls.controller.replace(memory=memory))
    return data.replace(controls=data.controls.replace(**{level.value: level_controls}))
