"""The Kalman filter: agreement with the compiled firmware, the distribution of its errors, and flights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import trees_equal
from consistency import assert_chi_squared, errors, normalised_square

from crazysim import Plugin, Sim, rotation
from crazysim.core.random import drone_key
from crazysim.lab.validate import firmware_filters
from crazysim.plugins.estimators import Kalman, error_state
from crazysim.plugins.sensors import IMU, MotionCapture, Triad


@pytest.mark.parametrize("kind", firmware_filters.MEASUREMENT_KINDS)
def test_the_filter_agrees_with_the_compiled_firmware(kind):
    """In fast flights of 4 s, except for the rounding in float32 of 4,000 loops of 1 ms."""
    result, recorded = firmware_filters.kalman_states(kind)
    assert np.ptp(recorded[:, :3], axis=0).max() > (0.01 if kind == "ground" else 1.0), "nothing moved"
    np.testing.assert_allclose(result[:, :9], recorded[:, :9], rtol=0, atol=2e-4)
    np.testing.assert_allclose(result[:, 9:13], recorded[:, 9:13], rtol=0, atol=5e-6)
    np.testing.assert_allclose(result[:, 13:], recorded[:, 13:], rtol=5e-3, atol=5e-8)


class Gusts(Plugin):
    name: str = "gusts"

    def influence(self, data):
        s = data.states
        acc = ACCEL * (data.core.freq / 1000) ** 0.5 * jax.random.normal(drone_key(data, self.name), (3,))
        force = data.params.mass * rotation.rotate(s.quat, acc * jnp.array([1.0, 1.0, 0.0]))
        return data.replace(states=s.replace(force=s.force + force))


ACCEL, GYRO, POS, QUAT = 0.5, 0.1, 0.01, 4.5e-3
"""Standard deviations that the filter assumes: of accelerations along x and y and of rates in 1 ms, and of measured
positions and attitudes."""


@pytest.fixture(scope="module")
def flown_sim():
    """Return 256 worlds after 2 s in which accelerations and sensors have the errors that the filter assumes."""
    density = (2 * 0.001) ** 0.5  # of noise with the standard deviation 1 at 1000 Hz
    imu = IMU(gyro=Triad(noise=GYRO * density), accel=Triad(noise=np.array([ACCEL, ACCEL, 1.0]) * density))
    estimator = Kalman([imu, MotionCapture(noise=POS, angle_noise=QUAT)])
    sim = Sim(256, control="state", rng_key=2, estimator=estimator, plugins=[Gusts()])
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=sim.data.states.pos.at[..., 2].set(1.0)))
    sim.state_control(pos=(0.0, 0.0, 1.0))
    sim.step(1000)
    return sim


def test_the_errors_have_the_covariance_of_the_filter(flown_sim):
    """NEES: squared errors normalised by the covariance are chi-square distributed, one degree for each state."""
    cov = np.asarray(error_state.covariance(flown_sim.data.plugins["kalman"].estimate.cov))[:, 0]
    assert_chi_squared(normalised_square(errors(flown_sim, "kalman"), cov), 9)


def test_innovations_are_as_the_filter_expects(flown_sim):
    """NIS: measurements minus predictions, normalised by ``H P H' + R``, of a pose that the filter does not use yet."""
    record, step = flown_sim.data.plugins["kalman"], flown_sim.data.core.steps[0, 0]
    data = Kalman(()).write(flown_sim.data, record.replace(used_steps=jnp.full_like(record.used_steps, step)))
    data = flown_sim.step_fn(data, jnp.int32(1))
    estimate, (pose,) = data.plugins["kalman"].estimate, (data.plugins["motion_capture"].samples.value[:, 0],)
    turn = rotation.multiply(rotation.conjugate(estimate.quat[:, 0]), pose[:, 3:7])
    error = np.concatenate([pose[:, :3] - estimate.pos[:, 0], 2 * turn[:, :3] / turn[:, 3:]], axis=-1)
    rows = [*error_state.POS, *error_state.ATT]
    cov = np.asarray(error_state.covariance(estimate.cov))[:, 0][:, rows][..., rows]
    assert_chi_squared(normalised_square(error, cov + np.diag([POS**2] * 3 + [QUAT**2] * 3)), 6)


def test_an_impossible_estimate_is_reset(flown_sim):
    record = flown_sim.data.plugins["kalman"]
    pos, vel = record.estimate.pos.at[3].set(101.0), record.estimate.vel.at[5, 0, 1].set(-10.1)
    far = record.replace(estimate=record.estimate.replace(pos=pos, vel=vel))
    assert not record.failures.any()
    after = flown_sim.step_fn(Kalman(()).write(flown_sim.data, far), jnp.int32(1)).plugins["kalman"]
    assert np.flatnonzero(after.failures).tolist() == [3, 5]
    assert np.abs(np.asarray(after.estimate.pos)[3]).max() < 1.1


@pytest.mark.long("compiles two filters")
def test_with_all_axes_of_the_accelerometer_the_filter_fits_any_airframe():
    """Drones feel a constant force of a tenth of their weight, which the firmware's filter does not model."""
    inputs = [IMU(), MotionCapture()]
    filters = [Kalman(inputs, all_axes=x, control=False, name=name) for x, name in ((False, "two"), (True, "all"))]
    sim = Sim(drone=("cf2x_L250", "bumblebee"), control="state", controller="auto", plugins=[*inputs, *filters])
    states, push = sim.data.states, np.ravel(sim.data.params.mass)
    pos, force = states.pos.at[..., 2].set(1.0), states.force.at[..., 0].set(push)
    sim.data = sim.data.replace(states=states.replace(pos=pos, force=force))
    sim.state_control(pos=pos)
    sim.step(2500)
    vel_errors = [np.abs(errors(sim, name, slice(None))[..., 3]) for name in ("two", "all")]
    assert np.all(vel_errors[0] > 0.02)
    assert np.all(vel_errors[1] < 0.1 * vel_errors[0])


def test_one_argument_adds_filter_and_sensors():
    by_argument, by_add = (Sim(n_worlds=2, control="state", rng_key=3, estimator=x) for x in ("kalman", None))
    by_add.add(Kalman([by_add.add(sensor) for sensor in (IMU.crazyflie(), MotionCapture())]))
    assert list(by_argument.plugins) == ["imu", "motion_capture", "kalman"]
    assert list(by_argument.step_pipeline) == list(by_add.step_pipeline)
    assert trees_equal(by_argument.data, by_add.data)


@pytest.mark.parametrize(("controller", "control"), [("crazyflow", True), ("pid", False)])
def test_every_kind_of_controller_flies_on_the_estimate(controller, control):
    """Motion capture is off by 0.1 m: the controller holds the estimate, not the true position."""
    filter_inputs = [IMU(), MotionCapture(pos=(0.1, 0.0, 0.0))]
    estimator = Kalman(filter_inputs, control=control)
    sim = Sim(drone="cf2x_L250", control="state", controller=controller, estimator=estimator)
    sim.state_control(pos=(0.0, 0.0, 0.5))
    sim.step(2000)
    pos = np.asarray(sim.data.states.pos)[0, 0, :2]
    np.testing.assert_allclose(pos, [-0.1 if control else 0.0, 0.0], rtol=0, atol=0.02)
