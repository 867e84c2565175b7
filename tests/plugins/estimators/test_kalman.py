"""The Kalman filter: agreement with the compiled firmware, the distribution of its errors, and flights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from consistency import assert_chi_squared, errors, normalised_square

from crazysim import ConfigError, Plugin, Sim, rotation
from crazysim.core.random import drone_key
from crazysim.envs import make
from crazysim.lab.validate import firmware_filters
from crazysim.plugins.estimators import Kalman, error_state, updates
from crazysim.plugins.sensors import IMU, Barometer, MotionCapture, Triad


@pytest.mark.parametrize("kind", firmware_filters.MEASUREMENT_KINDS)
def test_the_filter_agrees_with_the_compiled_firmware(kind):
    """In fast flights of 4 s, except for the rounding in float32 of 4,000 loops of 1 ms."""
    result, recorded = firmware_filters.kalman_states(kind)
    assert np.ptp(recorded[:, :3], axis=0).max() > (0.01 if kind == "ground" else 1.0), "nothing moved"
    np.testing.assert_allclose(result[:, :9], recorded[:, :9], rtol=0, atol=2e-4)
    np.testing.assert_allclose(result[:, 9:13], recorded[:, 9:13], rtol=0, atol=5e-6)
    np.testing.assert_allclose(result[:, 13:], recorded[:, 13:], rtol=5e-3, atol=5e-8)


def test_flow_is_two_updates_from_one_prediction(x64):
    """Both updates use the innovations of the first estimate. The second gain uses the covariance after the first."""
    rng = np.random.default_rng(1)
    root = 0.3 * rng.normal(size=(9, 9))
    level, vel = jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.array([3.0, -2.0, 0.5])
    before = error_state.initial_estimate(jnp.array([0.3, -0.2, 0.8]), vel, level, [1.0] * 9)
    before = before.replace(cov=jnp.asarray(root @ root.T)[np.triu_indices(9)])
    rot, flow, gyro = np.diag([1.0, 1.0, 0.9]), np.array([2.5, -3.0]), np.array([0.7, -0.4, 0.1])
    scale, variance = 0.49, 0.2**2

    x, p = np.concatenate([before.pos, before.vel, np.zeros(3)]), root @ root.T
    rate = 0.9 / 0.8
    innovations = flow - scale * (vel[:2] * rate + np.array([-gyro[1], gyro[0]]))
    for k in range(2):
        h = np.zeros(9)
        h[2], h[3 + k] = -scale * vel[k] * rate / 0.8, scale * rate
        gain = p @ h / (h @ p @ h + variance)
        x, p = x + gain * innovations[k], p - np.outer(gain, h @ p)
    after = jax.jit(updates.update_flow)(before, jnp.asarray(rot), flow, gyro, jnp.asarray(scale), 0.2)
    np.testing.assert_allclose(jnp.concatenate([after.pos, after.vel, after.att_error]), x, rtol=0, atol=1e-12)
    np.testing.assert_allclose(error_state.covariance(after.cov), p, rtol=0, atol=1e-12)


def build(*aids, n_worlds=8, imu=None, engine="auto", **settings):
    """Return a simulation at 1 m that is controlled by the estimate from these sensors."""
    sim = Sim(n_worlds=n_worlds, control="state", rng_key=2, engine=engine)
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=sim.data.states.pos.at[..., 2].set(1.0)))
    sensors = [sim.add(sensor) for sensor in (imu or IMU.bmi088(), *aids)]
    sim.add(Kalman(sensors, **settings))
    sim.state_control(pos=(0.0, 0.0, 1.0))
    return sim


class Gusts(Plugin):
    """White accelerations along x and y of the body, of the size that the filter assumes."""

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
    sim = build(MotionCapture(noise=POS, angle_noise=QUAT), n_worlds=256, imu=imu)
    sim.add(Gusts())
    sim.step(1000)
    return sim


def test_drones_hover_on_the_estimate(flown_sim):
    """In gusts they hold the setpoint to some standard deviations of the estimate, which is about 3 mm."""
    pos = np.asarray(flown_sim.data.states.pos)
    assert np.abs(pos - [0, 0, 1]).max() < 0.1
    assert not flown_sim.data.plugins["kalman"].failures.any()


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


def test_controllers_use_the_estimate():
    """Without a sensor of the position, an estimate that is 0.3 m off moves the drone the other way."""
    for control, low, high in ((True, -0.3, -0.05), (False, -0.01, 0.01)):
        sim = build(imu=IMU(), control=control)
        sim.step(1)
        record = sim.data.plugins["kalman"]
        pos = record.estimate.pos.at[..., 0].add(0.3)
        record = record.replace(estimate=record.estimate.replace(pos=pos))
        sim.data = sim.data.replace(plugins=sim.data.plugins | {"kalman": record})
        sim.step(500)
        x = np.asarray(sim.data.states.pos)[..., 0]
        assert low < x.min()
        assert x.max() < high


def test_an_impossible_estimate_is_reset():
    sim = build(imu=IMU())
    sim.step(1)
    record = sim.data.plugins["kalman"]
    pos, vel = record.estimate.pos.at[3].set(101.0), record.estimate.vel.at[5, 0, 1].set(-10.1)
    far = record.replace(estimate=record.estimate.replace(pos=pos, vel=vel))
    sim.data = sim.data.replace(plugins=sim.data.plugins | {"kalman": far})
    sim.step(1)
    record = sim.data.plugins["kalman"]
    assert np.asarray(record.failures)[:, 0, 0].tolist() == [0, 0, 0, 1, 0, 1, 0, 0]
    assert np.abs(np.asarray(record.estimate.pos)[3]).max() < 0.01


@pytest.mark.long("compiles two filters")
def test_with_all_axes_of_the_accelerometer_the_filter_fits_any_airframe():
    """Drones feel a constant force of a tenth of their weight, which the firmware's filter does not model."""
    vel_errors = []
    for all_axes in (False, True):
        estimator = Kalman([IMU(), MotionCapture()], all_axes=all_axes, control=False)
        sim = Sim(drone=("cf2x_L250", "bumblebee"), control="state", controller="auto", estimator=estimator)
        states, push = sim.data.states, np.ravel(sim.data.params.mass)
        pos, force = states.pos.at[..., 2].set(1.0), states.force.at[..., 0].set(push)
        sim.data = sim.data.replace(states=states.replace(pos=pos, force=force))
        sim.state_control(pos=pos)
        sim.step(2500)
        s, estimate = sim.data.states, sim.data.plugins["kalman"].estimate
        vel_errors.append(np.abs(np.asarray(rotation.rotate_inverse(s.quat, s.vel) - estimate.vel)[0, :, 0]))
    assert np.all(vel_errors[0] > 0.02)
    assert np.all(vel_errors[1] < 0.1 * vel_errors[0])


