"""Inertial measurement unit: gyroscope and accelerometer with the errors of their data sheets."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Simulation, StagePlacement, derived, drone_array, nested, param, state
from crazysim.core.random import drone_key, normal, uniform
from crazysim.dynamics.rotor import RPM_TO_RAD_S
from crazysim.plugins.effects.moving_air import require_rotors, rotor_positions
from crazysim.plugins.sensors.sensor import Sensor, mounting_quat
from crazysim.plugins.sensors.triad import Triad

RAD_PER_DEGREE = math.pi / 180
STANDARD_GRAVITY = 9.80665
"""Standard acceleration of gravity, m/s^2 (CGPM 1901), the unit of data sheets."""

BMI088: dict[str, Any] = {
    "gyro": Triad(
        noise=0.014 * RAD_PER_DEGREE,
        bias_spread=1.0 * RAD_PER_DEGREE,
        bandwidth=116.0,
        limit=2000 * RAD_PER_DEGREE,
        resolution=2000 / 32768 * RAD_PER_DEGREE,
    ),
    "accel": Triad(
        noise=np.array([160e-6, 160e-6, 190e-6]) * STANDARD_GRAVITY,
        bias_spread=20e-3 * STANDARD_GRAVITY,
        bandwidth=145.0,
        limit=24 * STANDARD_GRAVITY,
        resolution=24 / 32768 * STANDARD_GRAVITY,
    ),
}
"""Bosch BMI088, of the Crazyflie 2.1. Noise densities and offsets: data sheet BST-BMI088, revision 1.9, tables 4 and 5
(typical values of offsets are used as standard deviations). Ranges of 2000 degrees/s and 24 g in 16 bits, and the
filters, are as the firmware sets them (sensors_bmi088_bmp3xx.c of crazyflie-firmware, BW_116 and OSR4 at 1600 Hz).
The data sheet states no instability or random walk of the bias: they are zero."""

_FIRMWARE_GYRO_BIAS = 0.014 * RAD_PER_DEGREE / math.sqrt(2 * 0.512)
"""Standard deviation of the mean of the gyroscope's noise over 512 samples at 1 kHz, rad/s."""
CRAZYFLIE: dict[str, Any] = {
    "gyro": dataclasses.replace(BMI088["gyro"], bias_spread=_FIRMWARE_GYRO_BIAS, bandwidth=38.0),
    "accel": dataclasses.replace(
        BMI088["accel"], bias_spread=np.array([20e-3, 20e-3, 0.0]) * STANDARD_GRAVITY, bandwidth=18.5
    ),
}
"""BMI088 after processing by the firmware of the Crazyflie (sensors_bmi088_bmp3xx.c). Before take-off the mean of 512
samples of the gyroscope is subtracted, so the mean of their noise is the remaining bias; the accelerometer is scaled to
1 g, which leaves no bias along gravity. The filters of the chip are followed by second-order Butterworth filters with
corners of 80 and 30 Hz. Each bandwidth here is the corner of a first-order filter with the same delay as the filter of
the chip and the Butterworth filter together."""

MPU9250: dict[str, Any] = {
    "gyro": Triad(
        noise=0.01 * RAD_PER_DEGREE,
        bias_spread=5.0 * RAD_PER_DEGREE,
        scale_spread=0.03,
        misalignment_spread=0.02,
        bandwidth=92.0,
        limit=2000 * RAD_PER_DEGREE,
        resolution=RAD_PER_DEGREE / 16.4,
    ),
    "accel": Triad(
        noise=300e-6 * STANDARD_GRAVITY,
        bias_spread=np.array([60e-3, 60e-3, 80e-3]) * STANDARD_GRAVITY,
        scale_spread=0.03,
        misalignment_spread=0.02,
        bandwidth=94.0,
        limit=16 * STANDARD_GRAVITY,
        resolution=STANDARD_GRAVITY / 2048,
    ),
}
"""InvenSense MPU-9250, of the Crazyflie 2.0: product specification PS-MPU-9250A-01, revision 1.0, tables 1 and 2, at
2000 degrees/s, 16 g and DLPFCFG = 2. Tolerances are used as standard deviations, and the cross-axis sensitivity as the
standard deviation of a rotation. The specification states no instability or random walk of the bias: they are zero."""

