"""The default controller, which follows commands of every level with any airframe, from its physics alone.

A force follows from the errors of position and velocity (``crazysim.control.position``), a torque from the errors of
attitude and body rates. Forces and torques that the model lacks, such as wind, a load, a wrong mass or a shifted centre
of mass, are estimated from velocities that differ from those that the rotors should have caused, and compensated.

All gains follow from the rate ``a`` at which the rotors, with feedback of their speeds, follow a command. A drone turns
under gains per inertia kp and kd on attitude and body rate as ``s^3 / a + s^2 + kd s + kp``. With

    kd = 0.6 a,   kp = 0.12 a^2,   and half of these rates about yaw, where rotors have less authority,

body rates follow with a damping ratio of 0.65, which overshoots a step by 7%, and attitudes with a pole at 0.31 a and
a pair of damping ratio 0.55, without overshoot. The attitude loop delays a slow command by kd / kp = 5 / a, from which
the gains of the position loop follow.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.control.allocation import AllocationParams, hover_arms, wrench_matrix
from crazysim.control.bandwidth import YAW, rotor_rate
from crazysim.control.fitted import FittedAuto
from crazysim.control.flatness import HORIZONTAL, NO_THRUST
from crazysim.control.levels import Control
from crazysim.control.position import PositionMemory, PositionParams, specific_force, upright
from crazysim.control.priority import prioritized_thrusts
from crazysim.control.protocol import Controller, DroneData, DroneState
from crazysim.control.rigid_body import RigidBodyParams, rigid_body
from crazysim.control.setpoint import Setpoint
from crazysim.drones import Airframe
from crazysim.dynamics import Dynamics
from crazysim.dynamics.rotor import curve, rotor_vel_of_thrust
from crazysim.pytree import PyTree, as_parameter, leaf
from crazysim.rotation import cross, dot, matvec, safe_clip, safe_sqrt

RATE = 50.0
"""Rate at which the rotors follow with feedback of their speeds, 1/s, where that needs at most ``LEAD``."""
LEAD = 5.0
"""Largest factor by which the feedback of rotor speeds makes the rotors faster than their own lag, 1."""
STEP = 0.5
"""Largest part of the missing rotor speed that the feedback adds in one tick of the controller, 1."""
DAMPING = 0.6
"""Angular acceleration per body rate over the rate of the rotors, 1."""
STIFFNESS = 0.12
"""Angular acceleration per rotation error over the squared rate of the rotors, 1."""
OBSERVER = 0.6
"""Rate of the estimate of unknown torques over the rate of the rotors, 1."""
TORQUE_MAX = 0.5
"""Largest unknown torque that is compensated, as the rotation error against which it holds, rad."""
YAW_RATE_MAX = 35.0
"""Largest rate about body z that holds a heading, rad/s: what a Crazyflie's gyroscope measures (BMI088, data sheet)."""
INVERTED = 1e-6
"""One plus the cosine of the tilt error below which its direction counts as undefined, 1: 0.08 degrees."""


class AutoParams(RigidBodyParams):
    """Gains and parameters of the default controller, each shared or one per drone."""

    mixing_matrix: Array = leaf("parameter", 2)
    """Rotor thrusts to collective thrust, 1, and body torque, m. (4, n_rotors)"""
    stiffness: Array = leaf("parameter", 1)
    """Angular acceleration per rotation error, 1/s^2. (3,)"""
    damping: Array = leaf("parameter", 1)
    """Angular acceleration per body rate, 1/s. (3,)"""
    torque_max: Array = leaf("parameter", 1)
    """Largest unknown torque that is compensated, N m. (3,)"""
    observer: Array = leaf("parameter", 1, (1,))
    """Part of a new measurement in the estimate of unknown torques, 1. (1,)"""
    lead: Array = leaf("parameter", 1, (1,))
    """Factor on the difference of desired and present rotor speeds, 1. (1,)"""
    position: PositionParams
    """Gains and limits of the position loop."""

    @staticmethod
    def create(airframe: Airframe, freq: int) -> AutoParams:
        """Return the shared parameters of an airframe.

        A controller that runs every 1/freq s acts half a period late, and its input is one period old at worst, which
        counts as lag of the rotors.

        Args:
            airframe: The airframe.
            freq: Rate of the controller, Hz.

        Raises:
            ConfigError: If the airframe lacks a value.
        """
        lag = rotor_rate(airframe)
        lead = max(min(RATE / lag, LEAD, STEP / (1 - np.exp(-lag / freq))), 1.0)
        rate = 1 / (1 / (lead * lag) + 1.5 / freq)
        rates = rate * np.array([1.0, 1.0, YAW])
        stiffness, damping = STIFFNESS * rates**2, DAMPING * rates
        body = rigid_body(airframe)
        allocation: AllocationParams = body.pop("allocation")
        return AutoParams(
            **body,
            allocation=allocation.replace(arms=as_parameter(hover_arms(airframe))),
            mixing_matrix=as_parameter(wrench_matrix(airframe)),
            stiffness=as_parameter(stiffness),
            damping=as_parameter(damping),
            torque_max=as_parameter(TORQUE_MAX * np.diag(airframe.inertia) * stiffness),
            observer=as_parameter(1 - np.exp(-OBSERVER * rate / freq)),
            lead=as_parameter(lead),
            position=PositionParams.create(airframe, DAMPING / STIFFNESS / rate, freq),
        )


