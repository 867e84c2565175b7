"""The inertial measurement unit: rigid-body kinematics, errors by hand, and the Allan deviation of its noise."""

import allantools
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import hover_rotor_state, with_states

from crazysim import IMU, Sim, rotation
from crazysim.engine.stage import vmap_drones, vmap_worlds
from crazysim.plugins.sensors import Triad
from crazysim.plugins.sensors.imu import STANDARD_GRAVITY, specific_force

DEGREE = np.pi / 180


def build(imu, n_worlds=1, n_drones=1, **settings):
    sim = Sim(n_worlds, n_drones, control="rotor_vel", engine="interpret", rng_key=7, **settings)
    sim.data = with_states(sim.data, pos=[0, 0, 10.0])
    sim.build_default_data()
    return sim, sim.add(imu)


def read(sim, name="accel"):
    return np.asarray(sim.plugins.observations(sim.data)[f"imu.{name}"])


def test_specific_force_is_the_second_derivative_of_the_position(x64):
    """Against differentiation of p(t) = c(t) + R(t) r, for a turn with an angular acceleration about a fixed axis."""
    axis, r, g = jnp.array([0.6, 0.0, 0.8]), jnp.array([0.02, -0.05, 0.03]), jnp.array([0.0, 0.0, -9.81])

    def quat(t):
        angle = 0.3 + 2.0 * t + 1.5 * t**2
        return jnp.concatenate([jnp.sin(angle / 2) * axis, jnp.cos(angle / 2)[None]])

    def position(t, r):
        centre = jnp.array([1.0, 2.0, -0.5]) * t**2 + jnp.array([0.0, 0.3, 0.0]) * t**3
        return centre + rotation.rotate(quat(t), r)

    t = jnp.asarray(0.7)

    @jax.jit
    def expected_and_found(t):
        acc = jax.jacfwd(jax.jacfwd(position))
        expected = rotation.rotate_inverse(quat(t), acc(t, r) - g)
        ang_vel, ang_acc = (2.0 + 3.0 * t) * axis, 3.0 * axis
        return expected, specific_force(quat(t), acc(t, 0 * r), ang_vel, ang_acc, g, r)

    expected, result = expected_and_found(t)
    np.testing.assert_allclose(result, expected, atol=1e-12)
    assert np.linalg.norm(result - specific_force(quat(t), jnp.zeros(3), 0 * r, 0 * r, g, r)) > 1


def test_accelerations_in_hover_in_a_fall_and_at_rest():
    """9.81 m/s^2 upwards where the floor or the rotors carry the drone; zero in a fall, except for the drag."""
    sim, _ = build(IMU(), 3)
    pos = np.array([10.0, 10.0, -0.001])[:, None, None] * [0, 0, 1]
    speed = hover_rotor_state(sim.data) * np.array([1.0, 0.0, 0.0])[:, None, None]
    sim.data = with_states(sim.data, pos=pos, rotor_vel=speed)
    sim.rotor_vel_control(speed)
    sim.step()
    np.testing.assert_allclose(read(sim)[:, 0], [[0, 0, 9.81], [0, 0, 0], [0, 0, 9.81]], atol=2e-4)  # float32
    np.testing.assert_array_equal(read(sim, "gyro"), 0)


def test_lever_arm_and_mounting_by_hand():
    """In a fall at 10 rad/s about z a point 2 cm ahead accelerates inwards by 2 m/s^2. The sensor is turned by 90
    degrees about z: the body's x axis is its -y axis."""
    sim, imu = build(IMU(pos=(0.02, 0, 0), rpy=(0, 0, np.pi / 2)))
    sim.data = with_states(sim.data, ang_vel=[0, 0, 10.0])
    sim.step()
    np.testing.assert_allclose(read(sim)[0, 0], [0, 2, 0], atol=2e-3)  # the rotation slows down by drag
    sim.data = with_states(sim.data, ang_vel=[3.0, 0, 10.0])
    sim.step()
    np.testing.assert_allclose(read(sim, "gyro")[0, 0], [0, -3, 10], atol=0.1)  # a turning body's axes
    measured = vmap_worlds(vmap_drones(lambda drone: imu.measured_states(drone)["ang_vel"]))(sim.data)
    np.testing.assert_allclose(measured, sim.data.states.ang_vel, atol=1e-5)


