"""The extended Kalman filter of the Crazyflie's firmware, which fuses the measurements of sensors."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Param, Simulation, drone_array, param, state
from crazysim.engine.pytree import device_array
from crazysim.engine.stage import Stage
from crazysim.errors import ConfigError
from crazysim.plugins.estimators import error_state, updates
from crazysim.plugins.estimators.error_state import Estimate
from crazysim.plugins.estimators.error_state_filter import ErrorStateFilter
from crazysim.plugins.sensors.beacons import SWEEP_TILTS, UWB, Lighthouse
from crazysim.plugins.sensors.flow_deck import FAR_NOISE, OpticalFlow, TimeOfFlight, range_deviation
from crazysim.plugins.sensors.imu import IMU
from crazysim.plugins.sensors.motion_capture import MotionCapture
from crazysim.plugins.sensors.sensor import Sensor

FIRMWARE_RATE = 1000
"""Rate of the loop of the firmware's filter, Hz; every loop adds process noise (estimator_kalman.c)."""
INITIAL_STD = (100.0, 100.0, 1.0, 0.01, 0.01, 0.01, 0.01, 0.01, 0.01)
"""Standard deviations at the start: position, m, velocity, m/s, attitude, rad (kalman_core_params_defaults.h)."""
MEASUREMENT_STD = {
    "pos": 0.01,  # position by motion capture, m (crtp_localization_service.c)
    "quat": 4.5e-3,  # attitude by motion capture, rad (crtp_localization_service.c)
    "flow": 0.2,  # optical flow, pixels (flowdeck_v1v2.c)
    "range": FAR_NOISE[2],  # scale of the deviation of a ``TimeOfFlight``, m (zranger2.c)
    "distance": 0.25,  # distance to an anchor, m (lpsTwrTag.c)
    "difference": 0.15,  # difference of two distances, m (tdoaEngine.h)
    "sweep": 0.001,  # sweep angle of a second-generation lighthouse, rad (lighthouse_position_est.c, sweepStdLh2)
}
"""Standard deviations that the firmware assumes for measurements."""
Std = Mapping[str, Array]
"""Standard deviations by the names of ``MEASUREMENT_STD``."""


class Kalman(ErrorStateFilter):
    """The Crazyflie's extended Kalman filter: position, velocity and attitude of every drone from its sensors.

    The filter begins at the true state after a world's first step, with the uncertainty of the firmware after switching
    on. Predictions run at ``freq`` and use the mean of the inertial measurements since the last prediction.
    Measurements of other sensors are used in the step in which they arrive. In addition to an ``IMU``, the filter takes
    any of ``MotionCapture``, ``OpticalFlow``, ``TimeOfFlight``, ``UWB`` and ``Lighthouse``.
    """

    _: dataclasses.KW_ONLY
    all_axes: bool = False
    """True to use the accelerometer along all axes, for any airframe and in wind; False for the firmware's method,
    which assumes that the force of the rotors is the only one."""
    accel_noise: Param = param(default=(0.5, 0.5, 1.0), core=(3,), low=0.0)
    """Standard deviation of accelerations in a loop of the firmware, body frame, m/s^2. (3,)"""
    gyro_noise: Param = param(default=(0.1, 0.1, 0.1), core=(3,), low=0.0)
    """Standard deviation of angular velocities in a loop of the firmware, body frame, rad/s. (3,)"""
    deviations: Mapping[str, float] | None = param(default=None, core=("measurements",), positive=True, shapes=((),))
    """Standard deviations that differ from ``MEASUREMENT_STD``, by the names in it; in ``data.plugins``, all of them
    in its order. (n,)"""
    previous_quat: Array = state((4,))
    """Attitude at the end of the previous step, xyzw, with which measurements are predicted. (n_worlds, n_drones, 4)"""
    name: str = "kalman"

    @property
    def kinds(self) -> tuple[type[Sensor], ...]:
        return tuple(UPDATE_FNS)

    def bind(self, sim: Simulation) -> Kalman:
        if unknown_names := (self.deviations or {}).keys() - MEASUREMENT_STD.keys():
            raise ConfigError(
                f"expected deviations of {', '.join(MEASUREMENT_STD)}, got {', '.join(map(repr, unknown_names))}"
            )
        deviations = list((MEASUREMENT_STD | dict(self.deviations or {})).values())
        quat, zeros = drone_array(sim, (0.0, 0.0, 0.0, 1.0), 4), drone_array(sim, 0.0, 3)
        cov = np.diag(np.square(INITIAL_STD))[np.triu_indices(error_state.N)]
        estimate = Estimate(zeros, zeros, quat, zeros, drone_array(sim, cov, *cov.shape), None, None)
        deviation_array = device_array(np.array(deviations), quat.dtype)
        return self.with_arrays(sim, estimate=estimate, previous_quat=quat, deviations=deviation_array)

    def filter_stages(self, data: SimData) -> Sequence[tuple[str, Stage]]:
        period, is_due = self.prediction_schedule(data.core.freq)
        return [
            ("sample", self.stage(self.add_sample)),
            ("predict", Stage(self._prediction_fn(period), "drone", is_due)),
            ("noise", self.stage(self._add_noise)),
            *self.fusion_stages(data),
            ("finalize", self.stage(self._finalize, when=self._is_updated)),
            ("restart", self.restart_stage()),
            # The last stage has the name of the estimator.
            ("", self.stage(self._store_attitude)),
        ]

    def estimated_states(self, data: SimData) -> dict[str, Array]:
        estimate = self.read(data).estimate
        quat = rotation.safe_normalize(estimate.quat, data.states.quat)
        return {"pos": estimate.pos, "quat": quat, "vel": rotation.rotate(quat, estimate.vel)}

    def reset_episode(self, data: SimData) -> SimData:
        s = data.states
        estimate = error_state.initial_estimate(s.pos, rotation.rotate_inverse(s.quat, s.vel), s.quat, INITIAL_STD)
        return self.write(data, self.replace(estimate=estimate, previous_quat=s.quat))

    def _prediction_fn(self, period: int) -> Callable[[SimData], SimData]:
        def predict(data: SimData) -> SimData:
            record = self.read(data)
            accel, gyro = record.accel / period, record.gyro / period
            dt = period / data.core.freq
            estimate = error_state.predict(record.estimate, accel, gyro, dt, all_axes=self.all_axes)
            zero = jnp.zeros_like(accel)
            return self.write(data, record.replace(estimate=estimate, accel=zero, gyro=zero))

        return predict

    def _add_noise(self, data: SimData) -> SimData:
        dt, n_loops, accel = 1 / FIRMWARE_RATE, FIRMWARE_RATE / data.core.freq, self.accel_noise
        deviations = jnp.concatenate([dt**2 * accel, dt * accel, dt * self.gyro_noise])
        return self.write(data, self.replace(estimate=error_state.add_noise(self.estimate, n_loops * deviations**2)))

    def update_estimate(self, sensor: Sensor, data: SimData) -> Estimate:
        rot, std = rotation.matrix(self.previous_quat), dict(zip(MEASUREMENT_STD, self.deviations, strict=True))  # type: ignore[arg-type]
        return UPDATE_FNS[type(sensor)](sensor, self.imu(data), data, self.estimate, rot, std)

    def _is_updated(self, data: SimData) -> Array:
        return jnp.any(self.read(data).estimate.att_error != 0)

    def _finalize(self, data: SimData) -> SimData:
        return self.write(data, self.replace(estimate=error_state.finalize(self.estimate)))

    def _store_attitude(self, data: SimData) -> SimData:
        return self.write(data, self.replace(previous_quat=self.estimate.quat))

    def restarted_estimate(self, data: SimData, pos: Array, quat: Array) -> Estimate:
        return error_state.initial_estimate(pos, jnp.zeros_like(pos), quat, INITIAL_STD)


