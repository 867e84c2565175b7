"""Incremental nonlinear dynamic inversion: geometric tracking control with measured, not modelled, disturbances."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.control.allocation import force_torque2rotor_vel, wrench_matrix
from crazysim.control.bandwidth import bandwidth, fastest_rotor_rate, momentum_per_torque, rotor_rate
from crazysim.control.flatness import attitude_of_thrust
from crazysim.control.geometric import GeometricParams, attitude_errors, bandwidth_gains
from crazysim.control.levels import Control
from crazysim.control.pid_loop import butterworth
from crazysim.control.priority import prioritized_wrench
from crazysim.control.protocol import Controller, DroneData
from crazysim.control.setpoint import Setpoint
from crazysim.drones import Airframe
from crazysim.dynamics.models import AirframeParams
from crazysim.dynamics.rotor import quadratic_curve, rotor_vel_of_thrust
from crazysim.engine.pytree import PyTree, leaf
from crazysim.errors import expect
from crazysim.rotation import cross, dot, matvec

ROTOR_LEAD = 2.0
"""Factor by which the feedback of rotor speeds makes the rotors faster than their own lag, 1."""

MAX_FEEDBACK_STEP = 0.5
"""Largest fraction of the missing rotor speed that the rotors make up in one tick of the controller, 1."""
DISTURBANCE_MAX = 5.0
"""Largest acceleration by a disturbance that is compensated along an axis, m/s^2: about half of gravity."""
TORQUE_MAX = 0.5
"""Rotation error whose feedback torque is as large as the largest disturbance torque that is compensated, rad."""


class INDIParams(AirframeParams):
    """Gains and parameters of INDI, each shared or one per drone."""

    geometric: GeometricParams
    """Gains, mass, inertia and limits."""
    mixing_matrix: Array = leaf("parameter", 2, airframe=wrench_matrix)
    """Matrix from rotor thrusts to collective thrust, 1, and body torque, m. (4, n_rotors)"""
    lead: Array = leaf("parameter", 1, (1,))
    """Factor on the difference between commanded and current rotor speeds, 1. (1,)"""
    reaction: Array = leaf("parameter", 1, (1,))
    """Change of a rotor's angular momentum per change of its drag torque as its speed changes around hover, s. (1,)"""
    drag_torque_share: Array = leaf("parameter", 1, (1,))
    """Fraction of the missing yaw torque that is demanded from rotor drag, 1. The reaction to spin-up gives the rest.
    (1,)"""
    filter: Array = leaf("parameter", 1, (3,))
    """Coefficients b0, a1, a2 of the low-pass filter, from ``butterworth``. (3,)"""


class INDIMemory(PyTree):
    """Memory of INDI: velocity and angular momentum at the last tick, and the states of the filter."""

    vel: Array = leaf("drone", 1, (3,))
    """Velocity at the last tick, world frame, m/s. (n_worlds, n_drones, 3)"""
    momentum: Array = leaf("drone", 1, (3,))
    """Angular momentum of body and rotors at the last tick, body frame, N m s. (n_worlds, n_drones, 3)"""
    filter: Array = leaf("drone", 1, (24,))
    """Two states of the filter for each of its 12 signals: components of acceleration, acceleration by the rotors, rate
    of change of the momentum, and torque of the rotors. (n_worlds, n_drones, 24)"""
    started: Array = leaf("drone", 1, (1,))
    """One after the first tick, zero before. (n_worlds, n_drones, 1)"""


def apply_filter(x: Array, state: Array, coefficients: Array) -> tuple[Array, Array]:
    """Return signals after a second-order low-pass filter, (..., n), and its new states, (..., 2 n).

    The filter is computed in transposed direct form II.

    Args:
        x: Signals. (..., n)
        state: States. (..., 2 n)
        coefficients: From ``butterworth``. (..., 3)
    """
    b0, a1, a2 = (coefficients[..., i : i + 1] for i in range(3))
    n = x.shape[-1]
    state_1, state_2 = state[..., :n], state[..., n:]
    y = b0 * x + state_1
    return y, jnp.concatenate([2 * b0 * x - a1 * y + state_2, b0 * x - a2 * y], axis=-1)


