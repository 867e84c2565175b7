"""The Kalman filter: that of the compiled firmware, honest about its errors, and flown on."""

import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import ConfigError, Sim, rotation
from crazysim.envs import make
from crazysim.plugins.estimators import Kalman, error_state
from crazysim.plugins.sensors import IMU, UWB, Barometer, Lighthouse, MotionCapture, OpticalFlow, TimeOfFlight, Triad

RECORDED = np.load(Path(__file__).with_name("firmware_filter.npz"))
KINDS = sorted({name.split("/")[0] for name in RECORDED.files})
LEVEL = jnp.array([0.0, 0.0, 0.0, 1.0])
ANCHORS = jnp.array([[-3, -3, 0.2], [3, -3, 2.4], [3, 3, 0.2], [-3, 3, 2.4]])
STATION = jnp.array([-2.0, 1.0, 2.2]), jnp.asarray(RECORDED["sweep/frame"])
DIODE = jnp.array([0.015, 0.0075, 0.0])
NOISE = jnp.square(jnp.array([5e-7, 5e-7, 1e-6, 5e-4, 5e-4, 1e-3, 1e-4, 1e-4, 1e-4]))


def measured(kind, k, m, gyro, estimate, rot):
    """Return the estimate after the measurements of a loop, as ``record_filter.py`` takes them."""
    find = error_state
    if kind in ("position", "ground"):
        return find.select(k % 10 == 5, find.update_pos(estimate, m[:3], 0.01), estimate)
    if kind == "pose":
        after = find.update_quat(find.update_pos(estimate, m[:3], 0.01), m[3:7], 0.05)
        return find.select(k % 10 == 0, after, estimate)
    if kind == "flow":
        after = find.update_flow(estimate, rot, 0.1 * m[:2], gyro, 0.01 * 35 / 0.71674, 0.2)
        estimate = find.select(k % 10 == 3, after, estimate)
        return find.select(k % 25 == 10, find.update_range(estimate, rot, m[2], 0.02), estimate)
    if kind == "sweep":
        estimate = find.select(k == 2, find.update_pos(estimate, m[:3], 0.01), estimate)
        for first, tilt in ((0, math.pi / 6), (4, -math.pi / 6)):
            after = find.update_sweep(estimate, rot, DIODE, STATION, tilt, m[0], 0.001)
            estimate = find.select(k % 8 == first, after, estimate)
        return estimate
    a = m[1].astype(int)
    if kind == "distance":
        after = find.update_distance(estimate, ANCHORS[a], m[0], 0.25)
    else:
        after = find.update_difference(estimate, ANCHORS[a], ANCHORS[(a + 1) % 4], m[0], 0.15)
    return find.select(k % 5 == 0, after, estimate)


@pytest.mark.parametrize("kind", KINDS)
def test_the_filter_is_that_of_the_compiled_firmware(kind):
    """In 400 loops of 1 ms: but for rounding of float32, some 20 units in the last place of the largest numbers."""
    inputs = jnp.asarray(RECORDED[f"{kind}/inputs"])

    def loop(carry, x):
        (estimate, rot), (k, row) = carry, x
        accel, gyro, m = row[:3], row[3:6], row[6:]
        predicted = error_state.predict(estimate, accel, gyro, 0.01, LEVEL if kind == "ground" else None)
        estimate = error_state.add_noise(error_state.select(k % 10 == 0, predicted, estimate), NOISE)
        estimate = error_state.finalize(measured(kind, k, m, gyro, estimate, rot))
        state = estimate.pos, estimate.vel, estimate.att_error, jnp.roll(estimate.quat, 1), estimate.cov
        return (estimate, rotation.matrix(estimate.quat)), jnp.concatenate(state)

    start = error_state.start(jnp.array([0.3, -0.2, 1.0]), jnp.zeros(3), LEVEL, (100, 100, 1, *[0.01] * 6))
    run = jax.jit(lambda start, x: jax.lax.scan(loop, (start, jnp.eye(3)), (jnp.arange(1, len(inputs) + 1), x))[1])
    found, recorded = np.asarray(run(start, inputs))[19::20], RECORDED[f"{kind}/outputs"]
    assert np.ptp(recorded[:, :3], axis=0).max() > 1e-3, "nothing moved: the run shows nothing"
    np.testing.assert_allclose(found[:, :9], recorded[:, :9], rtol=0, atol=2e-5)
    np.testing.assert_allclose(found[:, 9:13], recorded[:, 9:13], rtol=0, atol=2e-6)
    np.testing.assert_allclose(found[:, 13:], recorded[:, 13:], rtol=1e-3, atol=1e-8)


def build(*aids, n_worlds=8, imu=None, engine="auto", **settings):
    """Return a simulation at 1 m that flies on the estimate of the given sensors."""
    sim = Sim(n_worlds=n_worlds, control="state", rng_key=2, engine=engine)
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=sim.data.states.pos.at[..., 2].set(1.0)))
    sensors = [sim.add(sensor) for sensor in (imu or IMU.bmi088(), *aids)]
    sim.add(Kalman(sensors, **settings))
    sim.state_control(pos=(0.0, 0.0, 1.0))
    return sim


