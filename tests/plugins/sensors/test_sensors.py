"""Sensors by hand, and the statistics of their errors over many drones."""

import jax
import numpy as np
from cases import hover_rotor_state, with_states

from crazysim import Battery, Plugin, RangeFinder, Sim, rotation
from crazysim.envs import make
from crazysim.plugins import sensors
from crazysim.plugins.sensors.barometer import pressure_altitude, pressure_at
from crazysim.plugins.sensors.beacons import SWEEP_TILTS, sweep_angle

N = 2000
"""Number of worlds for statistics."""


def build(*plugins, n_worlds=1, n_drones=1, **states):
    sim = Sim(n_worlds, n_drones, control="rotor_vel", engine="interpret", rng_key=4)
    sim.data = with_states(sim.data, **({"pos": [0, 0, 1.0]} | states))
    sim.build_default_data()
    for plugin in plugins:
        sim.add(plugin)
    return sim


def read(sim, name):
    return np.asarray(sim.plugins.observations(sim.data)[name], np.float64)


def std_tolerance(n):
    """Return the relative tolerance of a standard deviation of n numbers: four of its standard errors."""
    return 4 / np.sqrt(2 * n)


def test_motion_capture_has_its_noise_and_offsets():
    quat = np.float32([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])  # yaw 90 degrees
    plugin = sensors.MotionCapture(2e-3, 0.01, pos=(0.1, 0, 0), rpy=(0, 0, 0.2))
    sim = build(plugin, n_worlds=N, quat=quat, vel=[1.0, 0, 0])
    sim.step()
    s = sim.data.states
    tracked_pos = np.asarray(s.pos)[:, 0] + [0.0, 0.1, 0.0]
    pos, attitude = read(sim, "motion_capture.pos")[:, 0], read(sim, "motion_capture.quat")[:, 0]
    np.testing.assert_allclose((pos - tracked_pos).std(axis=0), 2e-3, rtol=std_tolerance(N))
    np.testing.assert_allclose((pos - tracked_pos).mean(axis=0), 0, atol=4 * 2e-3 / np.sqrt(N))
    np.testing.assert_allclose(np.linalg.norm(attitude, axis=-1), 1, atol=1e-6)
    true = jax.jit(lambda q: rotation.multiply(q, rotation.from_rpy(np.float32([0, 0, 0.2]))))(s.quat[:, 0])
    turn = 2 * np.asarray(jax.jit(lambda a, b: rotation.multiply(rotation.conjugate(a), b))(true, attitude))[:, :3]
    np.testing.assert_allclose(turn.std(axis=0), 0.01, rtol=std_tolerance(N))


def test_motion_capture_differentiates_positions():
    """A constant velocity is measured at once. The low-pass leaves 2 a^2 / (2 - a) of the variance of the positions
    over the interval squared; without it differences of white noise have 2."""
    sim = build(sensors.MotionCapture(), vel=[3.0, 0, 0])
    sim.step(21)
    vel = read(sim, "motion_capture.vel")[0, 0]
    np.testing.assert_allclose(vel[0], 3.0, atol=0.1)  # drag
    sim = build(sensors.MotionCapture(1e-3, bandwidth=10.0), n_worlds=N, vel=[3.0, 0, 0])
    sim.step(101)
    noise = read(sim, "motion_capture.vel")[:, 0, 1:2].std()
    a = 1 - np.exp(-2 * np.pi * 10 / 100)
    np.testing.assert_allclose(noise, 1e-3 * 100 * np.sqrt(2 * a**2 / (2 - a)), rtol=std_tolerance(N))


