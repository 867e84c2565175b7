"""Mellinger's controller as implemented in the Crazyflie firmware."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.control.gains import Gains
from crazysim.control.levels import Control
from crazysim.control.power_distribution import (
    PowerDistributionParams,
    command_of_rotor_vel,
    distribute_power,
    pwm_of_thrust,
    rotor_vel_of_pwm,
)
from crazysim.control.protocol import Controller, DroneData
from crazysim.control.setpoint import Setpoint
from crazysim.dynamics.models import GRAVITY, part
from crazysim.engine.pytree import PyTree, leaf
from crazysim.rotation import clip, dot


class MellingerParams(Gains, controller="mellinger"):
    """Gains and limits of the controller, each shared or one per drone."""

    mass: Array = leaf("parameter", 1, (1,), airframe="mellinger.mass")
    """Mass that the controller assumes, kg. (1,)"""
    mass_thrust: Array = leaf("parameter", 1, (1,), airframe="mellinger.mass_thrust")
    """Thrust of each motor over the collective thrust, PWM/N. (1,)"""
    gravity_vec: Array = leaf("parameter", 1, (3,), airframe=lambda _: GRAVITY)
    """Gravitational acceleration that the controller assumes, world frame, m/s^2. (3,)"""
    kp: Array = leaf("parameter", 1, (3,), airframe="mellinger.kp")
    """Gain on the position error, N/m. (3,)"""
    kd: Array = leaf("parameter", 1, (3,), airframe="mellinger.kd")
    """Gain on the velocity error, N s/m. (3,)"""
    ki: Array = leaf("parameter", 1, (3,), airframe="mellinger.ki")
    """Gain on the integral of the position error, N/(m s). (3,)"""
    integral_max: Array = leaf("parameter", 1, (3,), airframe="mellinger.integral_max")
    """Limit of the integral of the position error, m s. (3,)"""
    kR: Array = leaf("parameter", 1, (3,), airframe="mellinger.kR")
    """Gain on the rotation error, PWM. (3,)"""
    kw: Array = leaf("parameter", 1, (3,), airframe="mellinger.kw")
    """Gain on the error of the body rates, PWM s/rad. (3,)"""
    ki_m: Array = leaf("parameter", 1, (3,), airframe="mellinger.ki_m")
    """Gain on ``integral_m``, PWM/(rad s). (3,)"""
    kd_omega: Array = leaf("parameter", 1, (3,), airframe="mellinger.kd_omega")
    """Gain on the derivative of the error of the body rates, PWM s^2/rad. (3,)"""
    integral_m_max: Array = leaf("parameter", 1, (3,), airframe="mellinger.integral_m_max")
    """Limit of ``integral_m``, rad s. (3,)"""
    torque_max: Array = leaf("parameter", 1, (3,), airframe="mellinger.torque_max")
    """Limit of the torque, PWM. (3,)"""
    motors: PowerDistributionParams = part(PowerDistributionParams)
    """Power distribution."""


class MellingerMemory(PyTree):
    """Memory of the controller."""

    integral: Array = leaf("drone", 1, (3,))
    """Integral of the position error, m s. (n_worlds, n_drones, 3)"""
    integral_m: Array = leaf("drone", 1, (3,))
    """Integral of the negative rotation error, rad s. (n_worlds, n_drones, 3)"""
    ang_vel: Array = leaf("drone", 1, (3,))
    """Angular velocity at the last tick, rad/s. (n_worlds, n_drones, 3)"""
    ang_vel_des: Array = leaf("drone", 1, (3,))
    """Desired body rates at the last tick, rad/s. (n_worlds, n_drones, 3)"""


def desired_force(
    pos: Array, vel: Array, setpoint: Setpoint, integral: Array, freq: float, *, params: MellingerParams
) -> tuple[Array, Array]:
    """Return the force that leads to a setpoint, world frame, N, and the new integral, m s. (..., 3) each

    Source: Mellinger and Kumar (2011, eq. 6).

    Args:
        pos: Position, world frame, m. (..., 3)
        vel: Velocity, world frame, m/s. (..., 3)
        integral: Integral of the position error, m s. (..., 3)
        freq: Rate of this controller, Hz.
    """
    p, error = params, setpoint.pos - pos
    integral = clip(integral + error / freq, -p.integral_max, p.integral_max)
    force = p.mass * (setpoint.acc - p.gravity_vec) + p.kp * error + p.kd * (setpoint.vel - vel) + p.ki * integral
    return force, integral


def torque_of_rotation(
    axes: Array,
    axes_des: Array,
    ang_vel: Array,
    ang_vel_des: Array,
    memory: MellingerMemory,
    freq: float,
    *,
    params: MellingerParams,
) -> tuple[Array, MellingerMemory]:
    """Return the torque that turns the drone to an attitude, PWM (..., 3), and the memory.

    The law is eq. 10 to 13 of Mellinger and Kumar (2011), without the factor one half on the rotation error, and
    with an integral and a derivative of the rates.

    Args:
        axes: Rotation matrix, body to world. (..., 3, 3)
        axes_des: Desired rotation matrix. (..., 3, 3)
        ang_vel: Angular velocity, body frame, rad/s. (..., 3)
        ang_vel_des: Desired body rates, rad/s. (..., 3)
        freq: Rate of this controller, Hz.
    """
    p, m = params, memory
    error = rotation_error(axes, axes_des)
    integral = clip(m.integral_m - error / freq, -p.integral_m_max, p.integral_m_max)
    rate_error_dot = ((ang_vel_des - m.ang_vel_des) - (ang_vel - m.ang_vel)) * freq
    torque = -p.kR * error + p.kw * (ang_vel_des - ang_vel) + p.ki_m * integral + p.kd_omega * rate_error_dot
    new_memory = m.replace(integral_m=integral, ang_vel=ang_vel, ang_vel_des=ang_vel_des)
    return clip(torque, -p.torque_max, p.torque_max), new_memory


class Mellinger(Controller, params=MellingerParams, memory=MellingerMemory):
    """Controller of the Crazyflie firmware after Mellinger and Kumar (2011).

    Crazyflow's cascade is derived from this controller, but differs: this controller lowers all motors if one motor
    would exceed its maximum, has no minimum PWM, resets its integrals at zero thrust, and runs position and attitude
    part at the same rate. It does not follow body rates; use ``controller="pid"`` for them. At the level ``state`` the
    desired body rates are read from the command, ``cmd[13:16]``, because a ``Setpoint`` has no body rates. Source:
    controller_mellinger.c of bitcraze/crazyflie-firmware, commit 2a18fc29.
    """

    name: ClassVar[str] = "mellinger"
    levels: ClassVar[tuple[Control, ...]] = (Control.state, Control.attitude)
    output: ClassVar[Control] = Control.rotor_vel
    freq: int = 500
    """Rate of the controller, Hz (``ATTITUDE_RATE``)."""
    whole_numbers: bool = False
    """Whether to truncate torque and PWM to integers where the firmware does; gradients ignore the truncation."""

    def update(
        self, data: DroneData, command: Setpoint | Array, memory: MellingerMemory, params: MellingerParams
    ) -> tuple[Array, MellingerMemory]:
        p = params
        thrust, torque, memory, _ = self._command(data, command, memory, p)
        is_off = thrust <= 0
        memory = memory.replace(
            integral=jnp.where(is_off, 0.0, memory.integral), integral_m=jnp.where(is_off, 0.0, memory.integral_m)
        )
        pwm = distribute_power(thrust, torque, params=p.motors, whole_numbers=self.whole_numbers)
        return rotor_vel_of_pwm(pwm, params=p.motors), memory

    def take_over(
        self,
        data: DroneData,
        command: Setpoint | Array,
        memory: MellingerMemory,
        params: MellingerParams,
        rotor_vel: Array,
    ) -> MellingerMemory:
        # The integrals are set so that force and torque continue without a jump, as far as their limits allow.
        p, s = params, data.states
        ang_vel_des = _desired_rates(data, command)
        zero = jnp.zeros_like(s.ang_vel)
        initial_memory = MellingerMemory(zero, zero, s.ang_vel, ang_vel_des)
        thrust, torque = command_of_rotor_vel(rotor_vel, params=p.motors)
        _, _, _, force = self._command(data, command, initial_memory, p)
        current_force = thrust / p.mass_thrust * rotation.z_axis(s.quat)
        integral = clip(_divide_by_gain(current_force - force, p.ki), -p.integral_max, p.integral_max)
        integral = integral if isinstance(command, Setpoint) else zero
        initial_memory = initial_memory.replace(integral=integral)
        _, torque_without_integral, _, _ = self._command(data, command, initial_memory, p)
        return initial_memory.replace(
            integral_m=clip(
                _divide_by_gain(torque - torque_without_integral, p.ki_m), -p.integral_m_max, p.integral_m_max
            )
        )

    def _command(
        self, data: DroneData, command: Setpoint | Array, memory: MellingerMemory, params: MellingerParams
    ) -> tuple[Array, Array, MellingerMemory, Array]:
        s, p, force = data.states, params, jnp.zeros_like(data.states.pos)
        axes = rotation.matrix(s.quat)
        if isinstance(command, Setpoint):
            force, integral = desired_force(s.pos, s.vel, command, memory.integral, self.freq, params=p)
            memory = memory.replace(integral=integral)
            axes_des, thrust = axes_of_force(force, command.yaw), p.mass_thrust * dot(force, axes[:, 2])
        else:
            axes_des = rotation.matrix(rotation.from_rpy(command[:3]))
            thrust = pwm_of_thrust(command[3:], params=p.motors)
        ang_vel_des = _desired_rates(data, command)
        torque, memory = torque_of_rotation(axes, axes_des, s.ang_vel, ang_vel_des, memory, self.freq, params=p)
        return thrust, torque, memory, force


def _desired_rates(data: DroneData, command: Setpoint | Array) -> Array:
    if isinstance(command, Setpoint):
        return data.controls.state.cmd[13:16]
    return jnp.zeros_like(data.states.ang_vel)


def _divide_by_gain(x: Array, gain: Array) -> Array:
    return jnp.where(gain == 0, 0.0, x / jnp.where(gain == 0, 1.0, gain))


def axes_of_force(force: Array, yaw: Array) -> Array:
    """Return the rotation matrix with the z axis along a force and the x axis closest to a heading. (..., 3, 3)

    Args:
        force: Force, world frame, N. (..., 3)
        yaw: Yaw, rad. (..., 1)
    """
    return jnp.stack(rotation.axes_from_z(force, *rotation.heading_axes(yaw)), axis=-1)


def rotation_error(axes: Array, axes_des: Array) -> Array:
    """Return the rotation error ``vee(Rd^T R - R^T Rd)``: along the axis, with twice the sine of the angle. (..., 3)"""
    x, y, z = axes[..., 0], axes[..., 1], axes[..., 2]
    xd, yd, zd = axes_des[..., 0], axes_des[..., 1], axes_des[..., 2]
    parts = [dot(zd, y) - dot(yd, z), dot(xd, z) - dot(zd, x), dot(yd, x) - dot(xd, y)]
    return jnp.concatenate(parts, axis=-1)