MPU6050: dict[str, Any] = {
    "gyro": dataclasses.replace(
        MPU9250["gyro"], noise=0.005 * RAD_PER_DEGREE, bias_spread=20 * RAD_PER_DEGREE, bandwidth=100.0
    ),
    "accel": dataclasses.replace(
        MPU9250["accel"],
        noise=400e-6 * STANDARD_GRAVITY,
        bias_spread=np.array([50e-3, 50e-3, 80e-3]) * STANDARD_GRAVITY,
        bandwidth=100.0,
    ),
}
"""InvenSense MPU-6050: product specification PS-MPU-6000A-00, revision 3.4, sections 6.1 and 6.2, otherwise as
``MPU9250``. The corner of the accelerometer is assumed to equal the gyroscope's."""

ICM42688P: dict[str, Any] = {
    "gyro": Triad(
        noise=2.8e-3 * RAD_PER_DEGREE,
        bandwidth=258.0,
        limit=2000 * RAD_PER_DEGREE,
        resolution=2000 / 32768 * RAD_PER_DEGREE,
    ),
    "accel": Triad(
        noise=70e-6 * STANDARD_GRAVITY,
        bandwidth=258.0,
        limit=16 * STANDARD_GRAVITY,
        resolution=16 / 32768 * STANDARD_GRAVITY,
    ),
}
"""TDK InvenSense ICM-42688-P, of flight controllers for racing. Noise densities: page 1 of data sheet DS-000347,
revision 1.7. Ranges of 2000 degrees/s and 16 g and the anti-alias filter are as Betaflight sets them by default
(accgyro_spi_icm426xx.c), in 16 bits. Biases are zero: the firmware measures them before take-off."""


