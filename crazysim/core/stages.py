"""The built-in stages: commands that take effect at their ticks, dynamics, floor and step counter."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.control import Control, Controller, force_torque2rotor_vel
from crazysim.control.protocol import controller_chain
from crazysim.core.controllers import controller_stages
from crazysim.core.data import SimData, SimState, SimStateDeriv, controls_of
from crazysim.core.integration import FLOOR_HEIGHT, INTEGRATORS, DerivFn, Integration, Integrator
from crazysim.core.pipeline import Pipeline
from crazysim.core.plugin import drawn_data
from crazysim.core.settings import as_mask
from crazysim.dynamics import Dynamics, first_principles, fitted
from crazysim.engine.pytree import n_batch_axes, scopes, select_worlds
from crazysim.engine.stage import Stage, StageScope, is_tick


def _built_in_stage(
    scope: StageScope, when: Callable[[SimData], Array | None] | None = None, **options: Any
) -> Callable[..., Stage]:
    return lambda fn: Stage(fn, scope, when, batched=True, trace_once=True, **options)


def _rate_condition(level: str) -> Callable[[SimData], Array | None]:
    return lambda data: is_tick(data, getattr(data.controls, level).freq)


def build_step_pipeline(
    control: Control, dynamics: Dynamics, integrator: Integrator, controller: Controller | None
) -> Pipeline:
    """Return the stages of one physics step, in order; ``controller`` is None if the commands need no controller."""
    is_fitted = dynamics != Dynamics.first_principles
    stages: Pipeline = {}
    chain, last_level = controller_chain(controller, control)
    for level, level_controller in chain:
        stages |= controller_stages(level_controller, level)
    if last_level == Control.attitude:
        stages["commit_attitude"] = commit_attitude
    if last_level == Control.force_torque:
        stages["force_torque_controller"] = force_torque_controller
    stages["clip_rotor_vel_cmd"] = clip_thrust_cmd if is_fitted else clip_rotor_vel_cmd
    deriv_fn: DerivFn = first_principles_derivative
    if is_fitted:
        deriv_fn = fitted_derivative
    elif integrator.order == 1:
        deriv_fn = first_principles_euler_derivative
    stages["integration"] = Integration(INTEGRATORS[integrator], deriv_fn, ground=clip_floor_pos.ground).stage()
    stages["clip_floor_pos"] = clip_floor_pos
    stages["increment_steps"] = increment_steps
    return stages


@_built_in_stage("drone", when=_rate_condition("attitude"))
def commit_attitude(data: SimData) -> SimData:
    """Apply the staged attitude command; fitted dynamics include the attitude controller."""
    attitude = data.controls.attitude
    attitude = attitude.replace(cmd=attitude.staged_cmd)
    return data.replace(controls=data.controls.replace(attitude=attitude))


@_built_in_stage("drone", when=_rate_condition("force_torque"))
def force_torque_controller(data: SimData) -> SimData:
    """Apply the staged wrench, and command the rotor speeds that produce it."""
    controls = controls_of(data)
    force_torque = controls.force_torque
    params = controls_of(drawn_data(data)).force_torque.params
    rotor_vel = force_torque2rotor_vel(force_torque.staged_cmd, params=params)
    new_force_torque = force_torque.replace(cmd=force_torque.staged_cmd)
    return data.replace(controls=controls.replace(force_torque=new_force_torque, rotor_vel=rotor_vel))


@_built_in_stage("drone")
def clip_rotor_vel_cmd(data: SimData) -> SimData:
    """Limit commanded rotor speeds to the range of the motors; zero or less switches a motor off."""
    rotor_vel = first_principles.saturate(controls_of(data).rotor_vel, drawn_data(data).params)
    return data.replace(controls=data.controls.replace(rotor_vel=rotor_vel))


@_built_in_stage("drone")
def clip_thrust_cmd(data: SimData) -> SimData:
    """Limit the commanded collective thrust to the range of the rotors; zero or less switches them off."""
    attitude = data.controls.attitude
    attitude = attitude.replace(cmd=fitted.saturate(attitude.cmd, data.params))
    return data.replace(controls=data.controls.replace(attitude=attitude))


def first_principles_derivative(data: SimData) -> SimStateDeriv:
    return _derivative(data, first_principles.dynamics, controls_of(data).rotor_vel)


def first_principles_euler_derivative(data: SimData) -> SimStateDeriv:
    """Return the derivative of every drone from first principles for an Euler step, stable at any body rate."""
    dynamics = functools.partial(first_principles.dynamics, dt=1 / data.core.freq)
    return _derivative(data, dynamics, controls_of(data).rotor_vel)


def fitted_derivative(data: SimData) -> SimStateDeriv:
    return _derivative(data, fitted.dynamics, data.controls.attitude.cmd)


def _derivative(data: SimData, dynamics: Callable[..., tuple[Array, ...]], cmd: Array) -> SimStateDeriv:
    s = data.states
    vel, acc, ang_acc, rotor_acc = dynamics(
        s.pos, s.quat, s.vel, s.ang_vel, cmd, s.rotor_vel, s.force, s.torque, params=data.params
    )
    return SimStateDeriv(vel=vel, ang_vel=s.ang_vel, acc=acc, ang_acc=ang_acc, rotor_acc=rotor_acc)


def stop_at_ground(s: SimState, ground: Array | float) -> SimState:
    """Return the states in which drones that have come down to the ground are at rest, ``FLOOR_HEIGHT`` above it.

    Drones that stand at the height of the ground itself, such as those at their start, stay there.

    Args:
        ground: Height of the ground, world frame, m. (..., 1)
    """
    height, climb_rate = s.pos[..., 2:], s.vel[..., 2:]
    rest_height = jnp.where(height == ground, ground, ground + FLOOR_HEIGHT)
    is_stopped = (height < rest_height) | ((height == rest_height) & (climb_rate <= 0))
    return s.replace(
        pos=jnp.concatenate([s.pos[..., :2], jnp.where(is_stopped, rest_height, height)], axis=-1),
        vel=jnp.where(is_stopped, 0.0, s.vel),
        ang_vel=jnp.where(is_stopped, 0.0, s.ang_vel),
    )


@_built_in_stage("drone", ground=lambda _: 0.0)
def clip_floor_pos(data: SimData) -> SimData:
    """Stop drones at the floor."""
    return data.replace(states=stop_at_ground(data.states, 0.0))


@_built_in_stage("world")
def increment_steps(data: SimData) -> SimData:
    """Count the step."""
    return data.replace(core=data.core.replace(steps=data.core.steps + 1))


def reset(data: SimData, default_data: SimData, mask: Array | None = None) -> SimData:
    """Return the data with some worlds, or the whole simulation, reset to the default data.

    With a mask, all leaves with batch axes are restored in the worlds of the mask. Other leaves are unchanged: shared
    parameters, and opaque leaves of plugins. Without a mask, all leaves are restored. In both cases, the seed and the
    records of plugins that the default data lack are unchanged. A parameter that has become one value per drone is
    restored to its default value, but keeps its shape.

    Args:
        mask: True in the worlds to reset; None for all. (n_worlds,)
    """
    mask = as_mask(mask, data.core.steps.shape[:1])
    plugins = {name: default_data.plugins.get(name, plugin) for name, plugin in data.plugins.items()}

    def restore(scope: str, x: Array, default: Array) -> Array:
        if n_batch_axes(scope):
            return select_worlds(mask, default, x)
        return default if mask is None else x

    new_data = jax.tree.map(restore, scopes(data), data, default_data.replace(plugins=plugins))
    episode = select_worlds(mask, data.core.episode + 1, data.core.episode)
    return new_data.replace(core=new_data.core.replace(episode=episode, rng_key=data.core.rng_key))