def steady_filter_states(x: Array, coefficients: Array) -> Array:
    """Return the states of a filter whose signals have always been ``x``. (..., n) -> (..., 2 n)"""
    b0, a1, a2 = (coefficients[..., i : i + 1] for i in range(3))
    return jnp.concatenate([(3 * b0 - a1 - a2) * x, (b0 - a2) * x], axis=-1)


def indi_control(
    pos: Array,
    quat: Array,
    vel: Array,
    ang_vel: Array,
    rotor_vel: Array,
    setpoint: Setpoint,
    memory: INDIMemory,
    freq: float,
    *,
    params: INDIParams,
) -> tuple[Array, INDIMemory]:
    """Track a setpoint under unknown forces and torques; return the rotor speeds and the memory.

    The loops are the same as in ``geometric_control``, but force and torque are increments to the current force and
    torque of the rotors (Smeur, Chu and de Croon 2016 for the torque, Tal and Karaman 2018 for the force):

        f = f_rotors + m (a_desired - a),   tau = tau_rotors + J (w'_desired - w')

    The disturbances ``m a - f_rotors - m g`` and ``J w' - tau_rotors`` are limited (``DISTURBANCE_MAX``,
    ``TORQUE_MAX``), so that the rotors do not push a drone on the floor against the floor.

    The acceleration a is the rate of change of the velocity over one tick. ``J w'`` is the rate of change of the
    angular momentum of body and rotors, so that the reaction to accelerating rotors is no disturbance. Force and torque
    of the rotors follow from measured rotor speeds. The same low-pass filter is applied to all four signals, so that
    their delays cancel. Effects that the model omits, such as wind, a shifted load or a wrong mass, change a and w',
    and are compensated. The result is the current speed plus ``params.lead`` times the difference to the desired
    speed, which makes the rotors faster than their lag.

    Args:
        pos: Position, world frame, m. (..., 3)
        quat: Attitude, body to world, unit, xyzw. (..., 4)
        vel: Velocity, world frame, m/s. (..., 3)
        ang_vel: Angular velocity, body frame, rad/s. (..., 3)
        rotor_vel: Rotor speeds, rpm. (..., n_rotors)
        setpoint: Setpoint with the leading axes of the state.
        freq: Rate of this controller, Hz.
        params: Gains, shared or with the leading axes of the state.

    Returns:
        Rotor speeds, rpm (..., n_rotors); the memory.
    """
    p, sp, allocation = params.geometric, setpoint, params.geometric.allocation
    matrix = rotation.matrix(quat)
    # Wrench that the rotors exert now.
    wrench = matvec(params.mixing_matrix, quadratic_curve(rotor_vel, allocation.rpm2thrust))
    rotor_acc = matrix[..., 2] * wrench[..., :1] / p.mass
    # Rates of momentum and velocity; the first tick has no earlier values and takes the model's.
    is_first_tick = memory.started == 0
    yaw_torque = wrench[..., 3:]
    momentum = matvec(p.J, ang_vel)
    total_momentum = momentum - rotation.along_z((params.reaction * yaw_torque)[..., 0])
    modelled_torque = wrench[..., 1:] - cross(ang_vel, momentum)
    momentum_rate = jnp.where(is_first_tick, modelled_torque, (total_momentum - memory.momentum) * freq)
    acc = jnp.where(is_first_tick, rotor_acc + p.gravity_vec, (vel - memory.vel) * freq)
    # One filter for all signals, so that their delays are equal.
    signals = jnp.concatenate([acc, rotor_acc, momentum_rate, wrench[..., 1:]], axis=-1)
    filter_state = jnp.where(is_first_tick, steady_filter_states(signals, params.filter), memory.filter)
    signals, filter_state = apply_filter(signals, filter_state, params.filter)
    acc, rotor_acc, momentum_rate, torque = (signals[..., i : i + 3] for i in (0, 3, 6, 9))

    # Position loop: feedback, minus the filtered disturbance.
    feedback = -(p.kr * (pos - sp.pos) + p.kv * (vel - sp.vel)) / p.mass
    disturbance = rotation.clip(acc - rotor_acc - p.gravity_vec, -DISTURBANCE_MAX, DISTURBANCE_MAX)
    specific_thrust = sp.acc - p.gravity_vec + feedback - disturbance
    attitude = attitude_of_thrust(specific_thrust, sp.jerk, sp.snap, sp.yaw, sp.yaw_rate, sp.yaw_acc)
    # Attitude loop: feedback, minus the filtered disturbance torque.
    rotation_error, rate_error, ang_acc_des = attitude_errors(matrix, ang_vel, attitude)
    torque_des = matvec(p.J, ang_acc_des) - p.kR * rotation_error - p.kw * rate_error
    limit = TORQUE_MAX * p.kR
    torque = torque_des - rotation.clip(momentum_rate - torque, -limit, limit)

    # Rotor speeds by priority, ahead of the motors' lag.
    thrust = p.mass * dot(specific_thrust, matrix[..., 2])
    yaw_drag_torque = yaw_torque + params.drag_torque_share * (torque[..., 2:] - yaw_torque)
    wrench_cmd = prioritized_wrench(
        jnp.concatenate([thrust, torque[..., :2], yaw_drag_torque], axis=-1), params=allocation
    )
    rotor_vel_des = force_torque2rotor_vel(wrench_cmd, params=allocation)
    rotor_vel_min = rotor_vel_of_thrust(allocation.thrust_min, allocation.rpm2thrust)
    rotor_vel_cmd = jnp.maximum(rotor_vel + params.lead * (rotor_vel_des - rotor_vel), jnp.maximum(rotor_vel_min, 1.0))
    return rotor_vel_cmd, INDIMemory(vel, total_momentum, filter_state, jnp.ones_like(memory.started))


