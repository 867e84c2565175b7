"""Every sensor on every engine: fused with the physics, alike, reproducible, and differentiable."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import FAST, hover_rotor_state, with_states

from crazysim import Battery, RangeFinder, Sim
from crazysim.engine import Step
from crazysim.plugins import sensors
from crazysim.plugins.sensors import IMU, Triad


def errors(size):
    """Return errors of three axes, of the size of what they measure."""
    return Triad(noise=1e-3 * size, bias=0.1 * size, bias_spread=0.1 * size, random_walk=0.01 * size,
                 instability=0.1 * size, scale=0.1, scale_spread=0.03, misalignment=0.02, misalignment_spread=0.02,
                 bandwidth=80.0)  # fmt: skip


ERRORS = errors(1.0)
FIELD = (1e-5, 2e-5, -4.5e-5)
OFFSET, TURN = (0.01, 0.0, -0.02), (0.1, 0.2, 0.3)
PLACES = [(2.0, 2.0, 2.0), (-2.0, -2.0, 2.5)]
STATIONS = [(0, 0, -2.4), (0, 0.6, 0.8)]
LATE = {"delay": 0.004, "jitter": 0.004, "dropout": 0.1}
SENSORS = {
    "imu": lambda: IMU(ERRORS, ERRORS, OFFSET, TURN, 1e-8, **LATE),
    "motion_capture": lambda: sensors.MotionCapture(1e-3, 1e-2, 50.0, OFFSET, TURN, freq=250, **LATE),
    "optical_flow": lambda: sensors.OpticalFlow(0.1, pos=OFFSET),
    "time_of_flight": lambda: sensors.TimeOfFlight(0.01, pos=OFFSET, resolution=None, freq=100, delay=0.01),
    "barometer": lambda: sensors.Barometer(1.0, 2.0, 10.0, 30.0, 200.0),
    "magnetometer": lambda: sensors.Magnetometer(FIELD, errors(1e-4), TURN, freq=100),
    "rotor_speeds": lambda: sensors.RotorSpeeds(5.0, freq=250, delay=0.002),
    "battery_voltage": lambda: sensors.BatteryVoltage(0.01),
    "multi_ranger": lambda: sensors.MultiRanger(0.01, freq=100),
    "uwb": lambda: sensors.UWB(PLACES, 0.1, 0.05, 0.3, 0.5, OFFSET, freq=100, delay=0.006),
    "lighthouse": lambda: sensors.Lighthouse(
        PLACES, [(0, 0, -2.4), (0, 0.6, 0.8)], 1e-3, [OFFSET, (0, 0.01, 0)], freq=100
    ),
    "gps": lambda: sensors.GPS(0.5, 1.0, 20.0, 0.1, OFFSET, freq=100),
}
"""Every sensor, with all of its errors but rounding and limits."""
FIRST = {"battery_voltage": lambda: Battery(0.25, 0.1), "multi_ranger": lambda: RangeFinder()}
"""Plugins that some need."""
ROUGH = {"imu": IMU.bmi088, "rotor_speeds": lambda: sensors.RotorSpeeds.telemetry(6)}
"""Sensors that round."""


ROUNDING = {"imu.accel": 5e-4, "barometer.pressure": 0.02, "barometer.height": 2e-3,
            "rotor_speeds.speed": 0.1, "motion_capture.vel": 2e-4, "magnetometer.field": 2e-9}  # fmt: skip
"""Differences from rounding: of velocities times 500 Hz, at 101325 Pa in float32, which are 0.65 mm."""


def test_every_sensor_is_here():
    names = set(sensors.__all__) - {"Radar", "RangeFinder", "Samples", "Sensor", "Triad"}
    assert {type(sensor()).__name__ for sensor in SENSORS.values()} == names
    assert all(sensor().name == name for name, sensor in SENSORS.items())


def flying(n_worlds, names, **settings):
    """Return a simulation of drones that fly and turn, with sensors."""
    sim = Sim(n_worlds, 2, control="rotor_vel", rng_key=9, **settings)
    speed = hover_rotor_state(sim.data) * np.array([1.02, 1.0, 0.99, 1.0])
    vel, ang_vel = np.float32([0.5, -0.3, 0.2]), np.float32([0.4, -0.5, 0.6])
    pos = np.arange(n_worlds)[:, None, None] * 0.1 + np.array([[0.2, 0.1, 1.0], [0.5, -0.4, 1.2]])
    sim.data = with_states(sim.data, pos=pos, vel=vel, ang_vel=ang_vel, rotor_vel=speed)
    sim.build_default_data()
    for name in names:
        if name in FIRST:
            sim.add(FIRST[name]())
        sim.add(SENSORS[name]())
    sim.rotor_vel_control(np.broadcast_to(1.05 * speed, (n_worlds, 2, 4)))  # the lag has a kink at the command
    return sim


def measurements(sim, data):
    return {name: np.asarray(x) for name, x in sim.plugins.observations(data).items()}


@pytest.fixture(scope="module")
def sim():
    """Return a flight with every sensor."""
    return flying(3, SENSORS)


def test_every_sensor_is_fused(sim):
    program = sim.step_fn.plan(sim.data).program
    assert program.unfused_stages == ()
    assert [s.scope for s in program.fused_segments] == ["drone"]
    assert set(SENSORS) <= set(program.fused_segments[0].stages)


def test_sensors_mean_the_same_on_every_engine(sim):
    """20 steps; random numbers are the same bits everywhere, what is made of them differs by rounding."""
    expected = measurements(sim, Step(sim.step_pipeline, "plain")(sim.data, jnp.int32(20)))
    ideal = measurements(sim, sim.data)
    for engine in FAST:
        found = measurements(sim, Step(sim.step_pipeline, engine)(sim.data, jnp.int32(20)))
        assert found.keys() == expected.keys()
        for name, x in expected.items():
            assert np.isfinite(x).all()
            changed = np.abs(x - ideal[name]).max(axis=-1) > 1e-7 * np.abs(x).max()
            assert changed.all() or name == "lighthouse.visible", f"{name} measured nothing"
            np.testing.assert_allclose(
                found[name], x, rtol=2e-5, atol=ROUNDING.get(name, 2e-5), err_msg=f"{engine} {name}"
            )


def test_law_10_measurements_do_not_depend_on_other_worlds(sim):
    alone = flying(2, SENSORS)
    both = [Step(s.step_pipeline, "plain")(s.data, jnp.int32(9)) for s in (sim, alone)]
    many, few = measurements(sim, both[0]), measurements(alone, both[1])
    for name, x in few.items():
        np.testing.assert_array_equal(x, many[name][:2], err_msg=name)


@pytest.mark.parametrize("name", SENSORS)
def test_law_08_gradients_are_central_differences(name, x64):
    """Of all parts of a measurement, by position, velocity, attitude, rates and rotor speeds of the start."""
    sim = flying(1, [name])
    step, names = Step(sim.step_pipeline, "plain"), ("pos", "vel", "quat", "ang_vel", "rotor_vel")
    start = {k: jnp.asarray(getattr(sim.data.states, k)) for k in names}
    sensor = sim.plugins[name]
    sizes = sum(sensor.channels.values())
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(1, 2, sizes)))

    @jax.jit
    def loss(x):
        quat = x["quat"] / jnp.linalg.norm(x["quat"], axis=-1, keepdims=True)
        data = sim.data.replace(states=sim.data.states.replace(**(x | {"quat": quat})))
        return jnp.sum(weights * sensor.read(step(data, 8)).samples.value)

    rng = np.random.default_rng(2)
    directions = {k: jnp.asarray(rng.normal(size=x.shape)) * (100.0 if k == "rotor_vel" else 0.1)
                  for k, x in start.items()}  # fmt: skip
    slope = jax.jit(lambda x: jax.jvp(loss, (x,), (directions,))[1])(start)
    gradient = jax.jit(jax.grad(loss))(start)
    along = sum(float(jnp.sum(gradient[k] * directions[k])) for k in names)
    h = 1e-4
    ends = [loss({k: x + sign * h * directions[k] for k, x in start.items()}) for sign in (1, -1)]
    difference = float(ends[0] - ends[1]) / (2 * h)
    assert abs(difference) > 1e-6 * float(jnp.abs(sensor.read(step(sim.data, 8)).samples.value).max())
    np.testing.assert_allclose([float(slope), along], difference, rtol=1e-5)  # h^2 of the difference


@pytest.mark.parametrize("name", ROUGH)
def test_gradients_pass_what_rounds(name, x64):
    """A measurement is rounded; its gradient is that of what was rounded, and finite."""
    sim = flying(1, [])
    sensor = sim.add(ROUGH[name]())
    step = Step(sim.step_pipeline, "plain")

    @jax.jit
    @jax.grad
    def gradient(rotor_vel):
        data = sim.data.replace(states=sim.data.states.replace(rotor_vel=rotor_vel))
        return jnp.sum(jnp.square(sensor.read(step(data, 3)).samples.value))

    found = np.asarray(gradient(jnp.asarray(sim.data.states.rotor_vel)))
    assert np.isfinite(found).all()
    assert np.abs(found).min() > 1e-9
