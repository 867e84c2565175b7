"""What ``Sim`` does, as pure functions on ``SimData``: for use inside jit, vmap, grad and scan."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.control import COMMAND_FIELDS, Control
from crazysim.core.data import SimData, command_shape
from crazysim.core.stages import tick
from crazysim.errors import ConfigError


def state_control(data: SimData, controls: Any, check_finite: bool = False) -> SimData:
    """Stage a full-state setpoint for every drone.

    Args:
        data: The simulation, built with ``control="state"``.
        controls: Position, velocity, acceleration, quaternion (xyzw), body rates. (n_worlds, n_drones, 16)
        check_finite: Whether to look at device arrays too, which waits for the device; host input is always
            looked at.

    Raises:
        ValueError: Wrong shape, type or command level, or a NaN or infinite command.
    """
    return stage_command(data, check_command(data, Control.state, controls, check_finite))


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


def stage_command(data: SimData, command: Array) -> SimData:
    """Return the data with a command at its command level, which is not checked.

    For data of one drone, one world or all worlds alike. Rotor speeds take effect at the next step, other commands at
    the next tick of their controller.

    Args:
        data: The simulation.
        command: Command in the units of ``data.controls.mode``. (..., k)
    """
    controls, mode = data.controls, data.controls.mode
    if mode == Control.rotor_vel:
        return data.replace(controls=controls.replace(rotor_vel=command))
    level = getattr(controls, mode.value).replace(staged_cmd=command)
    return data.replace(controls=controls.replace(**{mode.value: level}))


def time(data: SimData) -> Array:
    """Return the time since each world's last reset, s. (n_worlds, 1)"""
    return data.core.steps / data.core.freq


def controllable(data: SimData) -> Array:
    """Return True in worlds where a staged command takes effect at the next step. (n_worlds, 1)"""
    mode = data.controls.mode
    mask = None if mode == Control.rotor_vel else tick(data, getattr(data.controls, mode.value).freq)
    return jnp.ones_like(data.core.steps, bool) if mask is None else mask


def check_command(data: SimData, control: Control, command: Any, check_finite: bool = False) -> Array:
    """Return a command as an array of the state's type, or say what is wrong with it.

    Raises:
        ValueError: Wrong shape, type or command level, or a NaN or infinite command.
    """
    if data.controls.mode != control:
        raise ConfigError(
            f"this simulation takes {data.controls.mode.value!r} commands, not {control.value!r}. "
            f"Call {data.controls.mode.value}_control, or build it with Sim(control={control.value!r})."
        )
    on_host = not isinstance(command, jax.Array)
    try:
        array = np.asarray(command) if on_host else command
    except ValueError as error:
        raise ValueError(f"{control.value} command is no regular array: {error}") from error
    shape = command_shape(data, control)
    if array.shape != shape:
        raise ValueError(
            f"{control.value} command has shape {array.shape}; this simulation needs {shape} = "
            f"(n_worlds, n_drones, {shape[-1]}): {COMMAND_FIELDS[control]}. "
            f"For one command to all drones use np.broadcast_to(cmd, {shape})."
        )
    if not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
        raise ValueError(f"{control.value} command has type {array.dtype}; needed are real numbers")
    dtype = data.states.pos.dtype
    # Host input of any type reaches the device as one type and in one place: nothing is traced or compiled anew.
    with np.errstate(over="ignore"):  # what is too large for the type becomes infinite, and is told as that below
        array = array.astype(dtype)
    is_tracer = isinstance(array, jax.core.Tracer)
    if (on_host or (check_finite and not is_tracer)) and not np.all(np.isfinite(array)):
        worlds = np.unique(np.nonzero(~np.isfinite(np.asarray(array)))[0])[:8]
        raise ValueError(
            f"{control.value} command is NaN or infinite in world(s) {worlds.tolist()}, as {dtype}; it would poison "
            f"them until their next reset. Check the computation it comes from."
        )
    inside_jit = is_tracer or isinstance(data.states.pos, jax.core.Tracer)
    return jnp.asarray(array) if inside_jit else jax.device_put(array, data.states.pos.sharding)