class IMU(Sensor):
    """Gyroscope, rad/s, and accelerometer, m/s^2, in the sensor's frame.

    The accelerometer measures the acceleration of its position, minus gravity: 9.81 m/s^2 upwards at rest. The
    acceleration is the change of the velocity in the step by all causes, including contacts and loads. An unbalanced
    rotor shakes the drone with the centrifugal force ``imbalance w^2``.
    """

    gyro: Triad = nested(default=Triad())
    """Errors of the gyroscope, rad/s."""
    accel: Triad = nested(default=Triad())
    """Errors of the accelerometer, m/s^2."""
    pos: Param = param(default=(0.0, 0.0, 0.0), core=(3,), sparse=True)
    """Position of the accelerometer relative to the centre of mass, body frame, m. (3,)"""
    rpy: Param = param(default=(0.0, 0.0, 0.0), core=(3,), keep=False)
    """Roll, pitch and yaw of the sensor in the body frame, rad. (3,) or (n_worlds, n_drones, 3)"""
    imbalance: Param = param(default=None, core=("rotors",), low=0.0)
    """Mass of a rotor times the distance of its centre of mass from its axis, kg m; None for no vibration.
    (n_rotors,)"""
    _: dataclasses.KW_ONLY
    vel: Array = state((3,))
    """Velocity before the step, world frame, m/s. (n_worlds, n_drones, 3)"""
    ang_vel: Array = state((3,))
    """Angular velocity before the step, body frame, rad/s. (n_worlds, n_drones, 3)"""
    quat: Array = derived((4,), sparse=True)
    """Attitude of the sensor, sensor to body, unit, xyzw. (4,)"""
    rotor_pos: Array | None = derived(("rotors", 3))
    """Positions of the rotors, body frame, m; None without vibration. (n_rotors, 3)"""
    phase: Array | None = state(("rotors",), optional=True)
    """Angle of each rotor, rad; None without vibration. (n_worlds, n_drones, n_rotors)"""
    name: str = "imu"

    channels: ClassVar = {"gyro": 3, "accel": 3}

    @classmethod
    def crazyflie(cls, **settings: Any) -> IMU:
        """Return the unit of the Crazyflie 2.1 with its firmware; see ``CRAZYFLIE``. Other settings are passed on."""
        return cls(**(CRAZYFLIE | settings))

    @classmethod
    def bmi088(cls, **settings: Any) -> IMU:
        """Return the unit of the Crazyflie 2.1; see ``BMI088``. Other settings are passed on."""
        return cls(**(BMI088 | settings))

    @classmethod
    def mpu9250(cls, **settings: Any) -> IMU:
        """Return the unit of the Crazyflie 2.0; see ``MPU9250``. Other settings are passed on."""
        return cls(**(MPU9250 | settings))

    @classmethod
    def mpu6050(cls, **settings: Any) -> IMU:
        """Return a common unit of small drones; see ``MPU6050``. Other settings are passed on."""
        return cls(**(MPU6050 | settings))

    @classmethod
    def icm42688p(cls, **settings: Any) -> IMU:
        """Return a unit of racing drones; see ``ICM42688P``. Other settings are passed on."""
        return cls(**(ICM42688P | settings))

    def bind(self, sim: Simulation) -> IMU:
        gyro, accel = self.gyro.bind(sim, "gyro"), self.accel.bind(sim, "accel")
        numbers: dict[str, Any] = {"gyro": gyro, "accel": accel, "quat": mounting_quat(sim, self.rpy)}
        if self.imbalance is not None:
            require_rotors(sim, "vibration")
            phase = drone_array(sim, 0.0, sim.data.states.rotor_vel.shape[-1])
            numbers |= {"rotor_pos": rotor_positions(sim), "phase": phase}
        return self.with_arrays(sim, **numbers)

    def stages(self, sim: Simulation) -> Sequence[StagePlacement]:
        stages = super().stages(sim)
        condition = next(p.stage for p in stages if p.name is None).when  # type: ignore[attr-defined]
        return [StagePlacement(self.stage(self._store_velocities, when=condition), name=f"{self.name}_before"), *stages]

    def ideal(self, data: SimData) -> Array:
        s, zero = data.states, jnp.zeros_like(data.states.vel)
        force = specific_force(s.quat, zero, s.ang_vel, zero, data.params.gravity_vec, self.pos)
        return _to_sensor_frame(self.quat, s.ang_vel, force)

    def reset_episode(self, data: SimData) -> SimData:
        truth, keys = self.ideal(data), jax.random.split(drone_key(data, f"{self.name}_begin"))
        noise = normal(keys[0], (12, 2), truth.dtype)
        gyro, accel = self.gyro.draw_errors(truth[:3], noise[:, 0]), self.accel.draw_errors(truth[3:], noise[:, 1])
        sensor = self.replace(gyro=gyro, accel=accel)
        if self.phase is not None:
            sensor = sensor.replace(phase=2 * math.pi * uniform(keys[1], self.phase.shape, truth.dtype))
        return self.write(data, sensor)

    def measure(self, data: SimData, key: Array) -> tuple[Array, IMU]:
        sensor, s, freq, dt = self, data.states, data.core.freq, self.interval(data)
        # Motion of the centre of mass in the last step.
        ang_vel = s.ang_vel
        acc, ang_acc = freq * (s.vel - self.vel), freq * (s.ang_vel - self.ang_vel)
        # Unbalanced rotors shake the body.
        if self.phase is not None:
            speed = RPM_TO_RAD_S * s.rotor_vel
            phase = self.phase + dt * speed
            phase = phase - 2 * math.pi * jnp.floor(phase / (2 * math.pi))
            p = data.params
            shake_force, torque, momentum = vibration(self.imbalance, speed, phase, self.rotor_pos)  # type: ignore[arg-type]
            acc = acc + rotation.rotate(s.quat, shake_force) / p.mass
            ang_acc = ang_acc + rotation.matvec(p.J_inv, torque)
            ang_vel = ang_vel + rotation.matvec(p.J_inv, momentum)
            sensor = self.replace(phase=phase)
        # Both quantities at the sensor, then their errors.
        force = specific_force(s.quat, acc, s.ang_vel, ang_acc, data.params.gravity_vec, self.pos)
        truth = _to_sensor_frame(self.quat, ang_vel, force)
        noise = normal(key, (9, 2), truth.dtype)
        rates, gyro = self.gyro.measure(truth[:3], noise[:, 0], dt)
        forces, accel = self.accel.measure(truth[3:], noise[:, 1], dt)
        return jnp.concatenate([rates, forces]), sensor.replace(gyro=gyro, accel=accel)

    def measured_states(self, data: SimData) -> dict[str, Array]:
        self = self.read(data)
        return {"ang_vel": rotation.rotate(self.quat, self.part(data, "gyro"))}

    def _store_velocities(self, data: SimData) -> SimData:
        s = data.states
        return self.write(data, self.replace(vel=s.vel, ang_vel=s.ang_vel))


