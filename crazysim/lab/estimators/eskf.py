"""Error-state Kalman filter for any airframe, which also estimates the biases of the inertial sensors."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import Simulation, drone_array, state
from crazysim.core.settings import setting
from crazysim.engine.jaxcompat import Literal
from crazysim.engine.stage import Stage, vmap_drones, vmap_worlds
from crazysim.errors import require
from crazysim.lab.estimators import inertial_path
from crazysim.lab.estimators.inertial_path import InertialPath
from crazysim.plugins.estimators import error_state, updates
from crazysim.plugins.estimators.error_state import ATT, GYRO, POS, VEL, Estimate
from crazysim.plugins.estimators.error_state_filter import ErrorStateFilter
from crazysim.plugins.estimators.kalman import UPDATE_FNS as KALMAN_UPDATE_FNS
from crazysim.plugins.sensors.barometer import (
    LAPSE_RATE,
    PRESSURE_EXPONENT,
    SEA_LEVEL_TEMPERATURE,
    Barometer,
    pressure_at,
)
from crazysim.plugins.sensors.beacons import UWB, Lighthouse
from crazysim.plugins.sensors.errors import Link, Turned
from crazysim.plugins.sensors.flow_deck import OpticalFlow, TimeOfFlight
from crazysim.plugins.sensors.gps import GPS
from crazysim.plugins.sensors.imu import IMU
from crazysim.plugins.sensors.magnetometer import Magnetometer
from crazysim.plugins.sensors.motion_capture import MotionCapture
from crazysim.plugins.sensors.sensor import Sensor
from crazysim.plugins.sensors.triad import Triad

INITIAL_STD = (0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.01, 0.01, 0.01)
"""Standard deviations at the start: position, m, velocity, m/s, attitude, rad. These are assumptions: the estimate
starts at the true state."""
RESTART_STD = (10.0, 10.0, 10.0, 10.0, 10.0, 10.0, 1.0, 1.0, 1.0)
"""Standard deviations after the restart of a filter that diverged, in the same units. These are assumptions: 10 is the
square root of ``error_state.MAX_COVARIANCE``."""
MIN_STD = 1e-3
"""Smallest standard deviation assumed for a measurement: in m, m/s, rad or pixels, and for a magnetometer as a fraction
of the field. For pressures it is 100 times as large, 0.1 Pa, and for sweeps of a ``Lighthouse`` a tenth, 1e-4 rad. For
sensors that are used by derivatives it is what an error of a state by 1e-3 m, m/s or rad makes of the measurement. This
is an assumption, for sensors without noise and for float32."""
NO_SLOPE = 1e-6
"""Change of a measurement per unit of a state below which it says nothing about the state, in their units."""

MEASURED_STATES = ("pos", "vel", "quat", "ang_vel")
"""States by whose derivatives the filter uses measurements of any sensor."""


class ESKF(ErrorStateFilter):
    """Error-state Kalman filter: position, velocity, attitude and biases of the ``IMU``, for any airframe.

    The filter of J. Solà, Quaternion kinematics for the error-state Kalman filter (2017, arXiv 1711.02508), with the
    velocity in the body frame. It reads the noise from the records of its sensors, so it has no gains to tune. It uses
    the noise densities of the ``IMU``, and the random walk, wander and spread of its biases. Wandering and constant
    errors of the other sensors are treated as white noise.

    It fuses ``MotionCapture``, ``GPS``, ``Barometer``, ``Magnetometer``, ``OpticalFlow``, ``TimeOfFlight``, ``UWB``,
    ``Lighthouse``, and any other sensor whose measurement is a smooth function of its drone's state, with errors in
    ``chains`` that have a variance, by the derivatives of the sensor's own ``ideal``: your sensors, too, anywhere on
    the drone. It assumes that ``MotionCapture``, ``OpticalFlow``, ``TimeOfFlight`` and ``UWB`` are at the centre of
    mass, and that the body that ``MotionCapture`` tracks has the attitude of the drone.
    """

    _: dataclasses.KW_ONLY
    max_pos: float = setting(default=1e4, positive=True)
    """Magnitude of a position coordinate beyond which the estimate has diverged, m."""
    max_vel: float = setting(default=100.0, positive=True)
    """Magnitude of the velocity along an axis beyond which the estimate has diverged, m/s."""
    gyro: Array = state((3,))
    """Sum of half the angular velocity at the last prediction and the angular velocities since then, for the
    trapezoidal rule, body frame, rad/s. (n_worlds, n_drones, 3)"""
    paths: Array | None = state(("rows", len(inertial_path.EMPTY_PATH_ROW)), optional=True)
    """Inertial paths to the last prediction, from the times at which the measurements in transit were taken. They are
    grouped by sensor, newest first; None if no sensor is late. (n_worlds, n_drones, n_rows, 10)"""
    reset_before: ClassVar[str | None] = "integration"
    """Name of the stage before which ``reset_episode`` is called in the first step of an episode. The reset uses the
    state before that step."""
    name: str = "eskf"

    @property
    def kinds(self) -> tuple[type[Sensor], ...]:
        return tuple(UPDATE_FNS)

    def can_fuse(self, sensor: Sensor) -> bool:
        links = [link for chain in sensor.chains.values() for link in chain]
        has_variance = all(type(x).variance is not Link.variance and not isinstance(x, Turned) for x in links)
        return super().can_fuse(sensor) or (sensor.measures_motion and bool(links) and has_variance)

    def check_simulation(self, sim: Simulation) -> None:
        super().check_simulation(sim)
        for sensor in self.aiding_sensors(sim.data):
            require(
                type(sensor) in UPDATE_FNS or _has_slope(sensor, sim.data),
                f"expected a measurement by {type(sensor).__name__} {sensor.name!r} that varies smoothly with "
                f"{', '.join(MEASURED_STATES)}, by whose derivatives ESKF fuses it, got one without derivatives. Leave "
                f"it out of the filter, or calculate ideal from data.states without steps and rounding.",
            )

    def bind(self, sim: Simulation) -> ESKF:
        quat, zero = drone_array(sim, (0.0, 0.0, 0.0, 1.0), 4), drone_array(sim, 0.0, 3)
        cov = drone_array(sim, 0.0, error_state.N_BIASED * (error_state.N_BIASED + 1) // 2)
        n_rows = sum(map(_n_rows_in_transit, self.aiding_sensors(sim.data)))
        row = inertial_path.EMPTY_PATH_ROW
        paths = drone_array(sim, row, n_rows, len(row)) if n_rows else None
        return self.with_arrays(sim, estimate=Estimate(zero, zero, quat, zero, cov, zero, zero), paths=paths)

    def filter_stages(self, data: SimData) -> Sequence[tuple[str, Stage]]:
        period, is_due = self.prediction_schedule(data.core.freq)
        return [
            ("sample", self.stage(self.add_sample)),
            ("predict", Stage(self._prediction_fn(period), "drone", is_due)),
            *(
                (f"{sensor.name}_path", self._path_start_stage(sensor.name, period))
                for sensor in self.aiding_sensors(data)
                if sensor.is_late
            ),
            *self.fusion_stages(data),
            # The last stage has the name of the estimator.
            ("", self.restart_stage()),
        ]

    def inertial(self, data: SimData) -> tuple[Array, Array]:
        """Return measured angular velocity, rad/s, and specific force, m/s^2, of one drone, body frame. (3,) each

        The ``IMU`` measures the mean force of a step in the frame at its end; here it is rotated to the frame in the
        middle of the step.
        """
        gyro, accel = super().inertial(data)
        return gyro, accel + 0.5 / data.core.freq * rotation.cross(gyro, accel)

    def estimated_states(self, data: SimData) -> dict[str, Array]:
        estimate = self.read(data).estimate
        quat = rotation.safe_normalize(estimate.quat, data.states.quat)
        ang_vel = self.inertial(data)[0] - estimate.gyro_bias
        return {"pos": estimate.pos, "quat": quat, "vel": rotation.rotate(quat, estimate.vel), "ang_vel": ang_vel}

    def reset_episode(self, data: SimData) -> SimData:
        s = data.states
        estimate = self._initial_estimate(data, s.pos, rotation.rotate_inverse(s.quat, s.vel), s.quat, INITIAL_STD)
        half_rate = 0.5 * (s.ang_vel + estimate.gyro_bias)  # type: ignore[operator]
        return self.write(data, self.replace(estimate=estimate, gyro=half_rate))

    def _initial_estimate(
        self, data: SimData, pos: Array, vel: Array, quat: Array, deviations: Sequence[float]
    ) -> Estimate:
        imu = self.imu(data)
        bias_stds = [
            x
            for triad in (imu.accel, imu.gyro)
            for x in _combined_std(triad.spread[:3], triad.instability, min_std=0.0)
        ]
        means = [rotation.rotate(imu.quat, triad.mean[:3]) for triad in (imu.accel, imu.gyro)]
        return error_state.initial_estimate(pos, vel, quat, [*deviations, *bias_stds], *means)

    def _prediction_fn(self, period: int) -> Callable[[SimData], SimData]:
        def predict(data: SimData) -> SimData:
            record, imu, dt = self.read(data), self.imu(data), period / data.core.freq
            half_rate = 0.5 * self.inertial(data)[0]
            accel, gyro = record.accel / period, (record.gyro - half_rate) / period
            noise_variances = [0.5 / dt * triad.noise**2 for triad in (imu.accel, imu.gyro)]
            estimate = error_state.predict_biased(
                record.estimate, accel, gyro, dt, data.params.gravity_vec, noise_variances[0], noise_variances[1]
            )
            walk_variances = [_bias_walk(triad, dt) for triad in (imu.accel, imu.gyro)]
            estimate = error_state.add_noise(estimate, jnp.concatenate([jnp.zeros(9, accel.dtype), *walk_variances]))
            if record.paths is not None:
                paths = [InertialPath.from_row(row, jnp.zeros_like(dt)).extend(accel, gyro, dt) for row in record.paths]
                record = record.replace(paths=jnp.stack([path.to_row() for path in paths]))
            return self.write(data, record.replace(estimate=estimate, accel=jnp.zeros_like(accel), gyro=half_rate))

        return predict

    def _path_start_stage(self, name: str, period: int) -> Stage:
        def start_path(data: SimData) -> SimData:
            # The path leads back to the last prediction; the next prediction extends it.
            record, (gyro, accel) = self.read(data), self.inertial(data)
            since_prediction = ((data.core.steps + 1) % period).astype(gyro.dtype) / data.core.freq
            empty_row = jnp.asarray(inertial_path.EMPTY_PATH_ROW, gyro.dtype)
            path_back = (
                InertialPath.from_row(empty_row, jnp.zeros_like(since_prediction))
                .extend(accel, gyro, since_prediction)
                .reverse()
                .to_row()
            )
            first, end = self._path_rows(name, data)
            paths = [record.paths[:first], path_back[None], record.paths[first : end - 1], record.paths[end:]]
            return self.write(data, record.replace(paths=jnp.concatenate(paths)))

        return Stage(start_path, "drone", lambda data: data.plugins[name].is_sampled(data))  # type: ignore[attr-defined]

    def _path_rows(self, name: str, data: SimData) -> tuple[int, int]:
        counts = {sensor.name: _n_rows_in_transit(sensor) for sensor in self.aiding_sensors(data)}
        first = sum([*counts.values()][: [*counts].index(name)])
        return first, first + counts[name]

    def update_estimate(self, sensor: Sensor, data: SimData) -> Estimate:
        """Return the estimate of one drone after the latest measurement of a sensor.

        The estimate is moved to the time at which the measurement was taken, updated, and moved back.
        """
        samples: Any = sensor.samples
        steps, taken_step, gravity = data.core.steps, samples.taken_step[0], data.params.gravity_vec
        period, (gyro, accel) = self.prediction_schedule(data.core.freq)[0], self.inertial(data)
        # Time from the last prediction to the measurement, s; negative if the measurement was taken before.
        since_prediction = (taken_step - steps + (steps + 1) % period).astype(gyro.dtype) / data.core.freq
        if not sensor.is_late:
            past_estimate = error_state.propagate(self.estimate, accel, gyro, since_prediction, gravity)
            past_estimate = _finalize(_update(sensor, self.imu(data), data, past_estimate))
            return error_state.propagate(past_estimate, accel, gyro, -since_prediction, gravity)
        interval, (first, end) = data.core.freq // sensor.rate(data.core.freq), self._path_rows(sensor.name, data)
        paths: Array = self.paths  # type: ignore[assignment]
        row, age = paths[first], (steps - taken_step) // interval  # age in measurements of the sensor
        for k in range(first + 1, end):
            row = jnp.where(age == k - first, paths[k], row)
        path, estimate = InertialPath.from_row(row, -since_prediction), self.estimate
        path_back = path.without_biases(estimate).reverse()
        past_estimate = inertial_path.propagate_along(estimate, path_back, gravity)
        past_estimate = _finalize(_update(sensor, self.imu(data), data, past_estimate))
        return inertial_path.propagate_along(past_estimate, path.without_biases(past_estimate), gravity)

    def is_valid(self, estimate: Estimate) -> Array:
        return error_state.is_within_bounds(estimate, self.max_pos, self.max_vel)

    def restarted_estimate(self, data: SimData, pos: Array, quat: Array) -> Estimate:
        return self._initial_estimate(data, pos, jnp.zeros_like(pos), quat, RESTART_STD)


def _n_rows_in_transit(sensor: Any) -> int:
    arrival_steps = sensor.samples.arrival_steps
    return 0 if arrival_steps is None else arrival_steps.shape[-1]


def _bias_walk(triad: Triad, dt: float) -> Array:
    return dt * (triad.random_walk**2 + 2 * triad.instability**2 / triad.correlation_time)


def _finalize(estimate: Estimate) -> Estimate:
    return error_state.finalize(estimate, min_angle=0.0)


def _combined_std(*deviations: Array | float, min_std: float = MIN_STD) -> Array:
    return _std(sum(x * x for x in deviations), min_std)


def _std(variance: Array | float, min_std: float = MIN_STD) -> Array:
    return jnp.sqrt(variance + jnp.asarray(min_std * min_std))


def _update_by_motion_capture(sensor: MotionCapture, imu: IMU, data: SimData, estimate: Estimate) -> Estimate:
    pos_std, angle_std = (_std(sensor.variance(name)) for name in ("pos", "quat"))
    estimate = _finalize(updates.update_pos(estimate, sensor.part(data, "pos"), pos_std))
    return updates.update_quat(estimate, sensor.part(data, "quat"), angle_std)


def update_by_ideal(sensor: Sensor, imu: IMU, data: SimData, estimate: Estimate) -> Estimate:
    """Use a measurement by the derivatives of the sensor's measurement without errors with respect to the states."""
    first, gyro = estimate, imu.measured_states(data)["ang_vel"]

    def predict(errors: Array) -> Array:
        turn = jnp.concatenate([0.5 * errors[6:9], jnp.ones_like(gyro[:1])])
        quat = rotation.multiply(first.quat, turn / jnp.sqrt(rotation.dot(turn, turn)))
        states = data.states.replace(
            pos=first.pos + errors[:3],
            vel=rotation.rotate(quat, first.vel + errors[3:6]),
            quat=quat,
            ang_vel=gyro - first.gyro_bias - errors[9:],  # type: ignore[operator]
        )
        return sensor.ideal(data.replace(states=states))

    no_errors = jnp.zeros_like(first.pos, shape=12)
    innovations, slopes = sensor.split(sensor.latest(data) - predict(no_errors)), jax.jacfwd(predict)(no_errors)
    rows = sensor.split(np.arange(len(slopes)))  # type: ignore[arg-type]
    for name in sensor.chains:
        variances = jnp.broadcast_to(sensor.variance(name), innovations[name].shape)
        for k, innovation, variance in zip(rows[name], innovations[name], variances, strict=True):
            slope, fields = slopes[k], ("pos", "vel", "att_error", "gyro_bias")
            correction = jnp.concatenate([getattr(estimate, x) - getattr(first, x) for x in fields])
            # A deviation of at least MIN_STD in the units of the states.
            std = jnp.sqrt(variance + MIN_STD**2 * (jnp.dot(slope, slope) + NO_SLOPE**2))
            error = innovation - jnp.dot(slope, correction)
            estimate = error_state.update(estimate, [*POS, *VEL, *ATT, *GYRO], slope, error, std)
    return estimate


