"""Meaning of actions: an affine map from [-1, 1] to commands with units, for each command level."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.control import COMMAND_FIELDS, Control
from crazysim.control.allocation import torque_arms
from crazysim.core.airframes import Airframes, as_airframes
from crazysim.core.data import SimParams
from crazysim.drones import Airframe
from crazysim.dynamics import first_principles, fitted
from crazysim.eager import fetch_rows
from crazysim.engine.pytree import scopes
from crazysim.errors import ConfigError, require
from crazysim.rotation import clip

MAX_TILT = np.pi / 4
"""Largest roll and pitch of an action, rad."""
MAX_YAW = np.pi / 2
"""Largest yaw of an action, rad."""
MAX_BODY_RATES = (10.0, 10.0, 4.0)
"""Largest body rates of an action, rad/s."""
MAX_OFFSET = (2.0, 2.0, 1.0)
"""Largest x, y and z of a position setpoint relative to the point 1 m above the origin, m."""


class Actions:
    """Map from actions to commands: ``command = centre + scale * action``, with the action clipped to [-1, 1].

    By default (``actions_of``), a zero action is the command under which the nominal drone hovers, level and at yaw
    zero. At the state level, the drone hovers 1 m above the origin.

    | Level | Action | Command at -1, 0, 1 |
    | --- | --- | --- |
    | ``attitude`` | roll, pitch; yaw; collective thrust | -45, 0, 45 deg; -90, 0, 90 deg; see below |
    | ``body_rate`` | rates about x, y; z; collective thrust | -10, 0, 10 rad/s; -4, 0, 4 rad/s; see below |
    | ``force_torque`` | collective thrust; body torque | see below; -1/4, 0, 1/4 of the largest torque of the rotors |
    | ``rotor_vel`` | speed of each rotor | twice hover minus the maximum, hover, the maximum, rpm |
    | ``state`` | position setpoint: x, y; z | -2, 0, 2 m; 0, 1, 2 m |

    Collective thrust at -1, 0, 1: twice the hover thrust minus the maximum of all rotors (motors are off below zero),
    the hover thrust, and the maximum, N.
    """

    def __init__(self, centre: np.ndarray, scale: np.ndarray, control: Control):
        self.centre, self.scale, self.control = np.asarray(centre, float), np.asarray(scale, float), control
        require(
            self.centre.shape == self.scale.shape and self.centre.ndim in (1, 2),
            f"expected centre and scale of actions of one shape, (k,) or (n_drones, k), got {self.centre.shape} "
            f"and {self.scale.shape}",
        )

    @property
    def size(self) -> int:
        """Numbers in the action of one drone, k."""
        return self.centre.shape[-1]

    def command(self, action: Array) -> Array:
        """Convert an action to the command, in the units of the command level. (..., k) -> (..., n)"""
        dtype = action.dtype
        centre, scale = jnp.asarray(self.centre, dtype), jnp.asarray(self.scale, dtype)
        command = centre + scale * clip(action, -1.0, 1.0)
        if self.control != Control.state:
            return command
        other_fields = jnp.zeros((*command.shape[:-1], 13), dtype).at[..., 9].set(1.0)
        return jnp.concatenate([command, other_fields], axis=-1)

    def __str__(self) -> str:
        fields = COMMAND_FIELDS[self.control]
        return f"{self.control.value} ({fields}): {self.centre - self.scale} to {self.centre + self.scale}"


def rotor_speeds(params: SimParams) -> Actions:
    """Return actions of four rotors from standing still at -1 to the largest speed at 1."""
    half = np.broadcast_to(np.asarray(params.rotor_vel_max).reshape(-1)[:1] / 2, 4)  # type: ignore[union-attr]
    return Actions(half, half, Control.rotor_vel)


def actions_of(airframe: Airframes, params: SimParams, control: Control, tilt: float = MAX_TILT) -> Actions:
    """Choose the default actions of a command level; see ``Actions``.

    Args:
        airframe: Airframe of all drones, or one for each drone; its rotors limit the commands.
        params: Parameters, for the hover command. If all drones have one airframe, the first drone's are used.
        tilt: Largest roll and pitch of the attitude level, rad.
    """
    airframes = as_airframes(airframe)
    if all(drone_airframe is airframes[0] for drone_airframe in airframes):
        return _drone_actions(airframes[0], params, control, tilt, 0)
    drone_actions = [
        _drone_actions(drone_airframe, params, control, tilt, k) for k, drone_airframe in enumerate(airframes)
    ]
    centres, scales = ([getattr(actions, name) for actions in drone_actions] for name in ("centre", "scale"))
    return Actions(np.stack(centres), np.stack(scales), control)


def _drone_actions(airframe: Airframe, params: SimParams, control: Control, tilt: float, index: int) -> Actions:
    params = jax.tree.map(lambda scope, x: fetch_rows(x, (0, index)) if scope == "drone" else x, scopes(params), params)
    n_rotors = airframe.n_rotors
    max_thrust = float(airframe.value("rotors.thrust_max", ()))
    hover = float(jax.jit(hover_thrust)(params)[0])  # one program, instead of one for each operation
    thrust_range = n_rotors * max_thrust - hover
    if control == Control.attitude:
        return Actions(np.array([0, 0, 0, hover]), np.array([tilt, tilt, MAX_YAW, thrust_range]), control)
    if control == Control.body_rate:
        return Actions(np.array([0, 0, 0, hover]), np.array([*MAX_BODY_RATES, thrust_range]), control)
    if control == Control.state:
        return Actions(np.array([0, 0, 1.0]), np.array(MAX_OFFSET), control)
    if control == Control.force_torque:
        max_torque = max_thrust / 2 * torque_arms(airframe) * np.abs(airframe.mixing_matrix).sum(axis=-1)
        return Actions(np.array([hover, 0, 0, 0]), np.array([thrust_range, *max_torque / 4]), control)
    if isinstance(params, fitted.Params):
        raise ConfigError(
            "expected dynamics='first_principles' for rotor commands, got a fitted model, which has no rotors"
        )
    centre = np.asarray(first_principles.hover_rotor_vel(params))
    return Actions(centre, np.broadcast_to(np.asarray(params.rotor_vel_max), centre.shape) - centre, control)


def hover_thrust(params: SimParams) -> Array:
    """Return the collective thrust command at which a drone hovers, N. (..., 1)"""
    gravity = params.gravity_vec
    weight = params.mass * jnp.sqrt(jnp.sum(gravity * gravity, axis=-1, keepdims=True))
    return (weight - params.acc_coef) / params.cmd_f_coef if isinstance(params, fitted.Params) else weight


def hover_rotor_states(params: SimParams) -> Array:
    """Return ``states.rotor_vel`` in hover: rpm, or the thrust, N, in fitted models. (..., n_rotors) or (..., 1)"""
    return hover_thrust(params) if isinstance(params, fitted.Params) else first_principles.hover_rotor_vel(params)
