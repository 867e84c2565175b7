"""Operations of ``Sim`` as pure functions on ``SimData``, for use inside jit, vmap, grad and scan."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, DTypeLike, NDArray

from crazysim.arguments import check_flag
from crazysim.control import COMMAND_FIELDS, Control, Setpoint
from crazysim.core.data import SimData, command_shape, require_data, require_states
from crazysim.core.settings import is_real
from crazysim.engine import jaxcompat
from crazysim.engine.stage import is_tick
from crazysim.errors import ConfigError, short_repr

FEEDFORWARD_FIELDS = "jerk x, y, z [m/s^3], snap x, y, z [m/s^4], yaw rate [rad/s], yaw acceleration [rad/s^2]"
"""Entries of a feedforward with their units, for messages."""


def state_control(
    data: SimData,
    controls: ArrayLike | None = None,
    check_finite: bool = False,
    *,
    pos: ArrayLike | None = None,
    vel: ArrayLike | None = None,
    acc: ArrayLike | None = None,
    yaw: ArrayLike | None = None,
    feedforward: ArrayLike | None = None,
) -> SimData:
    """Stage a full-state setpoint for every drone.

    Pass either one vector of 16 numbers per drone as ``controls``, or ``pos`` and optionally ``vel``, ``acc`` and
    ``yaw``. These broadcast by NumPy's rules, ``yaw`` to (n_worlds, n_drones) and the other parts to
    (n_worlds, n_drones, 3): a ``pos`` of shape (3,) is shared by all drones, (n_drones, 3) has one position per drone,
    and (n_worlds, 1, 3) has one position per world. Omitted quantities are zero.

    Args:
        data: Data of a simulation built with ``control="state"``.
        controls: Position, velocity, acceleration, quaternion (xyzw), body rates; None with ``pos``.
            (n_worlds, n_drones, 16)
        check_finite: Whether to also check JAX arrays that are not traced, which waits for the device. Other input is
            always checked.
        pos: Position, world frame, m; None with ``controls``. (..., 3)
        vel: Velocity, world frame, m/s, with ``pos``. (..., 3)
        acc: Acceleration, world frame, m/s^2, with ``pos``. (..., 3)
        yaw: Yaw, rad, with ``pos``. (...)
        feedforward: Jerk, m/s^3, snap, m/s^4, yaw rate, rad/s, yaw acceleration, rad/s^2. None for the yaw rate of the
            setpoint and zeros otherwise. Must be None if the controller has no feedforward, such as Crazyflow's.
            (n_worlds, n_drones, 8)
    """
    require_states(data)
    command, feedforward = check_setpoint(
        data, controls, check_finite, pos=pos, vel=vel, acc=acc, yaw=yaw, feedforward=feedforward
    )
    feedforward = None if feedforward is None else put_command(data, feedforward)
    return stage_command(data, put_command(data, command), feedforward)


def check_setpoint(
    data: SimData,
    controls: ArrayLike | None,
    check_finite: bool,
    *,
    feedforward: ArrayLike | None,
    **parts: ArrayLike | None,
) -> tuple[Array | NDArray, Array | NDArray | None]:
    """Return a full-state setpoint and its feedforward as arrays of the state's dtype, for ``stage_command``.

    Arguments and errors are as in ``state_control``, but leaves of ``data`` may also be ``jax.ShapeDtypeStruct``.
    """
    require_data(data)
    explicit_parts = {name: x for name, x in parts.items() if x is not None}
    if controls is None:
        controls = _join_setpoint(data, explicit_parts)
    elif explicit_parts:
        raise ConfigError(
            f"expected one vector of 16 numbers per drone or its parts, got both, with {', '.join(explicit_parts)}. "
            f"Write them into the vector, or leave it out."
        )
    command = check_command(data, Control.state, controls, check_finite)
    if feedforward is None:
        return command, None
    if data.controls.state.staged_feedforward is None:
        raise ConfigError(
            "expected no feedforward, which the controller of this simulation does not follow, got one. Use "
            "controller='auto', or leave it out."
        )
    shape = (*command.shape[:-1], 8)
    return command, _as_command(data, "feedforward", shape, FEEDFORWARD_FIELDS, feedforward, check_finite)


def _join_setpoint(data: SimData, parts: dict[str, ArrayLike]) -> Array | np.ndarray:
    if "pos" not in parts:
        raise ConfigError("expected a state command, got no position. Use pos=(0, 0, 1), or 16 numbers per drone.")
    batch_shape = data.states.pos.shape[:2]
    checked_parts = {
        name: _check_part(name, x, batch_shape if name == "yaw" else (*batch_shape, 3)) for name, x in parts.items()
    }
    if any(isinstance(x, jax.Array) for x in checked_parts.values()):
        return _device_setpoint(batch_shape, data.states.pos.dtype, checked_parts)
    return _setpoint(np, batch_shape, float, checked_parts)


def _check_part(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array | np.ndarray:
    try:
        array = value if isinstance(value, jax.Array) else np.asarray(value)
        is_broadcastable = np.broadcast_shapes(array.shape, shape) == shape
    except ValueError:  # a list of lists of unequal lengths, or shapes that do not broadcast
        array, is_broadcastable = np.zeros(0), False
    if not (is_broadcastable and is_real(array) and (name == "yaw" or array.shape[-1:] == (3,))):
        raise ConfigError(f"expected {name} as numbers that broadcast to shape {shape}, got {short_repr(value)}")
    if isinstance(array, np.ndarray) and not np.isfinite(array).all():
        raise ConfigError(f"expected finite numbers as {name}, got {short_repr(value)}. Check its computation.")
    return array


def _setpoint(xp: Any, batch_shape: tuple[int, ...], dtype: DTypeLike, parts: Mapping[str, ArrayLike]) -> Any:
    # ``xp`` is the array module: ``numpy`` or ``jax.numpy``.
    zeros = xp.zeros((*batch_shape, 3), dtype)
    vectors = [xp.asarray(parts.get(name, zeros), dtype) for name in ("pos", "vel", "acc")]
    half_yaw = xp.asarray(parts.get("yaw", 0.0), dtype)[..., None] / 2 + zeros[..., :1]
    quat = [zeros[..., :2], xp.sin(half_yaw), xp.cos(half_yaw)]
    return xp.concatenate([*(xp.broadcast_to(x, zeros.shape) for x in vectors), *quat, zeros], axis=-1)


_device_setpoint = jax.jit(functools.partial(_setpoint, jnp), static_argnums=(0, 1))


def attitude_control(data: SimData, controls: ArrayLike, check_finite: bool = False) -> SimData:
    """Stage roll, pitch, yaw, rad, and collective thrust, N, for every drone. (n_worlds, n_drones, 4)

    Arguments and errors are as in ``state_control``.
    """
    return _stage_checked(data, Control.attitude, controls, check_finite)


def body_rate_control(data: SimData, controls: ArrayLike, check_finite: bool = False) -> SimData:
    """Stage body rates, rad/s, and collective thrust, N, for every drone. (n_worlds, n_drones, 4)

    Arguments and errors are as in ``state_control``.
    """
    return _stage_checked(data, Control.body_rate, controls, check_finite)


def force_torque_control(data: SimData, controls: ArrayLike, check_finite: bool = False) -> SimData:
    """Stage collective thrust, N, and body torque, N m, for every drone. (n_worlds, n_drones, 4)

    Arguments and errors are as in ``state_control``.
    """
    return _stage_checked(data, Control.force_torque, controls, check_finite)


def rotor_vel_control(data: SimData, controls: ArrayLike, check_finite: bool = False) -> SimData:
    """Command rotor speeds, rpm, for every drone; they take effect at the next step. (n_worlds, n_drones, n_rotors)

    Arguments and errors are as in ``state_control``.
    """
    return _stage_checked(data, Control.rotor_vel, controls, check_finite)


def _stage_checked(data: SimData, control: Control, controls: ArrayLike, check_finite: bool) -> SimData:
    require_states(data)
    return stage_command(data, put_command(data, check_command(data, control, controls, check_finite)))


def stage_command(data: SimData, command: Array, feedforward: Array | None = None) -> SimData:
    """Return the data with a command staged for the controller of its command level, without checking it.

    The data may be of one drone, of one world or of all worlds. Rotor speeds take effect at the next step, other
    commands at the next tick of their controller.

    Args:
        command: Command in the units of ``data.controls.mode``. (..., k)
        feedforward: Feedforward of a setpoint; None for ``default_feedforward(command)``. (..., 8)
    """
    controls, mode = data.controls, data.controls.mode
    fields = staged_fields(data, command, feedforward)
    if mode == Control.rotor_vel:
        return data.replace(controls=controls.replace(**fields))
    level = getattr(controls, mode.value).replace(**fields)
    return data.replace(controls=controls.replace(**{mode.value: level}))


def staged_fields(data: SimData, command: Array, feedforward: Array | None = None) -> dict[str, Array]:
    """Return the fields that ``stage_command`` writes, by name.

    Rotor speeds are a field of ``data.controls``; other commands are fields of the record of their command level.
    """
    mode = data.controls.mode
    if mode == Control.rotor_vel:
        return {"rotor_vel": command}
    if mode != Control.state or getattr(data.controls, mode.value).staged_feedforward is None:
        return {"staged_cmd": command}
    return {
        "staged_cmd": command,
        "staged_feedforward": default_feedforward(command) if feedforward is None else feedforward,
    }


def staged_leaves(data: SimData) -> list[Any]:
    """Return the leaves that ``stage_command`` writes, in the order of ``staged_fields``."""
    controls = data.controls
    level: Any = controls if controls.mode == Control.rotor_vel else getattr(controls, controls.mode.value)
    names = staged_fields(data, command=level, feedforward=level)  # the values are not used
    return [getattr(level, name) for name in names]


def default_feedforward(command: Any) -> Any:
    """Return the default feedforward of a setpoint: its yaw rate, and zeros otherwise. (..., 8)"""
    if isinstance(command, np.ndarray):
        feedforward = np.zeros((*command.shape[:-1], 8), command.dtype)
        feedforward[..., 6] = command[..., 15]
        return feedforward
    return _compiled_default_feedforward(command)


@jax.jit
def _compiled_default_feedforward(command: Array) -> Array:
    return Setpoint.of_command(command).feedforward()


def time(data: SimData) -> Array:
    """Return the time since each world's last reset, s. (n_worlds, 1)"""
    require_data(data)
    return data.core.steps / data.core.freq