def _update_by_motion_capture(
    sensor: MotionCapture, imu: IMU, data: SimData, estimate: Estimate, rot: Array, std: Std
) -> Estimate:
    estimate = updates.update_pos(estimate, sensor.part(data, "pos"), std["pos"])
    return updates.update_quat(estimate, sensor.part(data, "quat"), std["quat"])


def _update_by_optical_flow(
    sensor: OpticalFlow, imu: IMU, data: SimData, estimate: Estimate, rot: Array, std: Std
) -> Estimate:
    scale = sensor.interval(data) * sensor.scale[0]
    gyro = imu.measured_states(data)["ang_vel"]
    return updates.update_flow(estimate, rot, sensor.part(data, "flow"), gyro, scale, std["flow"])


def _update_by_time_of_flight(
    sensor: TimeOfFlight, imu: IMU, data: SimData, estimate: Estimate, rot: Array, std: Std
) -> Estimate:
    distance = sensor.latest(data)
    deviation = range_deviation(distance, std["range"])[0]
    updated = updates.update_range(estimate, rot, distance[0], deviation)
    return error_state.select_estimate(distance[0] < sensor.max_range[0], updated, estimate)


def _update_by_uwb(sensor: UWB, imu: IMU, data: SimData, estimate: Estimate, rot: Array, std: Std) -> Estimate:
    anchors, measured = sensor.anchors, sensor.latest(data)
    for k in range(measured.shape[0]):
        if sensor.tdoa:
            estimate = updates.update_difference(estimate, anchors[0], anchors[k + 1], measured[k], std["difference"])
        else:
            estimate = updates.update_distance(estimate, anchors[k], measured[k], std["distance"])
    return estimate


def _update_by_lighthouse(
    sensor: Lighthouse, imu: IMU, data: SimData, estimate: Estimate, rot: Array, std: Std
) -> Estimate:
    angle, visibility, k = sensor.part(data, "angle"), sensor.part(data, "visible"), 0
    for pos, quat in zip(sensor.stations, sensor.quat, strict=True):
        for diode in sensor.diodes:
            for plane, tilt in enumerate(SWEEP_TILTS):
                station = pos, rotation.matrix(quat)
                updated = updates.update_sweep(estimate, rot, diode, station, tilt, angle[2 * k + plane], std["sweep"])
                estimate = error_state.select_estimate(visibility[k] > 0, updated, estimate)
            k += 1
    return estimate


UPDATE_FNS: dict[type, Callable[..., Estimate]] = {
    MotionCapture: _update_by_motion_capture,
    OpticalFlow: _update_by_optical_flow,
    TimeOfFlight: _update_by_time_of_flight,
    UWB: _update_by_uwb,
    Lighthouse: _update_by_lighthouse,
}
"""Functions that update an estimate with a measurement, by the class of the sensor."""