def test_removal_restores_the_controllers():
    sim = build(imu=IMU())
    names = [stage for stage in sim.step_pipeline if not stage.startswith("kalman")]
    sim.remove("kalman")
    assert list(sim.step_pipeline) == names
    sim.step(1)


def test_one_argument_adds_filter_and_sensors():
    """The flight equals that with added plugins, bit for bit, and controllers fly on the estimate."""
    sims = [
        Sim(n_worlds=2, control="state", rng_key=3, estimator="kalman"),
        Sim(n_worlds=2, control="state", rng_key=3),
    ]
    added = [sims[1].add(sensor) for sensor in (IMU.crazyflie(), MotionCapture())]
    sims[1].add(Kalman(added))
    for sim in sims:
        sim.state_control(pos=(0.2, 0.0, 0.5))
        sim.step(1000)
    by_argument, by_add = (np.asarray(sim.data.states.pos) for sim in sims)
    assert list(sims[0].plugins) == ["imu", "motion_capture", "kalman"]
    np.testing.assert_array_equal(by_argument, by_add)
    assert np.abs(by_argument - [0.2, 0.0, 0.5]).max() < 0.05
    assert np.ptp(by_argument, axis=0).max() > 1e-5, "estimates differ between worlds"


@pytest.mark.parametrize("controller", ["pid", "crazyflow"])
def test_every_kind_of_controller_flies_on_the_estimate(controller):
    """Motion capture is off by 0.1 m: the controller holds the estimate, not the true position."""
    estimator = Kalman([IMU(), MotionCapture(pos=(0.1, 0.0, 0.0))])
    sim = Sim(drone="cf2x_L250", control="state", controller=controller, estimator=estimator)
    sim.state_control(pos=(0.0, 0.0, 0.5))
    sim.step(2000)
    np.testing.assert_allclose(np.asarray(sim.data.states.pos)[0, 0, :2], [-0.1, 0.0], rtol=0, atol=0.02)


def test_a_task_flies_and_observes_with_one_argument():
    env = make("hover", n_worlds=4, estimator=Kalman([IMU(), MotionCapture(pos=(0.1, 0.0, 0.0))]), engine="interpret")
    state = jax.jit(env.reset)(jax.random.key(0))
    state = env.step(state, jnp.zeros_like(state.action))
    result = np.asarray(state.data.plugins["kalman"].estimate.pos - state.data.states.pos)
    np.testing.assert_allclose(np.linalg.norm(result, axis=-1), 0.1, rtol=0, atol=0.01)
    assert env.measure_states is not None


def test_unknown_estimators_are_refused():
    for wrong in ("ekf", Kalman, 3):
        with pytest.raises(ConfigError, match="expected an estimator as one of 'kalman'"):
            Sim(estimator=wrong)


def test_wrong_sensors_are_refused():
    sim = Sim(control="state")
    imu = sim.add(IMU())
    for sensors, message in (
        ([], "expected one IMU"),
        ([imu, Barometer()], "got Barometer"),
        ([imu, MotionCapture()], r"named 'motion_capture'.*Use sim\.add"),
    ):
        with pytest.raises(ConfigError, match=message):
            sim.add(Kalman(sensors))
    for wrong in (imu, "imu", ["imu"]):
        with pytest.raises(ConfigError, match=r"expected sensors as a list, got .*Use Kalman\(\[IMU\(\), MotionCap"):
            Kalman(wrong)
    with pytest.raises(ConfigError, match="got 'speed'"):
        sim.add(Kalman([imu], deviations={"speed": 1.0}))


def test_a_task_observes_the_estimate():
    """Without a sensor of the position, an estimate that is moved moves the observed position, and not the reward."""
    imu = IMU()
    env = make("hover", n_worlds=4, sensors=[imu, Kalman([imu])], engine="interpret")
    state = jax.jit(env.reset)(jax.random.key(0))
    action = jnp.zeros_like(state.action)
    state = env.step(state, action)
    record = state.data.plugins["kalman"]
    moved = record.replace(estimate=record.estimate.replace(pos=record.estimate.pos + 1.0))
    moved_state = state.replace(data=state.data.replace(plugins=state.data.plugins | {"kalman": moved}))
    after, after_move = env.step(state, action), env.step(moved_state, action)
    np.testing.assert_allclose(after_move.obs["pos"] - after.obs["pos"], 1.0, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(after.reward, after_move.reward)
