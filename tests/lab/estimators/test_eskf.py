"""The error-state filter with biases: its linearisation, the distribution of its errors, and flight on it."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from consistency import assert_chi_squared, errors, normalised_square

from crazysim import ConfigError, Sim, param, rotation
from crazysim.core.plugin import Param
from crazysim.engine.stage import vmap_drones, vmap_worlds
from crazysim.lab.estimators.eskf import update_by_ideal
from crazysim.lab.estimators.inertial_path import EMPTY_PATH_ROW, InertialPath, propagate_along
from crazysim.plugins.estimators import ESKF, error_state, updates
from crazysim.plugins.sensors import (
    GPS,
    IMU,
    UWB,
    MotionCapture,
    OpticalFlow,
    TimeOfFlight,
    Triad,
)
from crazysim.plugins.sensors.errors import Link, Turned, White
from crazysim.plugins.sensors.sensor import Sensor

GYRO = Triad(noise=2.4e-4, bias_spread=0.0175, random_walk=1e-4)
ACCEL = Triad(noise=2e-3, bias_spread=0.2, random_walk=1e-3)
POS, ANGLE = 0.01, 0.02
"""Standard deviations of measured positions, m, and attitudes, rad."""


def add_error(estimate, error):
    """Return the true state: an estimate plus its errors, (15,)."""
    turn = jnp.concatenate([0.5 * error[6:9], jnp.ones(1)])
    return estimate.replace(
        pos=estimate.pos + error[:3],
        vel=estimate.vel + error[3:6],
        quat=rotation.multiply(estimate.quat, turn / jnp.sqrt(turn @ turn)),
        accel_bias=estimate.accel_bias + error[9:12],
        gyro_bias=estimate.gyro_bias + error[12:],
    )


def error_of(true, estimate):
    """Return the errors of an estimate, (15,)."""
    turn = 2 * rotation.multiply(rotation.conjugate(estimate.quat), true.quat)[:3]
    biases = true.accel_bias - estimate.accel_bias, true.gyro_bias - estimate.gyro_bias
    return jnp.concatenate([true.pos - estimate.pos, true.vel - estimate.vel, turn, *biases])


@pytest.fixture
def estimate(x64):
    quat = jnp.array([0.3, -0.2, 0.4, 0.8])
    pos, vel, bias = jnp.array([0.3, -0.2, 1.0]), jnp.array([2.0, -1.0, 0.5]), jnp.array([0.1, -0.2, 0.3])
    result = error_state.initial_estimate(pos, vel, quat / jnp.sqrt(quat @ quat), [1.0] * 15, bias, 0.1 * bias)
    root = np.random.default_rng(1).normal(size=(15, 15))
    return result.replace(cov=jnp.asarray(0.01 * root @ root.T)[np.triu_indices(15)])


def test_the_covariance_moves_with_the_derivatives_of_the_step(estimate):
    """``F P F' + G Q G'`` with F by automatic differentiation; the filter neglects dt^2 / 2 times 10 m/s^2."""
    accel, gyro, gravity, dt = jnp.array([0.5, 1.0, 9.0]), jnp.array([3.0, -2.0, 1.0]), jnp.array([0, 0, -9.81]), 1e-3
    noise = jnp.array([10.0, 20.0, 30.0]), jnp.array([40.0, 50.0, 60.0])

    def step(state):
        return error_state.predict_biased(state, accel, gyro, dt, gravity, *noise)

    after = jax.jit(step)(estimate)
    f = jax.jit(jax.jacfwd(lambda error: error_of(step(add_error(estimate, error)), after)))(jnp.zeros(15))
    g = f[:, 9:] * (np.arange(15) < 9)[:, None]  # noise acts like a bias for one interval; biases stay
    expected = f @ error_state.covariance(estimate.cov) @ f.T + g @ jnp.diag(jnp.concatenate(noise)) @ g.T
    np.testing.assert_allclose(error_state.covariance(after.cov), expected, rtol=0, atol=5e-6)
    assert (g @ g.T)[3:9, 3:9].max() * 40 > 1e-4, "the noise would be too small to matter"


KNOWN_DIRECTION, FLOW_SCALE, MEASURED_RATE = jnp.array([0.6, 0.0, -0.8]), 0.49, jnp.array([0.3, -0.2, 0.1])
ANCHORS = jnp.array([[-3.0, -3.0, 0.2], [3.0, -3.0, 2.4], [3.0, 3.0, 0.2], [-3.0, 3.0, 2.4]])


def image_motion(state, cos_tilt):
    """Return the motion of the image; the filter neglects that its attitude has errors."""
    turn = MEASURED_RATE - state.gyro_bias
    return FLOW_SCALE * (state.vel[:2] * cos_tilt / state.pos[2] + jnp.array([-1.0, 1.0]) * turn[1::-1])


def differences(state):
    """Return the differences of the distances to the anchors from the distance to the first one, m. (3,)"""
    distance = jnp.linalg.norm(state.pos - ANCHORS, axis=-1)
    return distance[1:] - distance[0]


MEASURED = {
    "vel": lambda state, _: rotation.rotate(state.quat, state.vel),
    "direction": lambda state, _: rotation.rotate_inverse(state.quat, KNOWN_DIRECTION),
    "flow": lambda state, rot: image_motion(state, rot[2, 2]),
    "ray": lambda state, _: state.pos[2:] / rotation.matrix(state.quat)[2, 2:],
    "differences": lambda state, _: differences(state),
}
"""Measurements of a state, by kind."""
UPDATES = {
    "vel": lambda state, z, rot, std: updates.update_vel(state, z, std),
    "direction": lambda state, z, rot, std: updates.update_direction(state, z, KNOWN_DIRECTION, std),
    "flow": lambda state, z, rot, std: updates.update_flow(state, rot, z, MEASURED_RATE, jnp.asarray(FLOW_SCALE), std),
    "ray": lambda state, z, rot, std: updates.update_ray(state, z[0], std),
    "differences": lambda state, z, rot, std: updates.update_differences(state, ANCHORS, z, std),
}
"""Updates of a state by a measurement, by kind."""


@pytest.mark.parametrize("kind", MEASURED)
def test_updates_have_the_gain_of_the_derivatives_of_the_measurement(estimate, kind):
    """The measurement has a tiny error; the expected gain is that of all axes at once."""
    rot = rotation.matrix(estimate.quat)
    prediction = MEASURED[kind](estimate, rot)
    error = 1e-7 * jnp.array([1.0, -2.0, 1.5])[: len(prediction)]
    std = jnp.array([0.1, 0.2, 0.3]) if kind in ("vel", "direction") else 0.1
    variance = jnp.diag(jnp.full(len(error), std**2)) + (std**2 if kind == "differences" else 0.0)
    after = jax.jit(lambda z: UPDATES[kind](estimate, z, rot, std))(prediction + error)
    h = jax.jit(jax.jacfwd(lambda e: MEASURED[kind](add_error(estimate, e), rot)))(jnp.zeros(15))
    p = error_state.covariance(estimate.cov)
    gain = p @ h.T @ jnp.linalg.inv(h @ p @ h.T + variance)
    result = error_of(error_state.finalize(after, min_angle=0.0), estimate)
    # rounding of float64 and the 1e-6 that the firmware adds to norms
    np.testing.assert_allclose(result, gain @ error, rtol=0, atol=1e-11)
    np.testing.assert_allclose(error_state.covariance(after.cov), p - gain @ h @ p, rtol=1e-6, atol=1e-8)


def test_a_path_propagates_covariance_and_state(estimate):
    """``F P F'`` with F by automatic differentiation, along a path and back; a turn by 0.27 rad in 0.2 s.

    Derivatives with respect to the biases assume a force that does not rotate.
    """
    gravity, path = jnp.array([0, 0, -9.81]), InertialPath.from_row(jnp.asarray(EMPTY_PATH_ROW, float), jnp.zeros(()))
    for k in range(20):
        path = path.extend(jnp.array([0.5, 1.0, 9.0 + 0.1 * k]), jnp.array([1.0, -0.8, 0.5 - 0.02 * k]), 0.01)

    def carry(state):
        return propagate_along(state, path.without_biases(state), gravity)

    there = jax.jit(carry)(estimate)
    f = jax.jit(jax.jacfwd(lambda error: error_of(carry(add_error(estimate, error)), there)))(jnp.zeros(15))
    p = error_state.covariance(estimate.cov)
    np.testing.assert_allclose(error_state.covariance(there.cov), f @ p @ f.T, rtol=0, atol=2e-3 * float(p.max()))
    assert np.abs(f @ p @ f.T - p).max() > 0.1 * float(p.max()), "the path would be too short to matter"

    back = jax.jit(propagate_along)(there, path.without_biases(there).reverse(), gravity)
    assert np.abs(there.pos - estimate.pos).max() > 0.1
    for name, atol in (("pos", 5e-5), ("vel", 5e-5), ("quat", 5e-5), ("cov", 2e-3 * float(p.max()))):
        np.testing.assert_allclose(getattr(back, name), getattr(estimate, name), rtol=0, atol=atol, err_msg=name)


def fly(aids, steps):
    """Return 64 worlds after a flight on the estimate in steps of 1 m, integrated by Runge-Kutta."""
    imu = IMU(gyro=GYRO, accel=ACCEL)
    sim = Sim(64, control="state", integrator="rk4", rng_key=2, estimator=ESKF([imu, *aids]))
    for k in range(steps // 500):
        x, y = [(0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5)][k % 4]
        sim.state_control(pos=(x, y, 1.0))
        sim.step(500)
    return sim


@pytest.fixture(scope="module")
def indoor_sim():
    return fly([MotionCapture(noise=POS, angle_noise=ANGLE), GPS(noise=POS, vel_noise=0.02, delay=0.2)], 2000)


def all_errors(sim, name="eskf"):
    """Return the errors of all states, and the covariances. (n_worlds, 15), (n_worlds, 15, 15)"""
    estimate, imu = sim.data.plugins[name].estimate, sim.data.plugins["imu"]
    biases = [imu.accel.bias - estimate.accel_bias, imu.gyro.bias - estimate.gyro_bias]
    error = np.concatenate([errors(sim, name), *(np.asarray(b)[:, 0] for b in biases)], axis=-1)
    return error, np.asarray(error_state.covariance(estimate.cov), np.float64)[:, 0]


@pytest.mark.long("compiles a filter that fuses twelve numbers")
def test_the_errors_have_the_covariance_of_the_filter(indoor_sim):
    """NEES: 15 states, one degree of freedom each."""
    assert_chi_squared(normalised_square(*all_errors(indoor_sim)), 15)
    assert not np.asarray(indoor_sim.data.plugins["eskf"].failures).any()


def test_biases_are_estimated(indoor_sim):
    """After 4 s with 1 cm and 0.02 rad of noise the errors are a fraction of the spread of the biases."""
    error, _ = all_errors(indoor_sim)
    rms = np.sqrt(np.mean(error**2, axis=0))
    assert rms[9:12].max() < 0.1 * 0.2
    assert rms[12:].max() < 0.1 * 0.0175
    measured = indoor_sim.plugins.observations(indoor_sim.data)["eskf.ang_vel"]
    rate_error = np.asarray(measured - indoor_sim.data.states.ang_vel)
    white_noise = 2.4e-4 * np.sqrt(250)  # of one sample at 500 Hz
    assert np.sqrt(np.mean(rate_error**2)) < 1.1 * white_noise


def test_innovations_are_as_the_filter_expects(indoor_sim):
    """NIS: poses that the filter does not use yet, minus predictions, normalised by ``H P H' + R``."""
    record, step = indoor_sim.data.plugins["eskf"], indoor_sim.data.core.steps[0, 0]
    data = ESKF(()).write(indoor_sim.data, record.replace(used_steps=jnp.full_like(record.used_steps, step)))
    data = indoor_sim.step_fn(data, jnp.int32(1))
    estimate, pose = data.plugins["eskf"].estimate, data.plugins["motion_capture"].samples.value[:, 0]
    turn = rotation.multiply(rotation.conjugate(estimate.quat[:, 0]), pose[:, 3:7])
    error = np.concatenate([pose[:, :3] - estimate.pos[:, 0], 2 * turn[:, :3] / turn[:, 3:]], axis=-1)
    rows = [*error_state.POS, *error_state.ATT]
    cov = np.asarray(error_state.covariance(estimate.cov))[:, 0][:, rows][..., rows]
    assert_chi_squared(normalised_square(error, cov + np.diag([POS**2] * 3 + [ANGLE**2] * 3)), 6)


