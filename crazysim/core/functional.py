"""Operations of ``Sim`` as pure functions on ``SimData``, for use inside jit, vmap, grad and scan."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.control import COMMAND_FIELDS, Control, Setpoint
from crazysim.core.data import SimData, command_shape
from crazysim.core.stage import tick
from crazysim.errors import ConfigError

FEEDFORWARD = "jerk x, y, z [m/s^3], snap x, y, z [m/s^4], yaw rate [rad/s], yaw acceleration [rad/s^2]"
"""Entries of a feedforward with their units, for messages."""


def state_control(data: SimData, controls: Any, check_finite: bool = False, *, feedforward: Any = None) -> SimData:
    """Stage a full-state setpoint for every drone.

    Args:
        data: Data of a simulation built with ``control="state"``.
        controls: Position, velocity, acceleration, quaternion (xyzw), body rates. (n_worlds, n_drones, 16)
        check_finite: True to check device arrays too, which waits for the device; host input is always checked.
        feedforward: Jerk, m/s^3, snap, m/s^4, yaw rate, rad/s, yaw acceleration, rad/s^2; None for the yaw rate of the
            setpoint and zeros. Crazyflow's cascade takes none. (n_worlds, n_drones, 8)

    Raises:
        ValueError: Wrong shape, type or command level, or a NaN or infinite command.
    """
    command = check_command(data, Control.state, controls, check_finite)
    if feedforward is None:
        return stage_command(data, command)
    if data.controls.state.staged_feedforward is None:
        raise ConfigError("expected no feedforward, which Crazyflow's cascade cannot follow. Use Sim(controller=...).")
    shape = (*command.shape[:-1], 8)
    return stage_command(data, command, _as_command(data, "feedforward", shape, FEEDFORWARD, feedforward, check_finite))


def attitude_control(data: SimData, controls: Any, check_finite: bool = False) -> SimData:
    """Stage roll, pitch, yaw, rad, and collective thrust, N, for every drone. (n_worlds, n_drones, 4)

    Arguments and errors as in ``state_control``.
    """
    return stage_command(data, check_command(data, Control.attitude, controls, check_finite))


def body_rate_control(data: SimData, controls: Any, check_finite: bool = False) -> SimData:
    """Stage body rates, rad/s, and collective thrust, N, for every drone. (n_worlds, n_drones, 4)

    Arguments and errors as in ``state_control``.
    """
    return stage_command(data, check_command(data, Control.body_rate, controls, check_finite))


def force_torque_control(data: SimData, controls: Any, check_finite: bool = False) -> SimData:
    """Stage collective thrust, N, and body torque, N m, for every drone. (n_worlds, n_drones, 4)

    Arguments and errors as in ``state_control``.
    """
    return stage_command(data, check_command(data, Control.force_torque, controls, check_finite))


def rotor_vel_control(data: SimData, controls: Any, check_finite: bool = False) -> SimData:
    """Command rotor speeds, rpm, for every drone; they hold from the next step on. (n_worlds, n_drones, n_rotors)

    Arguments and errors as in ``state_control``.
    """
    return stage_command(data, check_command(data, Control.rotor_vel, controls, check_finite))


def stage_command(data: SimData, command: Array, feedforward: Array | None = None) -> SimData:
    """Return the data with a command at its command level, which is not checked.

    For data of one drone, one world or all worlds alike. Rotor speeds take effect at the next step, other commands at
    the next tick of their controller.

    Args:
        data: The simulation.
        command: Command in the units of ``data.controls.mode``. (..., k)
        feedforward: Feedforward of a setpoint; None for the yaw rate of the setpoint and zeros. (..., 8)
    """
    controls, mode = data.controls, data.controls.mode
    if mode == Control.rotor_vel:
        return data.replace(controls=controls.replace(rotor_vel=command))
    level = getattr(controls, mode.value).replace(staged_cmd=command)
    if mode == Control.state and level.staged_feedforward is not None:
        if feedforward is None:
            feedforward = _feedforward_of(command)
        level = level.replace(staged_feedforward=feedforward)
    return data.replace(controls=controls.replace(**{mode.value: level}))


@jax.jit
def _feedforward_of(command: Array) -> Array:
    """Return the feedforward of a setpoint that is given without one."""
    return Setpoint.of_command(command).feedforward()


def time(data: SimData) -> Array:
    """Return the time since each world's last reset, s. (n_worlds, 1)"""
    return data.core.steps / data.core.freq


def controllable(data: SimData) -> Array:
    """Return True in worlds where a staged command takes effect at the next step. (n_worlds, 1)"""
    mode = data.controls.mode
    mask = None if mode == Control.rotor_vel else tick(data, getattr(data.controls, mode.value).freq)
    return jnp.ones_like(data.core.steps, bool) if mask is None else mask


def check_command(data: SimData, control: Control, command: Any, check_finite: bool = False) -> Array:
    """Return a command as an array of the state's dtype.

    Raises:
        ValueError: Wrong shape, type or command level, or a NaN or infinite command.
    """
    if data.controls.mode != control:
        raise ConfigError(
            f"this simulation takes {data.controls.mode.value!r} commands, not {control.value!r}. "
            f"Call {data.controls.mode.value}_control, or build it with Sim(control={control.value!r})."
        )
    return _as_command(
        data, control.value, command_shape(data, control), COMMAND_FIELDS[control], command, check_finite
    )


def _as_command(
    data: SimData, name: str, shape: tuple[int, ...], fields: str, command: Any, check_finite: bool
) -> Array:
    """Return a command of some shape as an array of the state's dtype, as ``check_command``."""
    on_host = not isinstance(command, jax.Array)
    try:
        array = np.asarray(command) if on_host else command
    except ValueError as error:
        raise ValueError(f"expected the {name} command as a regular array, got {command!r}") from error
    if array.shape != shape:
        raise ValueError(
            f"{name} command has shape {array.shape}; expected {shape} = "
            f"(n_worlds, n_drones, {shape[-1]}): {fields}. "
            f"For one command to all drones use np.broadcast_to(cmd, {shape})."
        )
    if not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
        raise ValueError(f"expected real numbers as {name} command, got type {array.dtype}; use float32")
    dtype = data.states.pos.dtype
    # Host input of any type reaches the device with one dtype and placement, so nothing is traced or compiled again.
    with np.errstate(over="ignore"):  # a number too large for the dtype becomes infinite, which is reported below
        array = array.astype(dtype)
    is_tracer = isinstance(array, jax.core.Tracer)
    if (on_host or (check_finite and not is_tracer)) and not np.all(np.isfinite(array)):
        worlds = np.unique(np.nonzero(~np.isfinite(np.asarray(array)))[0])[:8]
        raise ValueError(
            f"{name} command is NaN or infinite in world(s) {worlds.tolist()}, as {dtype}, which would last "
            f"until their next reset; check the computation that returns it"
        )
    inside_jit = is_tracer or isinstance(data.states.pos, jax.core.Tracer)
    return jnp.asarray(array) if inside_jit else jax.device_put(array, data.states.pos.sharding)