def controllable(data: SimData) -> Array:
    """Return True in worlds where a staged command takes effect at the next step. (n_worlds, 1)"""
    require_data(data)
    mode = data.controls.mode
    mask = None if mode == Control.rotor_vel else is_tick(data, getattr(data.controls, mode.value).freq)
    return jnp.ones_like(data.core.steps, bool) if mask is None else mask


def check_command(data: SimData, control: Control, command: ArrayLike, check_finite: bool = False) -> Array | NDArray:
    """Return a command as an array of the state's dtype.

    Leaves of ``data`` may be ``jax.ShapeDtypeStruct`` instead of arrays. A command on the host is copied and
    stays on the host; ``put_command`` moves it to the device.
    """
    require_data(data)
    if data.controls.mode != control:
        raise ConfigError(
            f"this simulation takes {data.controls.mode.value!r} commands, not {control.value!r}. "
            f"Call {data.controls.mode.value}_control, or build it with Sim(control={control.value!r})."
        )
    return _as_command(
        data, control.value, command_shape(data, control), COMMAND_FIELDS[control], command, check_finite
    )


def _as_command(
    data: SimData, name: str, shape: tuple[int, ...], fields: str, command: ArrayLike, check_finite: bool
) -> Array | NDArray:
    is_on_host = not isinstance(command, jax.Array)
    try:
        array = np.asarray(command) if is_on_host else command
    except ValueError as error:
        raise ConfigError(f"expected the {name} command as a regular array, got {command!r}") from error
    if array.shape != shape:
        raise ConfigError(
            f"{name} command has shape {array.shape}; expected {shape} = "
            f"(n_worlds, n_drones, {shape[-1]}): {fields}. "
            f"For one command to all drones use np.broadcast_to(cmd, {shape})."
        )
    dtype = data.states.pos.dtype
    # Host input of any type reaches the device with one dtype and placement, so nothing is traced or compiled again.
    if array.dtype == dtype:
        array = array.copy() if is_on_host else array.astype(dtype)
    elif is_real(array):
        with np.errstate(over="ignore"):  # a number too large for the dtype becomes infinite, which is reported below
            array = array.astype(dtype)
    else:
        raise ConfigError(f"expected real numbers as {name} command, got type {array.dtype}; use float32")
    is_tracer = isinstance(array, jax.core.Tracer)
    check_finite = check_flag("check_finite", check_finite)
    if (is_on_host or (check_finite and not is_tracer)) and not np.isfinite(array).all():
        worlds = np.unique(np.nonzero(~np.isfinite(np.asarray(array)))[0])[:8]
        raise ConfigError(
            f"expected a finite {name} command, got one that is NaN or infinite in world(s) {worlds.tolist()}, as "
            f"{dtype}, which would last until their next reset. Check the computation that returns it."
        )
    return array


def put_command(data: SimData, command: Array | NDArray) -> Array:
    """Return a checked command as an array on the device of the data.

    Leaves of ``data`` may be ``jax.ShapeDtypeStruct`` with a sharding instead of arrays.
    """
    if isinstance(command, jax.core.Tracer) or isinstance(data.states.pos, jax.core.Tracer):
        return jnp.asarray(command)
    sharding = data.states.pos.sharding
    if isinstance(command, np.ndarray):
        return jaxcompat.put_host_array(command, sharding)
    return command if command.committed and command.sharding == sharding else jax.device_put(command, sharding)
