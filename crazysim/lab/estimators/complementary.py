"""The complementary filter of the Crazyflie's firmware: attitude and height, without a position."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jax import Array

from crazysim import rotation
from crazysim.control import Control
from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Simulation, drone_array, param, state
from crazysim.core.settings import default_rates
from crazysim.drones.airframe import GRAVITY_MAGNITUDE
from crazysim.engine.stage import Stage
from crazysim.errors import ConfigError
from crazysim.plugins.estimators.estimator import Estimator
from crazysim.plugins.sensors.barometer import Barometer
from crazysim.plugins.sensors.flow_deck import TimeOfFlight
from crazysim.plugins.sensors.imu import IMU
from crazysim.plugins.sensors.sensor import Sensor, rate_in

HEIGHT_FREQ = 100
"""Updates of the height per second, Hz (estimator_complementary.c)."""
HEIGHT_WEIGHT, VELOCITY_DECAY = 0.9, 0.995
"""Weight of the previous height in an update, and factor of the velocity in each update
(position_estimator_altitude.c)."""
CLIMB_DEADBAND = 0.04
"""Largest vertical acceleration that is treated as zero, in units of gravity (position_estimator_altitude.c)."""
MAX_RANGE_AGE = 0.05
"""Greatest age of a distance to the ground that is used, s (position_estimator_altitude.c)."""


class Complementary(Estimator):
    """The Crazyflie's complementary filter: attitude from an ``IMU``, height from a ``Barometer`` or ``TimeOfFlight``.

    The gyroscope is integrated, and the attitude is slowly corrected towards the direction of gravity that the
    accelerometer measures (Mahony's filter); the heading is not corrected. Positions and velocities along x and y are
    zero, as in the firmware, so controllers can use the estimate only for commands at the level of attitude and below.
    Sources: sensfusion6.c, estimator_complementary.c and position_estimator_altitude.c of bitcraze/crazyflie-firmware,
    commit 2a18fc29. The filter begins at the true attitude, height and vertical velocity, and assumes that the
    accelerometer measures 1 g at rest.
    """

    _: dataclasses.KW_ONLY
    freq: int = 250
    """Updates of the attitude per second, Hz, a divisor of ``sim.freq``."""
    kp: Param = param(default=0.4, low=0.0)
    """Gain of the attitude error, 1/s. (1,)"""
    ki: Param = param(default=0.001, low=0.0)
    """Gain of the integral of the attitude error, 1/s^2. (1,)"""
    quat: Array = state((4,))
    """Attitude, body to world, xyzw. (n_worlds, n_drones, 4)"""
    integral: Array = state((3,))
    """Integral of the attitude error, times ``ki``, rad/s. (n_worlds, n_drones, 3)"""
    height: Array = state()
    """Height, m. (n_worlds, n_drones, 1)"""
    climb: Array = state()
    """Rate of change of the height in the last update, m/s. (n_worlds, n_drones, 1)"""
    inertial_climb: Array = state()
    """Leaky integral of the vertical acceleration, m/s. (n_worlds, n_drones, 1)"""
    over_surface: Array = state()
    """1 once a distance to the ground has been measured, after which pressure is not used; else 0.
    (n_worlds, n_drones, 1)"""
    name: str = "complementary"

    @classmethod
    def default(cls) -> Complementary:
        return cls([IMU.crazyflie(), Barometer()])

    @property
    def kinds(self) -> tuple[type[Sensor], ...]:
        return Barometer, TimeOfFlight

    def bind(self, sim: Simulation) -> Complementary:
        classes = [type(sensor).__name__ for sensor in self.aiding_sensors(sim.data)]
        if not classes or len(set(classes)) < len(classes):
            raise ConfigError(
                f"expected a Barometer, a TimeOfFlight or one of each among the sensors of {self.name!r}, got {classes}"
            )
        if self.control and sim.data.controls.mode == Control.state:
            raise ConfigError(
                f"expected control at the level 'attitude' or below with {self.name!r}, which estimates no position, "
                f"got 'state'. Use estimator=\"kalman\"."
            )
        return self.with_arrays(sim, quat=drone_array(sim, (0.0, 0.0, 0.0, 1.0), 4))

    def filter_stages(self, data: SimData) -> Sequence[tuple[str, Stage]]:
        freq = data.core.freq
        period = freq // rate_in(self, freq)
        height_period = freq // default_rates(freq, {"rate of the height": HEIGHT_FREQ})["rate of the height"]

        def update_attitude(data: SimData) -> SimData:
            record, dt = self.read(data), period / data.core.freq
            gyro, accel = self.inertial(data)
            quat, integral = update_mahony(record.quat, record.integral, gyro, accel, dt, record.kp, record.ki)
            climb = inertial_climb(record.inertial_climb, quat, accel, dt)
            return self.write(data, record.replace(quat=quat, integral=integral, inertial_climb=climb))

        def update_height(data: SimData) -> SimData:
            record, dt = self.read(data), height_period / data.core.freq
            height, over_surface = self._height(data, record, dt)
            climb = (height - record.height) / dt
            return self.write(data, record.replace(height=height, climb=climb, over_surface=over_surface))

        def is_due_every(steps: int) -> Any:
            return lambda data: (data.core.steps + 1) % steps == 0

        return [
            ("attitude", Stage(update_attitude, "drone", is_due_every(period))),
            # The last stage has the name of the estimator.
            ("", Stage(update_height, "drone", is_due_every(height_period))),
        ]

    def estimated_states(self, data: SimData) -> dict[str, Array]:
        record, s = self.read(data), data.states
        zero = jnp.zeros_like(s.pos[..., :2])
        pos, vel = (jnp.concatenate([zero, z], axis=-1) for z in (record.height, record.climb))
        return {"pos": pos, "vel": vel, "quat": rotation.safe_normalize(record.quat, s.quat)}

    def reset_episode(self, data: SimData) -> SimData:
        s, climb = data.states, data.states.vel[2:]
        return self.write(data, self.replace(quat=s.quat, height=s.pos[2:], climb=climb, inertial_climb=climb))

    def _height(self, data: SimData, record: Complementary, dt: float) -> tuple[Array, Array]:
        height, over_surface, shift = record.height, record.over_surface, dt * record.inertial_climb
        new_height = height
        sensors = self.aiding_sensors(data)
        for sensor in sensors:
            if isinstance(sensor, Barometer):
                new_height = filtered_height(height, sensor.part(data, "height"), shift)
        for sensor in sensors:
            if isinstance(sensor, TimeOfFlight):
                distance = sensor.latest(data)
                is_useful = (sensor.age(data) <= MAX_RANGE_AGE) & (distance < sensor.max_range)
                new_height, over_surface = height_over_surface(
                    height, new_height, distance, is_useful, over_surface, shift
                )
        return new_height, over_surface


def filtered_height(height: Array, measured_height: Array, shift: Array) -> Array:
    """Return the height after an update, m. (1,)

    Args:
        height: Height before the update, m. (1,)
        measured_height: Measured height, m. (1,)
        shift: Change of the height in the interval by the inertial velocity, m. (1,)
    """
    return HEIGHT_WEIGHT * height + (1 - HEIGHT_WEIGHT) * measured_height + shift


def height_over_surface(
    height: Array, pressure_height: Array, distance: Array, is_useful: Array, over_surface: Array, shift: Array
) -> tuple[Array, Array]:
    """Return the height after an update, m, and the new ``over_surface`` (``positionEstimateInternal``). (1,) each

    Args:
        height: Height before the update, m. (1,)
        pressure_height: Height to use if the distance to the ground was never measured, m. (1,)
        distance: Distance to the ground, m. (1,)
        is_useful: True where the distance is recent and within the sensor's range. (1,)
        over_surface: 1 if the distance to the ground has been measured before, else 0. (1,)
        shift: Change of the height in the interval by the inertial velocity, m. (1,)
    """
    over_surface = jnp.where(is_useful, 1.0, over_surface)
    height_estimate = jnp.where(over_surface > 0, height, pressure_height)
    return jnp.where(is_useful, filtered_height(height, distance, shift), height_estimate), over_surface


def update_mahony(
    quat: Array, integral: Array, gyro: Array, accel: Array, dt: float, kp: Array | float, ki: Array | float
) -> tuple[Array, Array]:
    """Return attitude and integral after an interval (``sensfusion6UpdateQ``).

    The firmware's fast inverse square root, which is off by up to 0.2%, is replaced by an exact one.

    Args:
        quat: Attitude, body to world, unit, xyzw. (4,)
        integral: Integral of the attitude error, times ``ki``, rad/s. (3,)
        gyro: Angular velocity, body frame, rad/s. (3,)
        accel: Specific force, body frame, in any unit; zero for no correction. (3,)
        dt: Length of the interval, s.
        kp: Gain of the attitude error, 1/s. (1,)
        ki: Gain of the integral of the attitude error, 1/s^2. (1,)
    """
    # Error between measured and estimated direction of gravity.
    error = rotation.cross(rotation.safe_normalize(accel, jnp.zeros_like(accel)), rotation.matrix(quat)[2])
    integral = integral + ki * dt * error
    has_force = jnp.any(accel != 0)
    rate = gyro + jnp.where(has_force, integral + kp * error, 0.0)
    # Small rotation, then unit length again.
    quat_step = jnp.concatenate([0.5 * dt * rate, jnp.ones_like(rate[:1])])
    return rotation.safe_normalize(rotation.multiply(quat, quat_step), quat), integral


def inertial_climb(climb: Array, quat: Array, accel: Array, dt: float) -> Array:
    """Return the upward velocity after an interval, m/s (``positionUpdateVelocity``). (1,)

    Args:
        climb: Upward velocity before the interval, m/s. (1,)
        quat: Attitude, body to world, unit, xyzw. (4,)
        accel: Specific force, body frame, m/s^2. (3,)
        dt: Length of the interval, s.
    """
    acc = rotation.matrix(quat)[2:] @ accel / GRAVITY_MAGNITUDE - 1.0
    excess_acc = jnp.sign(acc) * jnp.maximum(jnp.abs(acc) - CLIMB_DEADBAND, 0.0)
    return VELOCITY_DECAY * (climb + GRAVITY_MAGNITUDE * dt * excess_acc)