DEVIATIONS = (*[0.1] * 6, *[0.02] * 3, *[0.03] * 3, *[0.002] * 3)
"""Standard deviations at the start of the flights below. Biases are as small as after a calibration; products of errors
are negligible."""
FLOW = [OpticalFlow(noise=0.2), TimeOfFlight(noise=0.005, resolution=None)]


@pytest.mark.long("flies 64 drones on a filter for 4 s")
def test_errors_with_flow_range_and_differences_have_the_covariance_of_the_filter():
    """NEES of the states after a move by 0.4 m from a start with errors, and NIS of the next differences, with
    correlated errors, and ranges along a tilted ray."""
    sim, imu = Sim(64, control="state", integrator="rk4", rng_key=2), IMU(
        gyro=Triad(noise=2.4e-4, bias_spread=DEVIATIONS[-1], random_walk=1e-5),
        accel=Triad(noise=2e-3, bias_spread=DEVIATIONS[9], random_walk=1e-4),
    )  # fmt: skip
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=sim.data.states.pos.at[..., 2].set(1.0)))
    filter_inputs = [imu, *FLOW, UWB(ANCHORS, noise=0.1, tdoa=True)]
    for plugin in (*filter_inputs, ESKF(filter_inputs, control=False)):
        sim.add(plugin)
    sim.state_control(pos=(0.3, 0.3, 1.0))
    sim.step(1)
    s, zero = sim.data.states, jnp.zeros_like(sim.data.states.pos)
    cov = np.diag(np.square(DEVIATIONS))[np.triu_indices(15)].astype(np.float32)
    true = error_state.Estimate(
        s.pos, rotation.rotate_inverse(s.quat, s.vel), s.quat, zero, jnp.tile(cov, (64, 1, 1)), zero, zero
    )
    error = jnp.asarray(np.random.default_rng(3).normal(0.0, DEVIATIONS, (64, 1, 15)), zero.dtype).at[..., 9:].set(0)
    start_estimate = jax.jit(jax.vmap(jax.vmap(add_error)))(true, error)
    record = sim.data.plugins["eskf"]
    sim.data = ESKF(()).write(sim.data, record.replace(estimate=start_estimate))
    sim.step(1999)
    error, cov = all_errors(sim)
    assert_chi_squared(normalised_square(error, cov), 15)
    assert not np.asarray(sim.data.plugins["eskf"].failures).any()

    record, steps = sim.data.plugins["eskf"], sim.data.core.steps[0, 0]
    data = ESKF(()).write(
        sim.data, record.replace(used_steps=jnp.full_like(record.used_steps, steps))
    )  # no measurement is new
    plugins = sim.step_fn(data, jnp.int32(1)).plugins
    values = jnp.concatenate([plugins[name].samples.value[:, 0] for name in ("uwb", "time_of_flight")], axis=-1)

    def predict(state):
        return jnp.concatenate([MEASURED["differences"](state, None), MEASURED["ray"](state, None)])

    state = jax.tree.map(lambda x: x[:, 0], plugins["eskf"].estimate)
    h = jax.jit(jax.vmap(lambda state: jax.jacfwd(lambda e: predict(add_error(state, e)))(jnp.zeros(15))))(state)
    noise = np.zeros((4, 4))
    noise[:3, :3] = 0.1**2 * (np.eye(3) + 1)
    noise[3, 3] = (
        0.005 + 0.0025 * (1 + np.exp(2.92 * (1 - 2.5)))
    ) ** 2 + 0.001**2  # at 1 m, plus the smallest deviation
    innovation = np.asarray(values - jax.vmap(predict)(state), np.float64)
    h, cov = np.asarray(h, np.float64), np.asarray(error_state.covariance(state.cov), np.float64)
    assert_chi_squared(normalised_square(innovation, h @ cov @ h.transpose(0, 2, 1) + noise), 4)


