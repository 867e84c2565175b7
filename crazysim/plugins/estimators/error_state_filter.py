"""Base class of filters with error states, which add up inertial measurements and use others on arrival."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Self, TypeVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.plugin import Simulation
from crazysim.core.stage import Stage
from crazysim.plugins.estimators import error_state
from crazysim.plugins.estimators.error_state import Estimate
from crazysim.plugins.estimators.estimator import Estimator
from crazysim.plugins.sensors.imu import IMU
from crazysim.plugins.sensors.motion_capture import MotionCapture
from crazysim.plugins.sensors.sensor import Sensor, rate_in
from crazysim.pytree import PyTree, device_array

R = TypeVar("R", bound=PyTree)


class ErrorStateFilter(Estimator):
    """Base class of filters with error states.

    A subclass also defines ``update_estimate`` and ``restarted_estimate``. Its record has the fields ``estimate``,
    ``accel`` and ``gyro``, sums of the inertial measurements since the last prediction, and the fields ``used_steps``
    and ``failures``, which ``initial_record`` describes.
    """

    _: dataclasses.KW_ONLY
    freq: int = 100
    """Predictions per second, Hz, a divisor of ``sim.freq``."""

    @classmethod
    def default(cls) -> Self:
        return cls([IMU.crazyflie(), MotionCapture()])

    def update_estimate(self, sensor: Sensor, data: SimData, record: Any) -> Estimate:
        """Return the estimate of one drone after the latest measurement of a sensor."""
        raise NotImplementedError

    def is_valid(self, estimate: Estimate) -> Array:
        """Return True where the estimate of one drone is within its bounds. ()"""
        return error_state.is_within_bounds(estimate)

    def restarted_estimate(self, data: SimData, pos: Array, quat: Array) -> Estimate:
        """Return the estimate from which the filter of one drone restarts, at rest.

        Args:
            data: Data of the drone.
            pos: Position, world frame, m. (3,)
            quat: Attitude, body to world, unit, xyzw. (4,)
        """
        raise NotImplementedError

    def initial_record(self, sim: Simulation, record_type: type[R], estimate: Estimate, **fields: Any) -> R:
        """Return the record before the first step.

        ``used_steps`` has the step in which the latest used measurement of each sensor was taken; here -1. ``failures``
        counts the restarts of the filter after the estimate left its bounds; here 0.

        Args:
            sim: The simulation.
            record_type: Class of the record.
            estimate: Estimate of all drones.
            fields: Other fields, see ``fill_record``.
        """
        shape = sim.data.states.pos.shape[:2]
        used_steps = device_array(np.full((*shape, len(self.aiding_sensors)), -1), np.int32)
        failures = device_array(np.zeros((*shape, 1)), np.int32)
        return self.fill_record(sim, record_type, estimate=estimate, used_steps=used_steps, failures=failures, **fields)

    def prediction_schedule(self, freq: int) -> tuple[int, Callable[[SimData], Any]]:
        """Return the number of steps between predictions, and a function that returns True in steps with a prediction.

        Args:
            freq: Steps of the simulation per second, Hz.
        """
        period = freq // rate_in(self, freq)
        return period, lambda data: (data.core.steps + 1) % period == 0

    def fusion_stages(self) -> list[tuple[str, Stage]]:
        """Return the names of the sensors with the stages that use their measurements."""
        return [
            (s.name, Stage(self._fusion_fn(k, s), "drone", self._is_new(k, s)))
            for k, s in enumerate(self.aiding_sensors)
        ]

    def restart_stage(self) -> Stage:
        """Return the stage that restarts the filter where its estimate has left its bounds."""
        return Stage(self._restart, "drone", lambda data: ~self.is_valid(self.read(data).estimate))

    def add_sample(self, data: SimData) -> SimData:
        """Add the latest inertial measurement of one drone to the sums."""
        record = self.read(data)
        gyro, accel = self.inertial(data)
        return self.write(data, record.replace(accel=record.accel + accel, gyro=record.gyro + gyro))

    def _is_new(self, k: int, sensor: Sensor) -> Callable[[SimData], Array]:
        """Return a function that returns True if the latest measurement of aiding sensor k was not used yet."""
        return lambda data: sensor.read(data).samples.taken_step[0] != self.read(data).used_steps[k]

    def _fusion_fn(self, k: int, sensor: Sensor) -> Callable[[SimData], SimData]:
        def fuse_measurement(data: SimData) -> SimData:
            """Use a new measurement of one sensor."""
            record, taken_step = self.read(data), sensor.read(data).samples.taken_step
            used_steps = record.used_steps.at[k].set(taken_step[0])
            return self.write(
                data, record.replace(estimate=self.update_estimate(sensor, data, record), used_steps=used_steps)
            )

        return fuse_measurement

    def _restart(self, data: SimData) -> SimData:
        """Restart the filter of one drone with a level attitude at the origin."""
        record = self.read(data)
        pos, quat = jnp.zeros_like(record.estimate.pos), jnp.zeros_like(record.estimate.quat).at[3].set(1.0)
        return self.write(
            data, record.replace(estimate=self.restarted_estimate(data, pos, quat), failures=record.failures + 1)
        )