class AutoMemory(PyTree):
    """Memory of the default controller: what it expects of this tick, and its estimates."""

    position: PositionMemory
    """Memory of the position loop."""
    momentum: Array = leaf("drone", 1)
    """Angular momentum expected at this tick from the known torques, body frame, N m s. (n_worlds, n_drones, 3)"""
    torque: Array = leaf("drone", 1)
    """Estimated unknown torque, body frame, N m. (n_worlds, n_drones, 3)"""

    @staticmethod
    def at_rest() -> AutoMemory:
        """Return the memory of one drone before the first tick."""
        return AutoMemory(PositionMemory.at_rest(), as_parameter(np.zeros(3)), as_parameter(np.zeros(3)))


def error_of_quat(quat: Array) -> Array:
    """Return the rotation vector, shortened to ``2 sin(angle / 2)``, that turns a body into a desired attitude.

    The thrust is tilted along the shortest way, and the rest turns about it (Brescianini and D'Andrea 2018). The first
    two entries are the tilt error, the third is the yaw error; each is an angle where it is small, and 2 at 180
    degrees.

    Args:
        quat: Attitude of the desired frame in the body frame, unit, xyzw. (..., 4)

    Returns:
        Rotation error, body frame, rad. (..., 3)
    """
    x, y, z, w = (quat[..., i : i + 1] for i in range(4))
    squared = w * w + z * z
    inverted = squared < INVERTED / 2
    inverse = jnp.where(inverted, 0.0, 1 / safe_sqrt(jnp.where(inverted, 1.0, squared)))
    roll = jnp.where(inverted, 2.0, 2 * (w * x - y * z) * inverse)
    yaw = 2 * jnp.where(w < 0, -z, z) * inverse
    return jnp.concatenate([roll, 2 * (w * y + x * z) * inverse, yaw], axis=-1)


def error_of_axes(x: Array, y: Array, z: Array) -> Array:
    """Return the rotation error of ``error_of_quat`` from the axes of the desired frame in the body frame. (..., 3)"""
    plus = 1 + z[..., 2:]
    inverted = plus < INVERTED
    plus = jnp.where(inverted, 1.0, plus)
    tilt = 1 / safe_sqrt(0.5 * plus)
    sin, cos = (x[..., 1:2] - y[..., :1]) / plus, (x[..., :1] + y[..., 1:2]) / plus
    # Of half the yaw error: the cosine up to 90 degrees; beyond, where rounding spoils that, the sine.
    half = safe_sqrt(0.5 * (1 + jnp.abs(cos)))
    yaw = jnp.where(cos < 0, jnp.where(sin < 0, -2 * half, 2 * half), sin / half)
    roll = jnp.where(inverted, 2.0, -z[..., 1:2] * tilt)
    return jnp.concatenate([roll, z[..., :1] * tilt, jnp.where(inverted, 0.0, yaw)], axis=-1)