def specific_force(quat: Array, acc: Array, ang_vel: Array, ang_acc: Array, gravity: Array, pos: Array) -> Array:
    """Return the specific force at a point of a rigid body, body frame, m/s^2. (..., 3)

    ``R^T (a - g) + w' x r + w x (w x r)``: the acceleration of the point without gravity.

    Args:
        quat: Attitude, body to world, unit, xyzw. (..., 4)
        acc: Acceleration of the centre of mass, world frame, m/s^2. (..., 3)
        ang_vel: Angular velocity, body frame, rad/s. (..., 3)
        ang_acc: Angular acceleration, body frame, rad/s^2. (..., 3)
        gravity: Acceleration of gravity, world frame, m/s^2. (..., 3)
        pos: The point relative to the centre of mass, body frame, m. (..., 3)
    """
    force = rotation.rotate_inverse(quat, acc - gravity)
    force = rotation.add_cross(force, ang_acc, pos)
    return rotation.add_cross(force, ang_vel, rotation.cross(ang_vel, pos))


def vibration(imbalance: Array, speed: Array, phase: Array, rotor_pos: Array) -> tuple[Array, Array, Array]:
    """Return force, N, torque, N m, and angular momentum, N m s, of unbalanced rotors, body frame. (3,) each

    The centrifugal force ``m e w^2`` turns with the rotor in its plane; the angular momentum is the integral of its
    torque over time. All rotors are assumed to turn the same way, which affects only the relation of their phases.

    Args:
        imbalance: Imbalance m e, kg m. (n_rotors,)
        speed: Angular velocity of the rotors, rad/s. (n_rotors,)
        phase: Angle of the rotors, rad. (n_rotors,)
        rotor_pos: Positions of the rotors, body frame, m. (n_rotors, 3)
    """
    impulse_size, zero = imbalance * speed, jnp.zeros_like(speed)
    c, s = jnp.cos(phase), jnp.sin(phase)
    force = (impulse_size * speed)[:, None] * jnp.stack([c, s, zero], axis=-1)
    impulse = impulse_size[:, None] * jnp.stack([s, -c, zero], axis=-1)
    torque, momentum = rotation.cross(rotor_pos, force), rotation.cross(rotor_pos, impulse)
    return jnp.sum(force, axis=0), jnp.sum(torque, axis=0), jnp.sum(momentum, axis=0)


def _to_sensor_frame(quat: Array, *vectors: Array) -> Array:
    return jnp.concatenate([rotation.rotate_inverse(quat, v) for v in vectors])
