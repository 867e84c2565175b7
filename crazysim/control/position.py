"""Position loop of the default controller, from a setpoint to a specific force, with an estimate of unknown forces."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.control.allocation import max_thrust_without_torque
from crazysim.control.setpoint import Setpoint
from crazysim.drones import Airframe
from crazysim.dynamics.models import GRAVITY, AirframeParams
from crazysim.engine.pytree import PyTree, leaf
from crazysim.rotation import clip, dot, safe_norm

POSITION_RATE_RATIO = 0.4
"""Natural frequency of the position loop times the delay of the loop below it, 1."""
OBSERVER_RATE_RATIO = 1.5
"""Rate of the estimate of unknown forces times the delay of the loop below the position loop, 1."""
MAX_THRUST_SHARE = 0.9
"""Largest fraction of the maximum thrust that the feedback uses, 1; the attitude control uses the rest."""
MAX_HORIZONTAL_RATIO = 1.0
"""Largest horizontal acceleration by feedback over gravity, 1. It needs a tilt of 45 degrees."""
MAX_FALL_RATIO = 0.5
"""Largest downward acceleration by feedback over gravity, 1. Half of the hover thrust remains to turn the drone."""
MIN_UPWARD_RATIO = 0.1
"""Smallest upward force of the rotors over the weight, 1. It keeps a falling drone upright.