def test_an_impossible_estimate_is_reset(indoor_sim):
    """In world 1 the position is out of bounds, then in world 0 the velocity."""

    def after_a_step(data, **changes):
        record = data.plugins["eskf"]
        data = ESKF(()).write(data, record.replace(estimate=record.estimate.replace(**changes)))
        return indoor_sim.step_fn(data, jnp.int32(1))

    data = after_a_step(indoor_sim.data, pos=indoor_sim.data.plugins["eskf"].estimate.pos.at[1].set(1.1e4))
    record = data.plugins["eskf"]
    assert np.asarray(record.failures)[:3, 0, 0].tolist() == [0, 1, 0]
    assert np.abs(np.asarray(record.estimate.pos)[1]).max() < 20.0
    data = after_a_step(data, vel=record.estimate.vel.at[0, 0, 1].set(-101.0))
    assert np.asarray(data.plugins["eskf"].failures)[:3, 0, 0].tolist() == [1, 1, 0]


class BodyVelocity(Sensor):
    """Velocity of a point of the drone, in the frame of the drone, m/s, as a Doppler radar measures it."""

    noise: Param = param(default=0.02)
    """Standard deviation, m/s. (1,)"""
    pos: Param = param(default=(0.1, 0.2, 0.0), core=(3,))
    """The point, body frame, m. (3,)"""
    name: str = "body_velocity"
    channels: ClassVar = {"vel": 3}
    chains: ClassVar = {"vel": [White("noise")]}

    def ideal(self, data):
        s = data.states
        return rotation.rotate_inverse(s.quat, s.vel) + rotation.cross(s.ang_vel, self.pos)