def test_optical_flow_by_hand():
    """1 m/s ahead 0.5 m above ground is 2 rad/s; so is a pitch rate of -2 rad/s; 35 / 0.71674 pixels a radian."""
    pixels = 35 / 0.71674 / 500
    level, pitched, turned = (0, 0, 0, 1), (0, np.sin(0.25), 0, np.cos(0.25)), (1, 0, 0, 0)
    pos, quat, vel, ang_vel, expected = zip(
        ((0, 0, 0.5), level, (1, 0, 0), (0, 0, 0), (2, 0)),
        ((0, 0, 2), level, (1, 0.4, 0), (0, 0, 0), (0.5, 0.2)),
        ((0, 0, 1), level, (0, 0, 0), (3, -2, 0), (2, 3)),
        ((0, 0, 1), pitched, (1, 0, 0), (0, 0, 0), (np.cos(0.5) ** 2, 0)),
        ((0, 0, 1), turned, (1, 0, 0), (0, 0, 0), (0, 0)),
        strict=True,
    )
    states = {"pos": pos, "quat": quat, "vel": vel, "ang_vel": ang_vel}
    states = {name: np.array(x, float)[:, None] for name, x in states.items()}
    sim = build(sensors.OpticalFlow(freq=None), n_worlds=5, **states)
    sim.step()
    flow = read(sim, "optical_flow.flow")[:, 0]
    np.testing.assert_allclose(flow, pixels * np.array(expected), rtol=0.05, atol=1e-4)  # the motion of one step
    sim = build(sensors.OpticalFlow(0.3, resolution=0.1), n_worlds=N)
    sim.step()
    result = read(sim, "optical_flow.flow")
    np.testing.assert_allclose(result.std(), np.sqrt(0.3**2 + 0.1**2 / 12), rtol=std_tolerance(2 * N))
    np.testing.assert_allclose(result / 0.1, np.round(result / 0.1), atol=1e-4)


MOUNTED = {
    # yaw 90 degrees: the body's x axis is the world's y axis, and a place 0.2 m ahead is at (0, 0.2, 1)
    "gps.pos": (sensors.GPS(pos=(0.2, 0, 0), freq=None), [0, 0.2, 1]),
    # it turns about z at 2 rad/s: 0.4 m/s to the left, the world's -x; and 3 rad/s about x moves nothing ahead
    "gps.vel": (None, [-0.4, 0, 0]),
    # from (0, 0.2, 1) to (0, 2.2, 1) and (1.5, 0.2, 3)
    "uwb.distance": (sensors.UWB([(0, 2.2, 1), (1.5, 0.2, 3)], pos=(0.2, 0, 0), freq=None), [2.0, 2.5]),
    # 0.3 m below the centre of mass, 0.7 m above ground
    "time_of_flight.distance": (sensors.TimeOfFlight(pos=(0, 0, -0.3), far_noise=0.0, freq=None), [0.7]),
    # 0.2 m ahead the camera moves at 0.4 m/s to the left, 0.4 rad/s; the roll adds 3 rad/s; 35 / 0.71674 / 500 pixels
    "ahead.flow": (sensors.OpticalFlow(pos=(0.2, 0, 0), freq=None, name="ahead"), [0, 3.4 * 35 / 0.71674 / 500]),
    # 0.5 m below, a roll rate of 3 rad/s moves it at 1.5 m/s to the left, 3 rad/s over 0.5 m of height
    "below.flow": (sensors.OpticalFlow(pos=(0, 0, -0.5), freq=None, name="below"), [0, 6 * 35 / 0.71674 / 500]),
    # north is ahead of the drone; a sensor turned by 90 degrees about x has the body's z axis as its y axis
    "magnetometer.field": (sensors.Magnetometer((0, 2e-5, -4e-5), rpy=(np.pi / 2, 0, 0)), [2e-5, -4e-5, 0]),
}
"""Sensor and expected measurement by the name of the observation."""


def test_mounting_by_hand():
    """Yaw 90 degrees, turning at (3, 0, 2) rad/s; the motion of one step: 6 mrad, and 2 cm/s of fall."""
    plugins = [plugin for plugin, _ in MOUNTED.values() if plugin]
    sim = build(*plugins, quat=[0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)], ang_vel=[3.0, 0, 2.0])
    sim.step()
    for name, (_, expected) in MOUNTED.items():
        scale = np.abs(expected).max()
        np.testing.assert_allclose(read(sim, name)[0, 0], expected, rtol=0.02, atol=0.06 * scale, err_msg=name)