class INDI(Controller, memory=INDIMemory):
    """Incremental nonlinear dynamic inversion (``indi_control``) for setpoints; needs measured rotor speeds.

    The gains follow the rule of ``crazysim.control.bandwidth`` for rotors that are ``lead`` times as fast. ``lead`` is
    ``ROTOR_LEAD``, or less if ``MAX_FEEDBACK_STEP`` requires it.
    """

    name: ClassVar[str] = "indi"
    levels: ClassVar[tuple[Control, ...]] = (Control.state,)
    output: ClassVar[Control] = Control.rotor_vel
    freq: int = 500
    """Rate of the controller, Hz."""
    cutoff: float = 12.0
    """Cutoff frequency of the filter, Hz; values above ``0.45 freq`` are reduced to ``0.45 freq``."""

    def params(self, airframe: Airframe) -> INDIParams:
        expect(0 < self.cutoff < math.inf, "a positive, finite cutoff, Hz", self.cutoff, "Use INDI(cutoff=12.0).")
        rotor_lag_rate, reaction = rotor_rate(airframe), momentum_per_torque(airframe)
        lead = max(min(ROTOR_LEAD, MAX_FEEDBACK_STEP * self.freq / fastest_rotor_rate(airframe)), 1.0)
        # INDI compensates the reaction to accelerating rotors, which therefore does not limit the bandwidth.
        bandwidths = bandwidth(airframe, self.freq, lead * rotor_lag_rate, limits_reaction=False)
        return INDIParams.create(
            airframe,
            geometric=GeometricParams.create(airframe, **bandwidth_gains(airframe, bandwidths)),
            lead=lead,
            reaction=reaction,
            drag_torque_share=1 / (1 + lead * rotor_lag_rate * reaction),
            filter=butterworth(min(self.cutoff, 0.45 * self.freq), self.freq),
        )

    def take_over(
        self, data: DroneData, command: Any, memory: INDIMemory, params: INDIParams, rotor_vel: Array
    ) -> INDIMemory:
        # The memory is as old as the last tick of this controller; another controller has flown since then.
        return memory.replace(started=jnp.zeros_like(memory.started))

    def update(self, data: DroneData, command: Any, memory: INDIMemory, params: INDIParams) -> tuple[Array, INDIMemory]:
        s = data.states
        state = (s.pos, s.quat, s.vel, s.ang_vel, s.rotor_vel)
        return indi_control(*state, command, memory, self.freq, params=params)