def _has_slope(sensor: Sensor, data: SimData) -> bool:
    states = {name: getattr(data.states, name) for name in MEASURED_STATES}

    ideal = vmap_worlds(vmap_drones(lambda drone: sensor.bound(drone).ideal(drone)))

    def truth(states: dict[str, Array]) -> Array:
        return ideal(data.replace(states=data.states.replace(**states)))

    jaxpr = jax.make_jaxpr(lambda tangents: jax.jvp(truth, (states,), (tangents,))[1])(states).jaxpr
    dependent = set(jaxpr.invars)
    for eqn in jaxpr.eqns:
        if any(x in dependent for x in eqn.invars if not isinstance(x, Literal)):
            dependent.update(eqn.outvars)
    return any(x in dependent for x in jaxpr.outvars if not isinstance(x, Literal))


def _update_by_gps(sensor: GPS, imu: IMU, data: SimData, estimate: Estimate) -> Estimate:
    gyro = imu.measured_states(data)["ang_vel"]
    pos_std, vel_std = (_std(sensor.variance(name)) for name in ("pos", "vel"))
    estimate = _finalize(updates.update_pos(estimate, sensor.part(data, "pos"), pos_std, sensor.pos))
    return updates.update_vel(estimate, sensor.part(data, "vel"), vel_std, sensor.pos, gyro)