def errors(sim):
    """Return the errors of position, velocity and attitude, body frame for the last two. (n_worlds, 9)"""
    e, s = sim.data.plugins["kalman"].estimate, sim.data.states
    vel = rotation.rotate_inverse(s.quat, s.vel) - e.vel
    turn = 2 * rotation.multiply(rotation.conjugate(e.quat), s.quat)
    turn = turn[..., :3] * jnp.sign(turn[..., 3:])
    return np.asarray(jnp.concatenate([s.pos - e.pos, vel, turn], axis=-1))[:, 0]


@pytest.fixture(scope="module")
def captured():
    """Return 64 worlds after 2 s in which sensors err exactly as the filter assumes."""
    imu = IMU(gyro=Triad(noise=0.1 * 0.001**0.5), accel=Triad(noise=np.array([0.5, 0.5, 1.0]) * 0.001**0.5))
    sim = build(MotionCapture(noise=0.01, angle_noise=4.5e-3), n_worlds=64, imu=imu)
    sim.step(1000)
    return sim


def test_drones_hover_on_the_estimate(captured):
    """The setpoint is held to some standard deviations of the estimate, here 3 mm with a lag of one prediction."""
    pos = np.asarray(captured.data.states.pos)
    assert np.abs(pos - [0, 0, 1]).max() < 0.05
    assert not captured.data.plugins["kalman"].failures.any()


def test_the_covariance_is_that_of_the_errors(captured):
    """Normalised squared errors have the mean 9 for nine consistent states.

    Here it is 6: of the sideways accelerations that the filter allows for, a hovering drone has nearly none.
    """
    cov = np.asarray(error_state.covariance(captured.data.plugins["kalman"].estimate.cov))[:, 0]
    e = errors(captured)
    nees = np.einsum("wi,wij,wj->w", e, np.linalg.inv(cov), e)
    assert 4 < nees.mean() < 12


def test_controllers_see_the_estimate():
    """An estimate that is 0.3 m off, with no sensor to tell, moves the drone the other way."""
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


def test_an_impossible_estimate_begins_anew():
    sim = build(imu=IMU())
    sim.step(1)
    record = sim.data.plugins["kalman"]
    far = record.replace(estimate=record.estimate.replace(pos=record.estimate.pos.at[3].set(101.0)))
    sim.data = sim.data.replace(plugins=sim.data.plugins | {"kalman": far})
    sim.step(1)
    record = sim.data.plugins["kalman"]
    assert np.asarray(record.failures)[:, 0, 0].tolist() == [0, 0, 0, 1, 0, 0, 0, 0]
    assert np.abs(np.asarray(record.estimate.pos)[3]).max() < 0.01


def test_all_sensors_on_all_engines():
    """Every kind of sensor in one filter gives the same flight on every engine, but for rounding of float32."""
    ends = []
    for engine in ("plain", "fused"):
        aids = [
            MotionCapture(noise=0.01, freq=20, delay=0.01),
            OpticalFlow(noise=0.2),
            TimeOfFlight(freq=25),
            UWB(np.asarray(ANCHORS)[:2], noise=0.1),
            UWB(np.asarray(ANCHORS)[:2], noise=0.1, tdoa=True, name="tdoa"),
            Lighthouse([[-2, -2, 2.5]], [[0, 0.5, 0.8]], noise=4e-4),
        ]
        sim = build(*aids, n_worlds=3, engine=engine)
        sim.step(100)
        ends.append((np.asarray(sim.data.states.pos), errors(sim)))
    assert np.abs(ends[0][1]).max() > 1e-5, "the estimate is the truth"
    for one, other in zip(*ends, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=2e-4)


def test_removal_gives_the_controllers_back():
    sim = build(imu=IMU())
    names = [stage for stage in sim.step_pipeline if not stage.startswith("kalman")]
    sim.remove("kalman")
    assert list(sim.step_pipeline) == names
    sim.step(1)


def test_wrong_sensors_are_refused():
    sim = Sim(control="state")
    imu = sim.add(IMU())
    for sensors, message in (
        ([], "expected one IMU"),
        ([imu, Barometer()], "got Barometer"),
        ([imu, MotionCapture()], "add it before 'kalman'"),
    ):
        with pytest.raises(ConfigError, match=message):
            sim.add(Kalman(sensors))
    with pytest.raises(ConfigError, match="got 'speed'"):
        sim.add(Kalman([imu], deviations={"speed": 1.0}))


def test_a_task_observes_the_estimate():
    """An estimate that is moved, with no sensor to tell, moves the observed position, and not the reward."""
    imu = IMU()
    env = make("hover", n_worlds=4, sensors=[imu, Kalman([imu])])
    state = jax.jit(env.reset)(jax.random.key(0))
    action = jnp.zeros_like(state.action)
    state = env.step(state, action)
    record = state.data.plugins["kalman"]
    moved = record.replace(estimate=record.estimate.replace(pos=record.estimate.pos + 1.0))
    other = state.replace(data=state.data.replace(plugins=state.data.plugins | {"kalman": moved}))
    one, two = env.step(state, action), env.step(other, action)
    np.testing.assert_allclose(two.obs["pos"] - one.obs["pos"], 1.0, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(one.reward, two.reward)