def test_time_of_flight_by_hand():
    """Height over the cosine of the tilt up to the range; noise grows as the firmware's filter assumes."""
    angle = np.array([0, 0.5, 0.5, 3.0])[:, None, None]
    quat = np.concatenate([np.sin(angle / 2), 0 * angle, 0 * angle, np.cos(angle / 2)], axis=-1)
    pos = np.array([1.0, 1.0, 3.9, 1.0])[:, None, None] * [0, 0, 1]
    sim = build(sensors.TimeOfFlight(far_noise=0.0, freq=None), n_worlds=4, pos=pos, quat=quat)
    sim.step()
    result = read(sim, "time_of_flight.distance")[:, 0, 0]
    np.testing.assert_allclose(result, [1, 1 / np.cos(0.5), 4, 4], atol=1e-3)  # the motion of one step, and rounding
    heights = np.array([0.5, 2.5, 3.5])
    pos = np.tile(heights, N)[:, None, None] * [0, 0, 1]
    sim = build(sensors.TimeOfFlight(0.01, resolution=None), n_worlds=3 * N, pos=pos)
    sim.step()
    deviation = 0.01 + 0.0025 * (1 + 80 ** ((heights - 2.5) / 1.5))
    distance = read(sim, "time_of_flight.distance").reshape(N, 3)
    np.testing.assert_allclose(distance.std(axis=0), deviation, rtol=std_tolerance(N) + 0.01)
    assert np.all(np.abs(distance.mean(axis=0) - heights) < 4 * deviation / np.sqrt(N) + 1e-3)


def test_the_standard_atmosphere():
    """ISO 2533:1975: 89874.6 Pa at 1000 m and 54019.9 Pa at 5000 m of geopotential altitude."""
    with jax.enable_x64(True):
        pressure = pressure_at(np.array([0.0, 1000.0, 5000.0]))
        np.testing.assert_allclose(pressure, [101325, 89874.6, 54019.9], atol=0.1)
        np.testing.assert_allclose(pressure_altitude(pressure), [0, 1000, 5000], atol=1e-9)


def test_barometer_has_its_errors():
    plugin = sensors.Barometer(noise=2.0, altitude=400.0, freq=100)
    sim = build(plugin, n_worlds=N, pos=[0, 0, 10.0])
    sim.step()
    pressure, height = read(sim, "barometer.pressure"), read(sim, "barometer.height")
    np.testing.assert_allclose(pressure.std(), 2.0, rtol=std_tolerance(N))
    np.testing.assert_allclose(pressure.mean(), pressure_at(410.0), atol=4 * 2.0 / np.sqrt(N) + 0.02)
    slope = 96500 * 9.80665 * 0.0289644 / 8.31432 / (288.15 - 2.665)  # p g M / (R T) at 410 m, Pa/m
    np.testing.assert_allclose((height - 10).std(), 2.0 / slope, rtol=std_tolerance(N) + 0.01)

    drifting = sensors.Barometer(drift=5.0, drift_time=0.1, offset_spread=20.0, freq=100)
    sim = build(drifting, n_worlds=N)
    result = []
    for n_steps in (1, 50):
        sim.step(n_steps)
        result.append(read(sim, "barometer.pressure")[:, 0, 0])
    np.testing.assert_allclose(result[0].std(), np.hypot(5, 20), rtol=std_tolerance(N))
    np.testing.assert_allclose(
        (result[1] - result[0]).std(), 5 * np.sqrt(2 - 2 * np.exp(-1)), rtol=std_tolerance(N) + 0.01
    )