class Auto(Controller):
    """Control of any airframe at every command level, with gains from its physics; needs measured rotor speeds.

    At the level ``attitude`` it follows roll, pitch, yaw and collective thrust, at ``body_rate`` true body rates and
    collective thrust (CTBR); there a thrust of zero or less switches the motors off. Saturated rotors give roll and
    pitch torque first, then thrust, then yaw torque (``prioritized_thrusts``).
    """

    name: ClassVar[str] = "auto"
    levels: ClassVar[tuple[Control, ...]] = (Control.state, Control.attitude, Control.body_rate)
    output: ClassVar[Control] = Control.rotor_vel
    freq: int = 500
    """Rate, Hz."""
    outer_freq: int = 100
    """Rate at which setpoints take effect, Hz; ``state_freq`` of a simulation replaces it."""
    yaw_rate: bool = False
    """True if the third entry of an attitude command is a yaw rate, rad/s, instead of a yaw."""

    def adapted(self, control: Control, fitted: str | None) -> Controller | None:
        """Return this controller; for fitted dynamics its position loop; None where the command is passed through.

        Args:
            control: Command level.
            fitted: Name of the fitted model, which contains the response to attitudes; None for dynamics with rotors.
        """
        if fitted is None:
            return self if control in self.levels else None
        return FittedAuto(Dynamics(fitted), self.outer_freq) if control == Control.state else None

    def outer(self, data: DroneData, command: Setpoint, memory: Any, params: Any) -> Any:
        """Return the memory as it is: the position loop runs with the others, at ``freq``."""
        return memory

    def params(self, airframe: Airframe) -> AutoParams:
        """Return gains and constants for an airframe."""
        return AutoParams.create(airframe, self.freq)

    def memory(self, airframe: Airframe) -> AutoMemory:
        """Return the memory before the first tick."""
        return AutoMemory.at_rest()

    def update(
        self, data: DroneData, command: Setpoint | Array, memory: AutoMemory, params: AutoParams
    ) -> tuple[Array, AutoMemory]:
        """Return the rotor speeds, and the memory."""
        s, p = data.states, params
        wrench = matvec(p.mixing_matrix, curve(s.rotor_vel, p.allocation.rpm2thrust))
        if isinstance(command, Setpoint):
            # The heading of a state command is that of its quaternion, which needs no angles.
            ahead, _ = rotation.heading(data.controls.state.cmd[..., 9:13])
            thrust, acc, position = self._of_setpoint(s, command, ahead, wrench[..., :1], memory.position, p)
            memory = memory.replace(position=position)
            on: Any = True
        else:
            thrust, acc = command[..., 3:], self._of_command(s, command, data.controls.mode, p)
            on = thrust > 0

        momentum = matvec(p.J, s.ang_vel)
        gyroscopic = cross(s.ang_vel, momentum)
        measured = safe_clip((momentum - memory.momentum) * self.freq, -p.torque_max, p.torque_max)
        measured = jnp.where(dot(s.ang_vel, s.ang_vel) == 0, 0.0, measured)  # the floor holds it
        unknown = memory.torque + p.observer * (measured - memory.torque)
        expected = momentum + (wrench[..., 1:] - gyroscopic) / self.freq
        torque = matvec(p.J, acc) + gyroscopic - unknown

        thrusts = prioritized_thrusts(jnp.concatenate([thrust, torque], axis=-1), params=p.allocation)
        desired = rotor_vel_of_thrust(thrusts, p.allocation.rpm2thrust)
        driven = jnp.maximum(s.rotor_vel + p.lead * (desired - s.rotor_vel), 1.0)  # zero would be off
        return jnp.where(on, driven, 0.0), memory.replace(momentum=expected, torque=unknown)

    def _of_setpoint(
        self, s: DroneState, setpoint: Setpoint, ahead: Array, thrust: Array, memory: PositionMemory, params: AutoParams
    ) -> tuple[Array, Array, PositionMemory]:
        """Return collective thrust, N, and angular acceleration, rad/s^2, that lead to a setpoint, and the memory.

        The desired z axis of the body is along the specific force, its x axis is closest to the heading, and their
        rates are fed forward from jerk and yaw rate, as in ``attitude_of_thrust``, here in the body frame.
        """
        p, matrix = params, rotation.matrix(s.quat)
        to_body = jnp.swapaxes(matrix, -1, -2)
        drag = matvec(p.drag_matrix, matvec(to_body, s.vel)) / p.mass
        known = matvec(matrix, drag + rotation.along_z(thrust[..., 0] / p.mass[..., 0]))
        specific, memory = specific_force(s.pos, s.vel, known, setpoint, memory, self.freq, p.position)
        up = matrix[..., 2, :]  # the world's z axis in the body frame
        specific = upright(matvec(to_body, specific) - drag, up, setpoint, p.position)

        squared = dot(specific, specific)
        falls = squared < NO_THRUST**2
        inverse = jnp.where(falls, 0.0, 1 / safe_sqrt(jnp.where(falls, 1.0, squared)))
        z = jnp.where(falls, up, specific * inverse)
        jerk = matvec(to_body, setpoint.jerk)
        z_rate = (jerk - dot(z, jerk) * z) * inverse

        ahead = matvec(to_body, ahead)
        across = cross(z, ahead)
        x_ahead = rotation.safe_norm(across)
        parallel = x_ahead < NO_THRUST
        left = cross(up, ahead)
        y = jnp.where(parallel, left, across / jnp.where(parallel, 1.0, x_ahead))
        x = cross(y, z)
        turned = setpoint.yaw_rate * dot(y, left) - dot(y, z_rate) * dot(z, ahead)
        yaw_rate = safe_clip(turned / jnp.maximum(x_ahead, HORIZONTAL), -YAW_RATE_MAX, YAW_RATE_MAX)
        rate = cross(z, z_rate) + yaw_rate * z
        acc = p.stiffness * error_of_axes(x, y, z) + p.damping * (rate - s.ang_vel)
        return p.mass * specific[..., 2:], acc, memory

    def _of_command(self, s: DroneState, command: Array, mode: Control, params: AutoParams) -> Array:
        """Return the angular acceleration that follows an attitude or body rates, rad/s^2. (3,)"""
        p = params
        if mode == Control.body_rate:
            return p.damping * (command[..., :3] - s.ang_vel)
        rpy, rate = command[..., :3], jnp.zeros_like(s.ang_vel)
        if self.yaw_rate:
            rpy = jnp.concatenate([rpy[..., :2], rotation.yaw(s.quat)[..., None]], axis=-1)
            rate = command[..., 2:3] * rotation.matrix(s.quat)[..., 2, :]
        error = error_of_quat(rotation.multiply(rotation.conjugate(s.quat), rotation.from_rpy(rpy)))
        return p.stiffness * error + p.damping * (rate - s.ang_vel)