def _update_by_barometer(sensor: Barometer, imu: IMU, data: SimData, estimate: Estimate) -> Estimate:
    altitude = estimate.pos[2:] + sensor.altitude
    predicted_pressure = pressure_at(altitude)
    slope = -PRESSURE_EXPONENT * LAPSE_RATE * predicted_pressure / (SEA_LEVEL_TEMPERATURE - LAPSE_RATE * altitude)
    error = sensor.part(data, "pressure") - predicted_pressure
    std = _std(sensor.variance("pressure"), 100 * MIN_STD)
    return error_state.update(estimate, error_state.POS[2:], slope, error[0], std[0])


def _update_by_magnetometer(sensor: Magnetometer, imu: IMU, data: SimData, estimate: Estimate) -> Estimate:
    errors: Any = sensor.errors
    size = rotation.safe_norm(sensor.field)
    noise = errors.noise * math.sqrt(0.5 / sensor.interval(data))
    std = _combined_std(*(x / size for x in (noise, errors.spread[:3], errors.instability)))
    measured = rotation.rotate(sensor.quat, sensor.part(data, "field") - errors.mean[:3]) / size
    return updates.update_direction(estimate, measured, sensor.field / size, std)


def _update_by_optical_flow(sensor: OpticalFlow, imu: IMU, data: SimData, estimate: Estimate) -> Estimate:
    gyro = imu.measured_states(data)["ang_vel"]
    scale, rot = sensor.interval(data) * sensor.scale[0], rotation.matrix(estimate.quat)
    return updates.update_flow(estimate, rot, sensor.part(data, "flow"), gyro, scale, _std(sensor.variance("flow"))[0])