def test_magnetometer_by_hand():
    """At a yaw of 90 degrees the drone's x axis points north, along the world's y axis."""
    quat = np.float32([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    sim = build(sensors.Magnetometer((0, 2e-5, -4e-5), sensors.Triad(bias=(0, 1e-6, 0))), quat=quat)
    sim.step()
    np.testing.assert_allclose(read(sim, "magnetometer.field")[0, 0], [2e-5, 1e-6, -4e-5], atol=1e-10)


def test_telemetry_and_battery():
    sim = build(Battery(0.25, 0.1), sensors.RotorSpeeds.telemetry(6), sensors.BatteryVoltage(0.02, 0.01), n_worlds=N)
    speed = np.broadcast_to(hover_rotor_state(sim.data), (N, 1, 4))
    sim.data = with_states(sim.data, rotor_vel=speed)
    sim.rotor_vel_control(speed)
    sim.step()
    speeds = read(sim, "rotor_speeds.speed")
    np.testing.assert_allclose(speeds * 6 / 100, np.round(speeds * 6 / 100), atol=1e-3)
    assert np.abs(speeds - np.asarray(sim.data.states.rotor_vel)).max() <= 100 / 12 + 1e-2
    voltage = read(sim, "battery_voltage.voltage")
    np.testing.assert_allclose(voltage.mean(), sim.data.plugins["battery"].voltage[0, 0, 0], atol=4 * 0.02 / np.sqrt(N))
    np.testing.assert_allclose(voltage.std(), np.sqrt(0.02**2 + 0.01**2 / 12), rtol=std_tolerance(N))


def test_ranges_and_their_detours_by_hand():
    anchors = [(3.0, 0, 1.0), (0, 4.0, 1.0), (0, 0, 6.0)]
    sim = build(
        sensors.UWB(anchors, bias=0.1, freq=None), sensors.UWB(anchors, bias=0.1, tdoa=True, freq=None, name="t")
    )
    sim.step()
    np.testing.assert_allclose(read(sim, "uwb.distance")[0, 0], [3.1, 4.1, 5.1], atol=1e-4)  # one step of a fall
    np.testing.assert_allclose(read(sim, "t.difference")[0, 0], [1, 2], atol=1e-4)
    sim = build(sensors.UWB(anchors, 0.05), sensors.UWB(anchors, 0.05, tdoa=True, name="t"), n_worlds=N)
    sim.step()
    np.testing.assert_allclose(read(sim, "uwb.distance")[:, 0].std(axis=0), 0.05, rtol=std_tolerance(N))
    np.testing.assert_allclose(read(sim, "t.difference")[:, 0].std(axis=0), 0.05 * np.sqrt(2), rtol=std_tolerance(N))
    sim = build(sensors.UWB(anchors, outliers=0.2, detour=0.5), n_worlds=N)
    sim.step()
    excess = (read(sim, "uwb.distance")[:, 0] - [3, 4, 5]).ravel()
    is_detour = excess > 1e-3
    assert abs(is_detour.mean() - 0.2 * np.exp(-1e-3 / 0.5)) < 4 * np.sqrt(0.16 / (3 * N))
    np.testing.assert_allclose(excess[is_detour].mean(), 0.501, atol=4 * 0.5 / np.sqrt(is_detour.sum()))


def test_sweep_angles_by_hand(x64):
    """The plane of tilt t through the station, turned by the angle, contains the point."""
    rng = np.random.default_rng(3)
    for pos in rng.normal(size=(20, 3)) + [4, 0, 0]:
        for tilt in SWEEP_TILTS:
            angle = float(sweep_angle(pos, tilt))
            # the plane through the axis of rotation's tilted line: normal (-sin a, cos a, -tan t) for the sign above
            normal = [-np.sin(angle), np.cos(angle), np.tan(tilt)]
            np.testing.assert_allclose(np.dot(normal, pos), 0, atol=1e-12)


def test_a_lighthouse_sees_drones_in_front_of_it_with_noise():
    """The first station looks along x at the drone from 3 m; the second looks away; the third is below the deck."""
    stations, rpy = [(-3.0, 0, 1.5), (3.0, 0, 1.5), (-3.0, 0, 0.5)], [(0, 0, 0), (0, 0, 0), (0, 0, 0)]
    sim = build(sensors.Lighthouse(stations, rpy, 1e-3, diodes=[(0, 0.3, 0)]), n_worlds=N)
    sim.step()
    np.testing.assert_array_equal(read(sim, "lighthouse.visible")[:, 0], np.broadcast_to([1, 0, 0], (N, 3)))
    angle = read(sim, "lighthouse.angle")[:, 0]
    lift = np.arcsin(0.5 * np.tan(np.pi / 6) / np.hypot(3, 0.3))
    expected = np.arctan2(0.3, 3.0) + lift * np.array([1, -1])
    np.testing.assert_allclose(angle[:, :2].mean(axis=0), expected, atol=4e-3 / np.sqrt(N) + 1e-4)
    np.testing.assert_allclose(angle[:, :2].std(axis=0), 1e-3, rtol=std_tolerance(N))
    np.testing.assert_array_equal(angle[:, 2:], 0)


def test_satellite_navigation_wanders():
    sim = build(sensors.GPS((1.0, 1.0, 2.0), 3.0, 0.2, 0.1, freq=100), n_worlds=N)
    result = []
    for n_steps in (1, 100):
        sim.step(n_steps)
        result.append(read(sim, "gps.pos")[:, 0] - np.asarray(sim.data.states.pos)[:, 0])
    np.testing.assert_allclose(result[0].std(axis=0), np.hypot([1, 1, 2], 3), rtol=std_tolerance(N))
    change = np.sqrt(2 * np.array([1, 1, 4]) + 9 * (2 - 2 * np.exp(-1)))
    np.testing.assert_allclose((result[1] - result[0]).std(axis=0), change, rtol=std_tolerance(N))
    vel = read(sim, "gps.vel")[:, 0] - np.asarray(sim.data.states.vel)[:, 0]
    np.testing.assert_allclose(vel.std(axis=0), 0.1, rtol=std_tolerance(N))


def test_observations_of_other_plugins_use_measured_states():
    """A plugin observes measured states in place of the true ones; observations of sensors do not change."""
    sim = build(sensors.MotionCapture(pos=(0, 0, 0.5)), RangeFinder(directions=[(0, 0, -1)]))
    sim.add(HeightObserver())
    sim.step()
    true, measured = (sim.plugins.observations(sim.data, measured=m) for m in (False, True))
    np.testing.assert_allclose(
        np.asarray(measured["height_observer.height"]) - np.asarray(true["height_observer.height"]), 0.5, atol=1e-6
    )
    np.testing.assert_array_equal(measured["motion_capture.pos"], true["motion_capture.pos"])


class HeightObserver(Plugin):
    name: str = "height_observer"

    def observations(self, data):
        return {"height": data.states.pos[2:]}


def test_a_task_observes_measurements_by_one_argument():
    """Observed positions have the offset of the tracked point, rates the gyroscope's bias; rewards do not change."""
    biased_sensors = [sensors.MotionCapture(pos=(0, 0, 0.3)), sensors.IMU(gyro=sensors.Triad(bias=0.2))]
    envs = [make("hover", n_worlds=3, sensors=s, engine="interpret") for s in ((), biased_sensors)]
    states = [env.reset(jax.random.key(1)) for env in envs]
    action = np.zeros(envs[0].sim.data.states.pos.shape[:2] + (4,), np.float32)
    for _ in range(2):
        truth, measured = (np.concatenate([np.ravel(x) for x in jax.tree.leaves(s.obs)]) for s in states)
        assert truth.shape == measured.shape
        assert 0.05 < np.abs(truth - measured).max() < 1.0
        np.testing.assert_array_equal(states[0].reward, states[1].reward)
        states = [env.step(state, action) for env, state in zip(envs, states, strict=True)]
    assert "imu" in str(envs[1].explain())
