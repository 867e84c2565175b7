"""Every sensor: fused with the physics, measuring something, reproducible, and differentiable."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import hover_rotor_state, with_states
from sweep import REQUIRED_BY, SENSORS

from crazysim import Sim
from crazysim.engine import Step
from crazysim.plugins import sensors
from crazysim.plugins.sensors import IMU

ROUGH = {"imu": IMU.bmi088, "rotor_speeds": lambda: sensors.RotorSpeeds.telemetry(6)}
"""Sensors that round."""


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
        if name in REQUIRED_BY:
            sim.add(REQUIRED_BY[name]())
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


def test_every_sensor_measures_something(sim):
    ideal, found = (measurements(sim, data) for data in (sim.data, sim.step_fn(sim.data, jnp.int32(20))))
    for name, x in found.items():
        assert np.isfinite(x).all()
        changed = np.abs(x - ideal[name]).max(axis=-1) > 1e-7 * np.abs(x).max()
        assert changed.all() or name == "lighthouse.visible", name


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