def _update_by_time_of_flight(sensor: TimeOfFlight, imu: IMU, data: SimData, estimate: Estimate) -> Estimate:
    distance = sensor.latest(data)
    std = _combined_std(sensor.deviation(distance))
    updated = updates.update_ray(estimate, distance[0], std[0])
    return error_state.select_estimate(distance[0] < sensor.max_range[0], updated, estimate)


def _update_by_uwb(sensor: UWB, imu: IMU, data: SimData, estimate: Estimate) -> Estimate:
    anchors, measured = sensor.anchors, sensor.latest(data)
    std = _combined_std(sensor.noise[0])
    if sensor.tdoa:
        return updates.update_differences(estimate, anchors, measured, std)
    for k in range(measured.shape[0]):
        estimate = updates.update_distance(estimate, anchors[k], measured[k], std)
    return estimate


def _update_by_lighthouse(sensor: Lighthouse, imu: IMU, data: SimData, estimate: Estimate) -> Estimate:
    rot, std = (
        rotation.matrix(estimate.quat),
        {"sweep": _combined_std(sensor.noise[0], min_std=0.1 * MIN_STD)},
    )
    return KALMAN_UPDATE_FNS[Lighthouse](sensor, imu, data, estimate, rot, std)


UPDATE_FNS: dict[type, Callable[..., Estimate]] = {
    MotionCapture: _update_by_motion_capture,
    GPS: _update_by_gps,
    Barometer: _update_by_barometer,
    Magnetometer: _update_by_magnetometer,
    OpticalFlow: _update_by_optical_flow,
    TimeOfFlight: _update_by_time_of_flight,
    UWB: _update_by_uwb,
    Lighthouse: _update_by_lighthouse,
}
"""Functions that update an estimate with a measurement, by the class of the sensor; ``update_by_ideal`` for others.
Derivatives in closed form need half of its operations."""


def _update(sensor: Sensor, imu: IMU, data: SimData, estimate: Estimate) -> Estimate:
    return UPDATE_FNS.get(type(sensor), update_by_ideal)(sensor, imu, data, estimate)