With all rotors at minimum thrust, the built-in airframes ``cf...`` and ``hb_x500`` have 1.6 to 2.1 times this force;
the other built-in airframes have no thrust.
"""
MIN_FEEDBACK_RATIO = 0.1
"""Lower bound on the limits of upward and horizontal acceleration by feedback, over gravity, 1; for drones with little
lift."""
MAX_DISTURBANCE_RATIO = 0.5
"""Largest acceleration by unknown forces along an axis that is compensated, over gravity, 1."""


class PositionParams(AirframeParams):
    """Gains and limits of the position loop, each shared or one per drone."""

    gravity_vec: Array = leaf("parameter", 1, (3,), airframe=lambda _: GRAVITY)
    """Gravitational acceleration that the controller assumes, world frame, m/s^2. (3,)"""
    stiffness: Array = leaf("parameter", 1, (1,))
    """Acceleration per position error, 1/s^2. (1,)"""
    damping: Array = leaf("parameter", 1, (1,))
    """Acceleration per velocity error, 1/s. (1,)"""
    reach: Array = leaf("parameter", 1, (2,))
    """Limits of the position error, horizontal and vertical, m. (2,)"""
    acc_max: Array = leaf("parameter", 1, (3,))
    """Largest acceleration by feedback, horizontal, up and down, m/s^2. (3,)"""
    observer: Array = leaf("parameter", 1, (1,))
    """Weight of a new measurement in the estimate of unknown forces, 1. (1,)"""


class PositionMemory(PyTree):
    """Memory of the position loop."""

    vel: Array = leaf("drone", 1, (3,))
    """Velocity expected at this tick from the known forces, world frame, m/s. (n_worlds, n_drones, 3)"""
    disturbance: Array = leaf("drone", 1, (3,))
    """Estimated acceleration by unknown forces, world frame, m/s^2. (n_worlds, n_drones, 3)"""


def position_params(airframe: Airframe, delay: float, freq: int) -> PositionParams:
    """Return the parameters of the position loop for an airframe.

    The loop is critically damped at the natural frequency ``POSITION_RATE_RATIO / delay``. Its acceleration is
    limited to the acceleration that the rotors can give while they carry the drone. The position error is limited
    to twice the error at which the stiffness alone demands this acceleration. The drone then approaches a distant
    setpoint at a speed from which it can stop.

    Args:
        delay: Delay of the loop that follows the specific force, s.
        freq: Rate of the controller, Hz.
    """
    g = -GRAVITY[2]
    max_specific_force = (
        MAX_THRUST_SHARE * max_thrust_without_torque(airframe) / float(airframe.value("rigid_body.mass", ()))
    )
    max_up_acc, max_down_acc = max(max_specific_force - g, MIN_FEEDBACK_RATIO * g), MAX_FALL_RATIO * g
    max_horizontal_acc = min(
        MAX_HORIZONTAL_RATIO * g, np.sqrt(max(max_specific_force**2 - g**2, (MIN_FEEDBACK_RATIO * g) ** 2))
    )
    natural_freq = POSITION_RATE_RATIO / delay
    return PositionParams.create(
        airframe,
        stiffness=natural_freq**2,
        damping=2 * natural_freq,
        reach=2 * np.array([max_horizontal_acc, min(max_up_acc, max_down_acc)]) / natural_freq**2,
        acc_max=[max_horizontal_acc, max_up_acc, max_down_acc],
        observer=1 - np.exp(-OBSERVER_RATE_RATIO / delay / freq),
    )


def specific_force(
    pos: Array,
    vel: Array,
    known_acc: Array,
    setpoint: Setpoint,
    memory: PositionMemory,
    freq: float,
    params: PositionParams,
) -> tuple[Array, PositionMemory]:
    """Return the specific force that leads to a setpoint, and the memory.

    The acceleration by unknown forces is the difference between the velocity and the velocity expected from the known
    forces, divided by one period. It is limited (``MAX_DISTURBANCE_RATIO``) and then filtered, so that the estimate
    does not wind up while a drone is held, or when it is moved by hand or by a reset. A drone with a velocity of
    exactly zero is assumed to stand on the floor. Its horizontal forces are ignored, because compensating them would
    tilt the drone further.

    Args:
        pos: Position, world frame, m. (..., 3)
        vel: Velocity, world frame, m/s. (..., 3)
        known_acc: Acceleration by the known forces other than gravity, world frame, m/s^2. (..., 3)
        setpoint: Setpoint with the leading axes of the state.
        freq: Rate of the controller, Hz.
        params: Gains and limits, shared or with the leading axes of the state.

    Returns:
        Desired acceleration by all known forces other than gravity, world frame, m/s^2 (..., 3); the memory.
    """
    p = params
    # Observer: the acceleration that no known force explains.
    limit = -MAX_DISTURBANCE_RATIO * GRAVITY[2]
    unknown_acc = clip((vel - memory.vel) * freq, -limit, limit)
    horizontal_acc = jnp.where(dot(vel, vel) == 0, 0.0, unknown_acc[..., :2])
    unknown_acc = _join_vertical(horizontal_acc, unknown_acc[..., 2:])
    disturbance = memory.disturbance + p.observer * (unknown_acc - memory.disturbance)

    # PD loop within limits of speed and acceleration.
    error, reach = setpoint.pos - pos, p.reach[..., 1:]
    error = _join_vertical(_limit_length(error[..., :2], p.reach[..., :1]), clip(error[..., 2:], -reach, reach))
    acc = p.stiffness * error + p.damping * (setpoint.vel - vel)
    vertical_acc = clip(acc[..., 2:], -p.acc_max[..., 2:], p.acc_max[..., 1:2])
    acc = _join_vertical(_limit_length(acc[..., :2], p.acc_max[..., :1]), vertical_acc)
    specific_thrust = setpoint.acc + acc - p.gravity_vec - disturbance
    return specific_thrust, PositionMemory(vel + (known_acc + p.gravity_vec) / freq, disturbance)


def keep_upright(specific_thrust: Array, setpoint: Setpoint, params: PositionParams) -> Array:
    """Return the specific force of the rotors, raised so that it does not turn the drone on its back.

    In a fall, feedback, drag and estimates may cancel the weight, and the sum may then point in any direction. The
    upward component is therefore at least ``MIN_UPWARD_RATIO`` times gravity. A setpoint that accelerates downward by
    more than gravity is allowed to turn the drone over: it lowers this limit by twice the excess over gravity.

    Args:
        specific_thrust: Specific force of the rotors, world frame, m/s^2. (..., 3)
        setpoint: Setpoint with the leading axes of the force.
        params: Gains and limits, shared or with the leading axes of the force.
    """
    desired_lift = setpoint.acc[..., 2:] - params.gravity_vec[..., 2:]
    min_lift = -MIN_UPWARD_RATIO * GRAVITY[2] + 2 * jnp.where(desired_lift < 0, desired_lift, 0.0)
    return _join_vertical(
        specific_thrust[..., :2], jnp.where(specific_thrust[..., 2:] < min_lift, min_lift, specific_thrust[..., 2:])
    )


def _limit_length(x: Array, limit: Array) -> Array:
    norm = safe_norm(x)
    return x * jnp.where(norm > limit, limit / jnp.where(norm > limit, norm, 1.0), 1.0)


def _join_vertical(horizontal: Array, vertical: Array) -> Array:
    return jnp.concatenate([horizontal, vertical], axis=-1)