def test_errors_by_hand():
    """Scale 10 %, bias, and a misalignment of 0.01 rad about x, which turns 9.81 of z into -y; limit and resolution."""
    errors = Triad(
        scale=(0.1, 0.1, 0.0), bias=(0.3, 0.0, 0.0), misalignment=(0.01, 0.0, 0.0), resolution=0.05, limit=9.5
    )
    sim, _ = build(IMU(accel=errors, gyro=Triad(limit=1.0)))
    sim.data = with_states(sim.data, pos=[0, 0, -0.001], ang_vel=0.0)
    sim.step()
    np.testing.assert_allclose(read(sim)[0, 0], [0.3, 0.1, 9.5], atol=1e-6)  # 0.1 = 1.1 * 0.0981, rounded
    sim.data = with_states(sim.data, pos=[0, 0, 9.0], ang_vel=[0.5, -4.0, 4.0])
    sim.step()
    np.testing.assert_allclose(read(sim, "gyro")[0, 0], [0.5, -1, 1], atol=5e-2)  # a turning body's axes


def test_the_low_pass_has_the_step_response_of_first_order():
    sim, _ = build(IMU(gyro=Triad(bandwidth=20.0)))
    sim.step()
    sim.data = with_states(sim.data, ang_vel=[0, 0, 1.0])
    result = []
    for _ in range(10):
        sim.data = with_states(sim.data, ang_vel=[0, 0, 1.0])
        sim.step()
        result.append(read(sim, "gyro")[0, 0, 2])
    expected = 1 - np.exp(-2 * np.pi * 20 * np.arange(1, 11) / sim.freq)
    np.testing.assert_allclose(result, expected, rtol=1e-3)  # drag of one step


def test_each_episode_draws_new_errors():
    spread = Triad(bias=0.2, bias_spread=0.1, scale_spread=0.03, misalignment_spread=0.02)
    sim, imu = build(IMU(gyro=spread), 1000, 2)
    sim.step(2)
    first = imu.read(sim.data).gyro
    for name, mean, deviation in (("bias", 0.2, 0.1), ("scale", 0, 0.03), ("misalignment", 0, 0.02)):
        x = np.asarray(getattr(first, name))
        np.testing.assert_allclose(x.mean(), mean, atol=4 * deviation / np.sqrt(x.size))
        np.testing.assert_allclose(x.std(), deviation, rtol=4 / np.sqrt(2 * x.size))
    sim.step(3)
    np.testing.assert_array_equal(imu.read(sim.data).gyro.bias, first.bias)
    sim.reset(np.arange(1000) < 500)
    sim.step()
    redrawn = np.asarray(imu.read(sim.data).gyro.bias)
    np.testing.assert_array_equal(redrawn[500:], first.bias[500:])
    assert abs(np.corrcoef(redrawn[:500].ravel(), np.asarray(first.bias)[:500].ravel())[0, 1]) < 4 / np.sqrt(3000)


def test_an_unbalanced_rotor_shakes_at_its_own_frequency():
    """One rotor at 16000 rpm with an imbalance b: b w^2 / m in the plane of the rotors, and J^-1 (r x b w) about z."""
    imbalance, speed = 1e-8, 16000.0
    sim, imu = build(IMU(imbalance=[imbalance, 0, 0, 0]), freq=5000)
    speeds = np.full((1, 1, 4), speed)
    sim.data = with_states(sim.data, rotor_vel=speeds)
    sim.rotor_vel_control(speeds)
    accel, gyro = [], []
    for _ in range(300):
        sim.step()
        accel.append(read(sim)[0, 0])
        gyro.append(read(sim, "gyro")[0, 0])
    omega = speed * 2 * np.pi / 60
    t = np.arange(300) / 5000

    def amplitude(x):
        basis = np.stack([np.cos(omega * t), np.sin(omega * t), np.ones_like(t), t], axis=-1)
        c, s = np.linalg.lstsq(basis, np.asarray(x, float), rcond=None)[0][:2]
        return np.hypot(c, s)

    expected = imbalance * omega**2 / 0.0434
    np.testing.assert_allclose(amplitude(np.array(accel)[:, :2]), expected, rtol=0.01)  # drift of the motion
    p = sim.data.params
    arm = np.asarray(imu.read(sim.data).rotor_pos)[0]
    swing = np.linalg.norm(arm[:2]) * imbalance * omega * float(p.J_inv[2, 2])
    np.testing.assert_allclose(amplitude(np.array(gyro)[:, 2]), swing, rtol=0.02)


N, FREQ = 20_000, 100
"""Number of samples at rest, and their rate, Hz."""
NOISE, RANDOM_WALK, INSTABILITY, CORRELATION_TIME = 0.02, 0.01, 0.05, 0.5


