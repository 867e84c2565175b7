"""Controller ``"pid"``: the PID cascade of the Crazyflie firmware at each of its command levels."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.control.gains import require_gains
from crazysim.control.levels import Control
from crazysim.control.pid_cascade import (
    LOOPS,
    THRUST_SCALE,
    PIDMemory,
    PIDParams,
    desired_attitude,
    desired_rates,
    desired_torque,
    desired_velocity,
    heading_vector,
    to_heading_frame,
    wrap_degrees,
)
from crazysim.control.pid_loop import PIDLoop, PIDLoopMemory, continue_integral, pid_step
from crazysim.control.power_distribution import command_of_rotor_vel, distribute_power, pwm_of_thrust, rotor_vel_of_pwm
from crazysim.control.protocol import Controller, DroneData, zeros
from crazysim.control.setpoint import Setpoint
from crazysim.drones import Airframe

DEGREES_PER_RADIAN = 180 / np.pi


class PID(Controller):
    """The firmware's default controller: PID loops for position, velocity, attitude and body rates.

    At the level ``state`` it follows position and yaw, as the firmware does with a full-state setpoint: velocity and
    acceleration are not fed forward. At the level ``body_rate`` it follows collective thrust and body rates (CTBR) and
    does not level the drone. Source: controller_pid.c, position_controller_pid.c, attitude_pid_controller.c and pid.c
    of bitcraze/crazyflie-firmware, commit 2a18fc29.
    """

    name: ClassVar[str] = "pid"
    levels: ClassVar[tuple[Control, ...]] = (Control.state, Control.attitude, Control.body_rate)
    output: ClassVar[Control] = Control.rotor_vel
    freq: int = 500
    """Rate of the attitude and rate loops, Hz (``ATTITUDE_RATE``)."""
    outer_freq: int = 100
    """Rate of the position and velocity loops, Hz (``POSITION_RATE``)."""
    hold_yaw: bool = False
    """True to integrate a commanded yaw rate to a yaw that the attitude loop holds, as in the firmware. The attitude
    loop acts on Euler angles, and therefore disturbs the rates of a strongly tilted drone. False to follow the yaw rate
    in the rate loop."""
    whole_numbers: bool = False
    """Whether to truncate torque and PWM to integers where the firmware does; gradients ignore the truncation."""

    def params(self, airframe: Airframe) -> PIDParams:
        require_gains(airframe, PIDParams)
        freqs = dict(zip(LOOPS, (self.outer_freq, self.outer_freq, self.freq, self.freq), strict=True))
        loops = {name: PIDLoop.create(airframe, f"pid.{name}", freq) for name, freq in freqs.items()}
        return PIDParams.create(airframe, **loops)

    def memory(self, airframe: Airframe) -> PIDMemory:
        params = self.params(airframe)
        loops = {name: PIDLoopMemory.create(getattr(params, name)) for name in LOOPS}
        return zeros(PIDMemory, **loops, started=np.zeros(1, bool))

    def outer(self, data: DroneData, command: Setpoint, memory: PIDMemory, params: PIDParams) -> PIDMemory:
        s, heading = data.states, heading_vector(data.states.quat)
        # The first measurement is in world axes, as in positionControllerResetAllPID. It has no effect with the
        # firmware's derivative gain, which is zero in this loop.
        position_memory = memory.position.with_first_measurement(s.pos, memory.started)
        vel_des, position_memory = desired_velocity(
            s.pos, heading, command.pos, position_memory, self.outer_freq, loop=params.position
        )
        tilt, thrust, velocity_memory = desired_attitude(
            s.vel, heading, vel_des, memory.velocity, self.outer_freq, params=params
        )
        rpy_des = jnp.concatenate([tilt, memory.rpy_des[2:]])
        return memory.replace(position=position_memory, velocity=velocity_memory, rpy_des=rpy_des, thrust=thrust)

    def update(
        self, data: DroneData, command: Setpoint | Array, memory: PIDMemory, params: PIDParams
    ) -> tuple[Array, PIDMemory]:
        rpy, ang_vel = DEGREES_PER_RADIAN * rotation.to_rpy(data.states.quat), DEGREES_PER_RADIAN * data.states.ang_vel
        thrust = memory.thrust if isinstance(command, Setpoint) else pwm_of_thrust(command[3:], params=params.motors)
        rpy_des, attitude_memory, ang_vel_des = self._desired_rates(data, command, memory, params, rpy)
        torque, rate_memory = desired_torque(ang_vel, ang_vel_des, memory.rate, self.freq, loop=params.rate)
        pwm = distribute_power(thrust, torque, params=params.motors, whole_numbers=self.whole_numbers)
        rotor_vel = rotor_vel_of_pwm(pwm, params=params.motors)
        new_memory = memory.replace(
            attitude=attitude_memory,
            rate=rate_memory,
            rpy_des=rpy_des,
            thrust=thrust,
            started=jnp.ones_like(memory.started),
        )
        return rotor_vel, _reset_at_zero_thrust(new_memory, rpy, data.states.pos)

    def take_over(
        self, data: DroneData, command: Setpoint | Array, memory: PIDMemory, params: PIDParams, rotor_vel: Array
    ) -> PIDMemory:
        # The rotor speeds continue without a jump. At the level ``state``, the integrals of the velocity loop are set
        # so that thrust, roll and pitch continue. At every level, the integrals of the rate loop are set so that the
        # torque continues.
        s, p, initial_memory = data.states, params, jax.tree.map(jnp.zeros_like, memory)
        rpy, ang_vel = DEGREES_PER_RADIAN * rotation.to_rpy(s.quat), DEGREES_PER_RADIAN * s.ang_vel
        thrust, torque = command_of_rotor_vel(rotor_vel, params=p.motors)
        # Outer loops continue from the present attitude and thrust.
        if isinstance(command, Setpoint):
            heading = heading_vector(s.quat)
            position_memory = initial_memory.position.with_first_measurement(
                to_heading_frame(heading, s.pos), initial_memory.started
            )
            vel_des, _ = desired_velocity(
                s.pos, heading, command.pos, position_memory, self.outer_freq, loop=p.position
            )
            measured_vel = to_heading_frame(heading, s.vel)
            velocity_memory = initial_memory.velocity.with_first_measurement(measured_vel, initial_memory.started)
            output, _ = pid_step(
                vel_des - measured_vel, measured_vel, velocity_memory, self.outer_freq, loop=p.velocity
            )
            scaled_thrust = (thrust - p.thrust_base) / THRUST_SCALE
            current_output = jnp.stack([rpy[1], -rpy[0], scaled_thrust[0]])
            velocity_memory = continue_integral(velocity_memory, output, current_output, loop=p.velocity)
            initial_memory = initial_memory.replace(position=position_memory, velocity=velocity_memory)
        # Inner loops start from measured values.
        initial_memory = initial_memory.replace(
            attitude=initial_memory.attitude.with_first_measurement(rpy, initial_memory.started),
            rate=initial_memory.rate.with_first_measurement(ang_vel, initial_memory.started),
        )
        started_memory = initial_memory.replace(
            rpy_des=rpy, thrust=thrust, started=jnp.ones_like(initial_memory.started)
        )
        # The rate loop continues from the present torque.
        _, _, ang_vel_des = self._desired_rates(data, command, started_memory, p, rpy)
        output, _ = desired_torque(ang_vel, ang_vel_des, started_memory.rate, self.freq, loop=p.rate)
        return started_memory.replace(rate=continue_integral(started_memory.rate, output, torque, loop=p.rate))

    def _desired_rates(
        self, data: DroneData, command: Setpoint | Array, memory: PIDMemory, params: PIDParams, rpy: Array
    ) -> tuple[Array, PIDLoopMemory, Array]:
        is_rate_command = data.controls.mode == Control.body_rate
        if is_rate_command and not self.hold_yaw:
            return memory.rpy_des, memory.attitude, DEGREES_PER_RADIAN * command[:3]  # type: ignore[index]
        if isinstance(command, Setpoint):
            rpy_des = jnp.concatenate([memory.rpy_des[:2], DEGREES_PER_RADIAN * command.yaw])
        elif is_rate_command:
            yaw = jnp.where(memory.started, memory.rpy_des[2:], rpy[2:]) + DEGREES_PER_RADIAN * command[2:3] / self.freq
            rpy_des = jnp.concatenate([rpy[:2], yaw])
        else:
            rpy_des = DEGREES_PER_RADIAN * command[:3]
        rpy_des = jnp.concatenate([rpy_des[:2], wrap_degrees(rpy_des[2:])])
        attitude_memory = memory.attitude.with_first_measurement(rpy, memory.started)
        ang_vel_des, attitude_memory = desired_rates(rpy, rpy_des, attitude_memory, self.freq, loop=params.attitude)
        if is_rate_command:
            ang_vel_des = jnp.concatenate([DEGREES_PER_RADIAN * command[:2], ang_vel_des[2:]])  # type: ignore[index]
        return rpy_des, attitude_memory, ang_vel_des


def _reset_at_zero_thrust(memory: PIDMemory, rpy: Array, pos: Array) -> PIDMemory:
    m, is_off = memory, memory.thrust <= 0
    return m.replace(
        position=m.position.reset_where(is_off, pos),
        velocity=m.velocity.reset_where(is_off, jnp.zeros_like(pos)),
        attitude=m.attitude.reset_where(is_off, rpy, resets_filter=False),
        rate=m.rate.reset_where(is_off, jnp.zeros_like(rpy), resets_filter=False),
        rpy_des=jnp.where(is_off, rpy, m.rpy_des),
    )
