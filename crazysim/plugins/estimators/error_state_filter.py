"""Base class of filters with error states, which add up inertial measurements and use others on arrival."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Self

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.plugin import Simulation, nested, state
from crazysim.engine.pytree import device_array
from crazysim.engine.stage import Stage
from crazysim.plugins.estimators import error_state
from crazysim.plugins.estimators.error_state import Estimate
from crazysim.plugins.estimators.estimator import Estimator
from crazysim.plugins.sensors.imu import IMU
from crazysim.plugins.sensors.motion_capture import MotionCapture
from crazysim.plugins.sensors.sensor import Sensor, rate_in


class ErrorStateFilter(Estimator):
    """Base class of filters with error states.

    A subclass also defines ``update_estimate`` and ``restarted_estimate``.
    """

    _: dataclasses.KW_ONLY
    freq: int = 100
    """Predictions per second, Hz, a divisor of ``sim.freq``."""
    estimate: Any = nested(default=None)
    """The estimate, an ``Estimate``."""
    accel: Array = state((3,))
    """Sum of the specific forces since the last prediction, body frame, m/s^2. (n_worlds, n_drones, 3)"""
    gyro: Array = state((3,))
    """Sum of the angular velocities since the last prediction, body frame, rad/s. (n_worlds, n_drones, 3)"""
    used_steps: Array = state(("sensors",), dtype=np.int32)
    """Step in which the latest used measurement of each sensor was taken; -1 before the first.
    (n_worlds, n_drones, n_sensors)"""
    failures: Array = state(dtype=np.int32)
    """Number of times that the estimate left its bounds and the filter restarted. (n_worlds, n_drones, 1)"""
    name: str = "filter"

    @classmethod
    def default(cls) -> Self:
        return cls([IMU.crazyflie(), MotionCapture()])

    def update_estimate(self, sensor: Sensor, data: SimData) -> Estimate:
        """Return the estimate of one drone after the latest measurement of a sensor in ``data.plugins``."""
        raise NotImplementedError

    def is_valid(self, estimate: Estimate) -> Array:
        """Whether the estimate of one drone is within its bounds. ()"""
        return error_state.is_within_bounds(estimate)

    def restarted_estimate(self, data: SimData, pos: Array, quat: Array) -> Estimate:
        """Return the estimate from which the filter of one drone restarts, at rest.

        Args:
            data: Data of the drone.
            pos: Position, world frame, m. (3,)
            quat: Attitude, body to world, unit, xyzw. (4,)
        """
        raise NotImplementedError

    def with_arrays(self, sim: Simulation, **values: Any) -> Self:
        used_steps = np.full((*sim.data.states.pos.shape[:2], len(self.sensors) - 1), -1)
        return super().with_arrays(sim, used_steps=device_array(used_steps, np.int32), **values)

    def prediction_schedule(self, freq: int) -> tuple[int, Callable[[SimData], Any]]:
        """Return the number of steps between predictions, and a function that returns True in steps with a prediction.

        Args:
            freq: Steps of the simulation per second, Hz.
        """
        period = freq // rate_in(self, freq)
        return period, lambda data: (data.core.steps + 1) % period == 0

    def fusion_stages(self, data: SimData) -> list[tuple[str, Stage]]:
        """Return the names of the sensors with the stages that use their measurements."""
        return [(x.name, self._fusion_stage(k, x.name)) for k, x in enumerate(self.aiding_sensors(data))]

    def restart_stage(self) -> Stage:
        """Return the stage that restarts the filter where its estimate has left its bounds."""
        return self.stage(self._restart, when=lambda data: ~self.is_valid(self.read(data).estimate))

    def add_sample(self, data: SimData) -> SimData:
        """Add the latest inertial measurement of one drone to the sums."""
        gyro, accel = self.inertial(data)
        return self.write(data, self.replace(accel=self.accel + accel, gyro=self.gyro + gyro))

    def _fusion_stage(self, k: int, name: str) -> Stage:
        def is_new(data: SimData) -> Array:
            return data.plugins[name].samples.taken_step[0] != self.read(data).used_steps[k]  # type: ignore[attr-defined]

        def fuse_measurement(data: SimData) -> SimData:
            record, sensor = self.read(data), data.plugins[name]
            used_steps = record.used_steps.at[k].set(sensor.samples.taken_step[0])  # type: ignore[attr-defined]
            estimate = record.update_estimate(sensor, data)
            return self.write(data, record.replace(estimate=estimate, used_steps=used_steps))

        return Stage(fuse_measurement, "drone", is_new)

    def _restart(self, data: SimData) -> SimData:
        pos, quat = jnp.zeros_like(self.estimate.pos), jnp.zeros_like(self.estimate.quat).at[3].set(1.0)
        estimate = self.restarted_estimate(data, pos, quat)
        return self.write(data, self.replace(estimate=estimate, failures=self.failures + 1))