@pytest.fixture(scope="module")
def measurements_at_rest():
    """Return measurements of gyroscope and accelerometer at rest for 200 s, with white noise in a third of the drones,
    a random walk of the bias in another third, and a Gauss-Markov bias in the last third. (3 kinds, n_channels, N)"""
    n = 12
    kind = np.repeat(np.eye(3)[:, :, None, None], n, axis=2)  # of each error: (3 kinds, n, 1)
    noise, walk, wander = (np.broadcast_to(k.reshape(3 * n, 1, 1), (3 * n, 1, 3)) for k in kind)
    errors = Triad(
        noise=NOISE * noise,
        random_walk=RANDOM_WALK * walk,
        instability=INSTABILITY * wander,
        correlation_time=CORRELATION_TIME,
    )
    sim = Sim(3 * n, control="rotor_vel", freq=FREQ, engine="plain", rng_key=5)
    sim.data = with_states(sim.data, pos=[0, 0, -0.001])
    sim.add(IMU(gyro=errors, accel=errors))
    names = ("imu_before", "imu_begin", "imu", "increment_steps")

    @jax.jit
    def run(data):
        def sample(data, _):
            for name in names:
                data = sim.step_pipeline[name](data)
            return data, data.plugins["imu"].samples.value[:, 0]

        return jax.lax.scan(sample, data, length=N)[1]

    x = np.asarray(run(sim.data), np.float64) - [0, 0, 0, 0, 0, 9.81]
    return np.moveaxis(x.reshape(N, 3, n * 6), 0, -1)


def expected_deviation(kind, t):
    if kind == 0:
        return NOISE / np.sqrt(2 * t)
    if kind == 1:  # sampled: 1/3 + 1/(6 m^2) in place of 1/3
        return RANDOM_WALK * np.sqrt(t * (1 / 3 + 1 / (6 * (t * FREQ) ** 2)))
    x = CORRELATION_TIME / t
    return INSTABILITY * np.sqrt(2 * x * (1 - x / 2 * (3 - 4 * np.exp(-1 / x) + np.exp(-2 / x))))


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_the_allan_deviation_agrees_with_the_parameters(measurements_at_rest, kind):
    times = np.array([0.01, 0.1, 0.5, 0.95, 2.0, 10.0])[1 if kind == 2 else 0 :]
    variance = [np.square(allantools.oadev(x, FREQ, "freq", times)[1]) for x in measurements_at_rest[kind]]
    result = np.sqrt(np.mean(variance, axis=0))
    # Each channel has about N / (FREQ t) independent differences: four standard errors of a mean square, halved by the
    # root. Ten samples of the process in 0.1 s differ from their integral by less than 1 %.
    tolerance = 4 * 0.5 * np.sqrt(2 / (len(variance) * N / (FREQ * times)) * 1.5) + 0.01
    assert np.all(np.abs(result / expected_deviation(kind, times) - 1) < tolerance)
    assert tolerance.max() < 0.2
    if kind == 2:  # the largest deviation of a Gauss-Markov bias, as the docstring of Triad says
        np.testing.assert_allclose(result[2], 0.618 * INSTABILITY, rtol=tolerance[2])


def test_presets_have_the_numbers_of_their_data_sheets():
    """Their densities agree with their root mean squares, such as 0.1 degrees/s within 47 Hz for the BMI088."""
    assert abs(IMU.bmi088().gyro.noise * np.sqrt(47) / DEGREE - 0.1) < 0.005
    assert abs(IMU.mpu9250().gyro.noise * np.sqrt(92) / DEGREE - 0.1) < 0.005
    assert abs(IMU.mpu6050().gyro.noise * np.sqrt(100) / DEGREE - 0.05) < 0.005
    assert abs(IMU.icm42688p().gyro.noise / DEGREE - 2.8e-3) < 1e-6
    fast, _ = build(IMU.icm42688p())
    fast.data = with_states(fast.data, ang_vel=[40.0, 0, 0])
    fast.step(5)
    assert abs(read(fast, "gyro").max() / DEGREE - 2000) < 0.1, "its range of 34.9 rad/s, within a step of its 16 bits"
    np.testing.assert_allclose(IMU.bmi088().accel.noise / STANDARD_GRAVITY, [160e-6, 160e-6, 190e-6])
    sim, _ = build(IMU.bmi088(gyro=Triad(), pos=(0.01, 0, 0)), 400)
    sim.data = with_states(sim.data, pos=[0, 0, -0.001])
    sim.step()
    spread = (read(sim)[:, 0] - [0, 0, 9.81]).std(axis=0)
    np.testing.assert_allclose(spread, 20e-3 * STANDARD_GRAVITY, rtol=4 / np.sqrt(2 * 400) + 0.01)
    lsb = read(sim) / (24 * STANDARD_GRAVITY / 32768)
    np.testing.assert_allclose(lsb, np.round(lsb), atol=1e-3)
    assert not read(sim, "gyro").any()