def test_a_sensor_of_ones_own_is_fused_by_the_derivatives_of_its_ideal(estimate):
    """Gain and covariance are those of a Kalman filter with the derivatives of the measurement."""
    sim = Sim(plugins=[IMU(gyro=GYRO, accel=ACCEL), BodyVelocity()], engine="interpret")
    gyro, measured = jnp.array([0.3, -0.2, 0.1]), jnp.array([1.0, -2.0, 0.5])
    sim.step()
    updated = jax.jit(drone_update)(sim.data, estimate, gyro, measured)

    def measure(error):
        state, pos = add_error(estimate, error), jnp.array([0.1, 0.2, 0.0])
        return state.vel + jnp.cross(gyro - state.gyro_bias, pos)

    h, p = jax.jacfwd(measure)(jnp.zeros(15)), error_state.covariance(estimate.cov)
    gain = p @ h.T @ jnp.linalg.inv(h @ p @ h.T + jnp.diag(0.02**2 + 1e-6 * jnp.sum(h**2, axis=1)))
    correction = gain @ (measured - measure(jnp.zeros(15)))
    np.testing.assert_allclose(updated.vel - estimate.vel, correction[3:6], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(updated.gyro_bias - estimate.gyro_bias, correction[12:], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(error_state.covariance(updated.cov), p - gain @ h @ p, rtol=1e-4, atol=1e-7)


def drone_update(data, estimate, gyro, measured):
    def update(drone):
        imu, sensor = drone.plugins["imu"], drone.plugins["body_velocity"]
        samples = sensor.samples.replace(value=measured, taken_step=jnp.zeros(1, jnp.int32))
        plugins = drone.plugins | {
            "imu": imu.replace(samples=imu.samples.replace(value=jnp.concatenate([gyro, jnp.zeros(3)]))),
            "body_velocity": sensor.replace(samples=samples),
        }
        return update_by_ideal(sensor, imu, drone.replace(plugins=plugins), estimate)

    return jax.tree.map(lambda x: x[0, 0], vmap_worlds(vmap_drones(update))(data))


class TurnedProbe(BodyVelocity):
    """A probe whose error is a rotation, which has no variance in the components of its measurement."""

    name: str = "turned_probe"
    chains: ClassVar = {"vel": [Turned("noise")]}


class OwnError(Link):
    """An error without a variance."""


class UnknownProbe(BodyVelocity):
    name: str = "unknown_probe"
    chains: ClassVar = {"vel": [OwnError()]}


class Clicks(BodyVelocity):
    """A probe of whole metres per second, which have no derivative."""

    name: str = "clicks"

    def ideal(self, data):
        return jnp.round(super().ideal(data))


class RotorProbe(BodyVelocity):
    name: str = "rotor_probe"

    def ideal(self, data):
        return data.states.rotor_vel[:3]


@pytest.mark.parametrize("kind, words", [
    (TurnedProbe, "sensors of the kinds .* got TurnedProbe. .*chains"),
    (UnknownProbe, "sensors of the kinds .* got UnknownProbe. .*chains"),
    (Clicks, "a measurement by Clicks 'clicks' .*pos, vel, quat, ang_vel.* without derivatives. .*ideal"),
    (RotorProbe, "a measurement by RotorProbe 'rotor_probe' .* without derivatives. .*ideal"),
])  # fmt: skip
def test_law_09_sensors_without_a_variance_or_a_slope_are_refused(kind, words):
    with pytest.raises(ConfigError, match=f"expected {words}"):
        Sim(estimator=ESKF([IMU(), kind()]))
