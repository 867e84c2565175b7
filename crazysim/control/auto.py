"""The default controller. It computes its gains from the physics of any airframe.

A force follows from the errors of position and velocity (``crazysim.control.position``), and a torque from the errors
of attitude and body rates. The controller also compensates forces and torques that its model lacks, such as wind, a
load, a wrong mass or a shifted centre of mass. It estimates them by comparing the measured velocities with the
velocities that its model predicts.

All gains follow from one rate ``a`` about each axis. If the thrusts follow their command with the rate ``a``, and kp
and kd are the gains per inertia on attitude and body rate, the characteristic polynomial is
``s^3 / a + s^2 + kd s + kp``. With

    kd = 0.6 a,   kp = 0.12 a^2,   where a about yaw is at most half of the rate that the lag allows,

body rates follow with a damping ratio of 0.65, which overshoots a step by 7%. Attitudes follow with a pole at -0.31 a
and a pair of poles with a damping ratio of 0.55, without overshoot. The attitude loop delays a slow command by
kd / kp = 5 / a, from which the gains of the position loop follow.

The rate has two limits. The first limit is lag: ``1 / a`` is at least the lag of the rotors, with feedback of their
speeds, plus 1.5 periods of the controller. The second limit is the authority of the rotors. A large error e turns the
drone along the line kp e + kd e' = 0, on which the rotors must brake with the angular acceleration
(kp / kd)^2 e = 0.04 a^2 e. At the largest e, this may be at most the angular acceleration that the rotors give in hover
(``max_gain_ratios``). Without this limit, a drone with quick rotors turns faster than it can stop: its rotors saturate
in alternating directions, and it never settles.

A rotor that speeds up also turns the body the other way. Let I be the inertia of a rotor, and q the slope of its drag
torque over its speed. A drag torque y then causes the yaw torque y + z y', with z = I / q. For the built-in airframes
z is up to 0.13 s. Under feedback, this lead would reverse the demand on the rotors at every tick. Therefore only
the fraction 1 / (1 + r z) of the missing drag torque is demanded, with the rate r of the rotors. The transfer function
from desired to actual yaw torque is then

    (1 + z s) / (1 + (z + 1 / r) s),

which is at most one at every frequency, and close to one for heavy rotors. The estimate of unknown torques includes
the angular momentum of the rotors.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, cast

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from crazysim import rotation
from crazysim.control.allocation import hover_torque_arms, wrench_matrix
from crazysim.control.bandwidth import (
    YAW_RATE_RATIO,
    fastest_rotor_rate,
    max_gain_ratios,
    momentum_per_torque,
    rotor_rate,
)
from crazysim.control.fitted_auto import FittedAuto
from crazysim.control.flatness import MIN_HEADING_SINE, MIN_SPECIFIC_THRUST
from crazysim.control.levels import Control
from crazysim.control.position import PositionMemory, PositionParams, keep_upright, position_params, specific_force
from crazysim.control.priority import prioritized_thrusts
from crazysim.control.protocol import Controller, DroneData, FlightState, zeros
from crazysim.control.rigid_body_params import RigidBodyParams, limited_allocation
from crazysim.control.setpoint import Setpoint
from crazysim.drones import Airframe
from crazysim.dynamics import Dynamics
from crazysim.dynamics.rotor import quadratic_curve, thrust_slope
from crazysim.engine.pytree import PyTree, as_parameter, leaf
from crazysim.rotation import clip, cross, dot, matvec

ROTOR_RATE = 50.0
"""Largest rate that slower rotors reach by feedback of their speeds, 1/s. ``MAX_LEAD``, ``MAX_FEEDBACK_STEP`` or the
authority of the rotors may set a lower limit."""
MAX_LEAD = 5.0
"""Largest factor by which the feedback of rotor speeds makes the rotors faster than their own lag, 1."""
MAX_FEEDBACK_STEP = 0.5
"""Largest fraction of the missing rotor speed that the rotors make up in one tick of the controller, 1."""
DAMPING_RATIO = 0.6
"""Angular acceleration per body rate over the rate about the axis, 1."""
STIFFNESS_RATIO = 0.12
"""Angular acceleration per rotation error over the squared rate about the axis, 1."""
OBSERVER_RATE_RATIO = 0.6
"""Rate of the estimate of unknown torques over the largest rate about an axis, 1."""
MAX_COMPENSATED_ERROR = 0.5
"""Largest unknown torque that is compensated, as the rotation error with a feedback torque of that size, rad."""
YAW_RATE_MAX = 35.0
"""Largest desired rate about body z that holds a heading, rad/s. It is the range of a Crazyflie's gyroscope (BMI088,
data sheet)."""
MIN_TILT_COSINE_PLUS_ONE = 1e-6
"""Limit of one plus the cosine of the tilt error, 1. Below this limit, within 0.08 degrees of a tilt error of 180
degrees, the direction of the tilt error is undefined."""


class AutoParams(RigidBodyParams):
    """Gains and parameters of the default controller, each shared or one per drone."""

    mixing_matrix: Array = leaf("parameter", 2, airframe=lambda airframe: wrench_matrix(airframe)[1:])
    """Rotor thrusts to body torque, m. (3, n_rotors)"""
    stiffness: Array = leaf("parameter", 1, (3,))
    """Angular acceleration per rotation error, 1/s^2. (3,)"""
    damping: Array = leaf("parameter", 1, (3,))
    """Angular acceleration per body rate, 1/s. (3,)"""
    torque_max: Array = leaf("parameter", 1, (3,))
    """Largest unknown torque that is compensated, N m. (3,)"""
    observer: Array = leaf("parameter", 1, (1,))
    """Weight of a new measurement in the estimate of unknown torques, 1. (1,)"""
    lead: Array = leaf("parameter", 1, (1,))
    """Factor on the difference between desired and current rotor speeds, 1. (1,)"""
    reaction: Array = leaf("parameter", 1, (1,))
    """Angular momentum of the rotors about body z over their drag torque, both as changes around hover, s. (1,)"""
    drag_torque_share: Array = leaf("parameter", 1, (1,))
    """Fraction of the missing yaw torque that is demanded from rotor drag, 1. The reaction to spin-up gives the rest.
    (1,)"""
    position: PositionParams | None
    """Gains and limits of the position loop; None without a position loop."""


class AutoTarget(PyTree):
    """Result and memory of the position loop."""

    position: PositionMemory
    """Memory of the position loop."""
    quat: Array = leaf("drone", 1, (4,))
    """Attitude that leads to the setpoint, body to world, unit, xyzw. (n_worlds, n_drones, 4)"""
    ang_vel: Array = leaf("drone", 1, (3,))
    """Body rates of that attitude, body frame, rad/s. (n_worlds, n_drones, 3)"""
    thrust: Array = leaf("drone", 1, (1,))
    """Collective thrust that leads to the setpoint once the attitude is reached, N. (n_worlds, n_drones, 1)"""


class AutoMemory(PyTree):
    """Memory of the default controller: target, expected angular momentum and estimated torque."""

    target: AutoTarget | None
    """Result and memory of the position loop; None at command levels below ``state``."""
    momentum: Array = leaf("drone", 1, (3,))
    """Angular momentum expected at this tick from the known torques, body frame, N m s. (n_worlds, n_drones, 3)"""
    torque: Array = leaf("drone", 1, (3,))
    """Estimated unknown torque, body frame, N m. (n_worlds, n_drones, 3)"""


def quat_error(quat: Array) -> Array:
    """Return the error between a body and a desired attitude as tilt and yaw error, body frame, rad. (..., 3)

    The tilt turns the thrust the shortest way; the yaw is the remaining rotation about the thrust (Brescianini and
    D'Andrea 2020). The length of each error is ``2 sin(angle / 2)``, about the angle where it is small, and 2 at 180
    degrees. The first two entries are the tilt error, the third entry is the yaw error.

    Args:
        quat: Attitude of the desired frame in the body frame, unit, xyzw. (..., 4)
    """
    x, y, z, w = (quat[..., i : i + 1] for i in range(4))
    square_cosine = w * w + z * z  # of half the tilt
    factor = 2 * lax.rsqrt(jnp.maximum(square_cosine, MIN_TILT_COSINE_PLUS_ONE / 2))
    roll = jnp.where(square_cosine < MIN_TILT_COSINE_PLUS_ONE / 2, 2.0, (w * x - y * z) * factor)
    yaw = jnp.where(w < 0, -z, z) * factor
    return jnp.concatenate([roll, (w * y + x * z) * factor, yaw], axis=-1)


class Auto(Controller):
    """Controller of any airframe, with gains from its physics; needs measured rotor speeds.

    At the level ``attitude`` it follows roll, pitch, yaw and collective thrust. At the level ``body_rate`` it follows
    body rates and collective thrust (CTBR), and does not level the drone. At both levels a thrust of zero or less
    switches the motors off. Saturated rotors give roll and pitch torque first, then thrust, then yaw torque
    (``prioritized_thrusts``).
    """

    name: ClassVar[str] = "auto"
    levels: ClassVar[tuple[Control, ...]] = (Control.state, Control.attitude, Control.body_rate)
    output: ClassVar[Control] = Control.rotor_vel
    freq: int = 500
    """Rate of the controller, Hz."""
    outer_freq: int | None = 100
    """Rate at which setpoints take effect, Hz; ``state_freq`` of a simulation replaces it. None without setpoints."""
    yaw_rate: bool = False
    """Whether the third entry of an attitude command is a yaw rate, rad/s, instead of a yaw."""

    def adapt(self, control: Control, fitted_model: str | None) -> Controller | None:
        if fitted_model is None and control in self.levels:
            return self if control == Control.state else dataclasses.replace(self, outer_freq=None)
        if fitted_model is None:
            return None
        return FittedAuto(Dynamics(fitted_model), cast(int, self.outer_freq)) if control == Control.state else None

    def outer(self, data: DroneData, command: Setpoint, memory: AutoMemory, params: AutoParams) -> AutoMemory:
        # The desired z axis of the body is along the specific force, and its x axis is closest to the heading. The
        # rates of the axes follow from jerk and yaw rate, as in ``attitude_of_thrust``.
        s, p, sp = data.states, params, command
        matrix = rotation.matrix(s.quat)
        to_body = jnp.swapaxes(matrix, -1, -2)
        drag = matvec(matrix, matvec(p.drag_matrix, matvec(to_body, s.vel))) / p.mass
        rotor_acc = jnp.sum(quadratic_curve(s.rotor_vel, p.allocation.rpm2thrust), axis=-1, keepdims=True) / p.mass
        known_acc = drag + rotor_acc * matrix[..., 2]
        # These are not None, because ``outer`` is only called with an ``outer_freq``.
        freq, loop, target = (
            cast(int, self.outer_freq),
            cast(PositionParams, p.position),
            cast(AutoTarget, memory.target),
        )
        specific_thrust, position_memory = specific_force(s.pos, s.vel, known_acc, sp, target.position, freq, loop)
        # The desired attitude is constant for a period, so the setpoint's acceleration half a period later is used.
        specific_thrust = keep_upright(specific_thrust - drag + 0.5 / freq * sp.jerk, sp, loop)

        # The quaternion of a state command gives its heading without trigonometric functions.
        forward, left = rotation.heading(data.controls.state.cmd[..., 9:13])
        square_norm = dot(specific_thrust, specific_thrust)
        is_falling = square_norm < MIN_SPECIFIC_THRUST**2
        inverse = jnp.where(is_falling, 0.0, lax.rsqrt(jnp.where(is_falling, 1.0, square_norm)))
        z = jnp.where(is_falling, jnp.asarray([0.0, 0.0, 1.0], specific_thrust.dtype), specific_thrust * inverse)
        z_cross_forward = cross(z, forward)
        x_forward = rotation.safe_norm(z_cross_forward)
        is_parallel = x_forward < MIN_SPECIFIC_THRUST
        y = jnp.where(is_parallel, left, z_cross_forward / jnp.where(is_parallel, 1.0, x_forward))
        z_rate = (sp.jerk - dot(z, sp.jerk) * z) * inverse
        heading_terms = sp.yaw_rate * dot(y, left) - dot(y, z_rate) * dot(z, forward)
        yaw_rate = heading_terms / jnp.maximum(x_forward, MIN_HEADING_SINE)
        ang_vel = cross(z, z_rate) + clip(yaw_rate, -YAW_RATE_MAX, YAW_RATE_MAX) * z
        attitude, thrust = rotation.quat_from_axes(cross(y, z), y, z), p.mass * square_norm * inverse
        return memory.replace(target=AutoTarget(position_memory, attitude, matvec(to_body, ang_vel), thrust))

    def params(self, airframe: Airframe) -> AutoParams:
        # A controller that runs every 1/freq s acts half a period late, and its input is up to one period old. Both
        # delays are added to the lag of the rotors. The command of the position loop is half a period old on average.
        freq, outer_freq = self.freq, self.outer_freq
        lag_rate, rate_limits = rotor_rate(airframe), DAMPING_RATIO / STIFFNESS_RATIO * max_gain_ratios(airframe)
        # Lead that makes the rotors as fast as the gains need.
        needed_rate = 1 / max(1 / np.max(rate_limits[:2]) - 1.5 / freq, 1 / ROTOR_RATE)
        lead = max(min(needed_rate / lag_rate, MAX_LEAD, MAX_FEEDBACK_STEP * freq / fastest_rotor_rate(airframe)), 1.0)
        # Gains from the rates of the loop about each axis.
        loop_rate = 1 / (1 / (lead * lag_rate) + 1.5 / freq)
        axis_rates = np.minimum(loop_rate * np.array([1.0, 1.0, YAW_RATE_RATIO]), rate_limits)
        stiffness, reaction = STIFFNESS_RATIO * axis_rates**2, momentum_per_torque(airframe)
        # The position loop is slower by the delay of the attitude.
        position = None
        if outer_freq is not None:
            delay = DAMPING_RATIO / STIFFNESS_RATIO / np.min(axis_rates[:2])
            position = position_params(airframe, delay + 0.5 / outer_freq, outer_freq)
        return AutoParams.create(
            airframe,
            allocation=limited_allocation(airframe, torque_arms=hover_torque_arms(airframe)),
            stiffness=stiffness,
            damping=DAMPING_RATIO * axis_rates,
            torque_max=MAX_COMPENSATED_ERROR * np.diag(airframe.inertia) * stiffness,
            observer=1 - np.exp(-OBSERVER_RATE_RATIO * np.max(axis_rates) / freq),
            lead=lead,
            reaction=reaction,
            drag_torque_share=1 / (1 + lead * lag_rate * reaction),
            position=position,
        )

    def memory(self, airframe: Airframe) -> AutoMemory:
        target = zeros(AutoTarget, position=zeros(PositionMemory), quat=as_parameter([0.0, 0.0, 0.0, 1.0]))
        return zeros(AutoMemory, target=target if self.has_outer else None)

    def update(
        self, data: DroneData, command: Setpoint | Array, memory: AutoMemory, params: AutoParams
    ) -> tuple[Array, AutoMemory]:
        s, p = data.states, params
        if isinstance(command, Setpoint):
            target = cast(AutoTarget, memory.target)
            rotation_error = rotation.multiply(rotation.conjugate(s.quat), target.quat)
            z, w = rotation_error[..., 2:3], rotation_error[..., 3:]
            thrust = target.thrust * (2 * (w * w + z * z) - 1)  # component along the current z axis
            rotation_error, ang_vel_des = quat_error(rotation_error), target.ang_vel
            is_on: Any = True
        else:
            thrust = command[..., 3:]
            rotation_error, ang_vel_des = self._command_errors(s, command, data.controls.mode)
            is_on = thrust > 0

        rotor_torque = matvec(p.mixing_matrix, quadratic_curve(s.rotor_vel, p.allocation.rpm2thrust))
        momentum = matvec(p.J, s.ang_vel)
        gyroscopic = cross(s.ang_vel, momentum)
        # The momentum of the rotors is included, because rotors that speed up turn the body the other way.
        total_momentum = momentum - rotation.along_z((p.reaction * rotor_torque[..., 2:])[..., 0])
        impulse_max = p.torque_max / self.freq
        measured_impulse = jnp.clip(total_momentum - memory.momentum, -impulse_max, impulse_max)
        is_at_rest = dot(s.ang_vel, s.ang_vel) == 0  # such a drone is assumed to stand on the floor
        disturbance_torque = (1 - p.observer) * memory.torque + jnp.where(
            is_at_rest, 0.0, p.observer * self.freq
        ) * measured_impulse
        expected_momentum = total_momentum + (rotor_torque - gyroscopic) / self.freq
        torque = gyroscopic - disturbance_torque - matvec(p.J * p.damping[..., None, :], s.ang_vel - ang_vel_des)
        if rotation_error is not None:
            torque = torque + matvec(p.J * p.stiffness[..., None, :], rotation_error)
        yaw_torque = rotor_torque[..., 2:] + p.drag_torque_share * (torque[..., 2:] - rotor_torque[..., 2:])

        wrench = jnp.concatenate([thrust, torque[..., :2], yaw_torque], axis=-1)
        thrusts = prioritized_thrusts(wrench, params=p.allocation)
        # These are the speeds of ``rotor_vel_of_thrust``, with a lead that makes the rotors faster.
        _, k1, k2 = (p.allocation.rpm2thrust[..., i] for i in range(3))
        lead = p.lead / (2 * k2)
        rotor_vel = lead * thrust_slope(thrusts, p.allocation.rpm2thrust) + ((1 - p.lead) * s.rotor_vel - lead * k1)
        rotor_vel = jnp.maximum(rotor_vel, 1.0)  # zero would switch the rotor off
        return jnp.where(is_on, rotor_vel, 0.0), memory.replace(momentum=expected_momentum, torque=disturbance_torque)

    def _command_errors(self, state: FlightState, command: Array, mode: Control) -> tuple[Array | None, Array]:
        if mode == Control.body_rate:
            return None, command[..., :3]
        rpy, ang_vel_des = command[..., :3], jnp.zeros_like(state.ang_vel)
        if self.yaw_rate:
            rpy = jnp.concatenate([rpy[..., :2], rotation.yaw(state.quat)[..., None]], axis=-1)
            ang_vel_des = command[..., 2:3] * rotation.matrix(state.quat)[..., 2, :]
        return quat_error(rotation.multiply(rotation.conjugate(state.quat), rotation.from_rpy(rpy))), ang_vel_des
