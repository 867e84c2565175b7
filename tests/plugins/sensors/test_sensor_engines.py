"""Every sensor: fused with the physics, with changing measurements, reproducible, and differentiable."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import build_stagewise_step, count_documented_arrays, hover_rotor_state, with_states
from sweep import REQUIRED_BY, SENSORS

from crazysim import Sim
from crazysim.plugins import sensors
from crazysim.plugins.sensors import IMU, Camera, Lidar


def test_all_sensors_are_tested():
    names = set(sensors.__all__) - {
        *("Constant", "GaussMarkov", "Link", "Rounded", "Turned", "White"),
        "Camera",
        "Distortion",
        "ImageData",
        "ImageSensor",
        "Lidar",
        "Radar",
        "RangeFinder",
        "Samples",
        "Sensor",
        "StereoNoise",
        "Triad",
    }
    assert {type(sensor()).__name__ for sensor in SENSORS.values()} == names
    assert all(sensor().name == name for name, sensor in SENSORS.items())


def fields_of(kind):
    return dataclasses.fields(kind) if dataclasses.is_dataclass(kind) else ()


def build(n_worlds, names, **settings):
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
    # The slope of the rotor lag jumps where the speed equals the command.
    sim.rotor_vel_control(np.broadcast_to(1.05 * speed, (n_worlds, 2, 4)))
    return sim


def measurements(sim, data):
    return {name: np.asarray(x) for name, x in sim.plugins.observations(data).items()}


@pytest.fixture(scope="module")
def sim():
    """Return a simulation with every sensor."""
    return build(3, SENSORS)


@pytest.mark.long("compiles a step with every sensor")
def test_the_age_of_every_sensor_is_infinite_until_it_has_measured():
    names = {x for x in sensors.__all__ if "freq" in {field.name for field in fields_of(getattr(sensors, x))}}
    sim = build(2, SENSORS)
    for sensor in (Camera(2, 1), Lidar((0.0,), (0.0,))):
        sim.add(sensor)
    all_sensors = [x for x in sim.plugins.values() if type(x).__name__ in names]
    assert {type(x).__name__ for x in all_sensors} == names - {"ImageSensor", "Sensor"}

    def ages(world):
        return {x.name: np.asarray(x.age(sim.data))[world].max() for x in all_sensors}

    late = {x.name for x in all_sensors if getattr(x, "delay", 0) or getattr(x, "dropout", 0)}
    assert set(ages(0).values()) == {np.inf}
    sim.step()
    first = ages(0)
    assert {name for name in first if first[name] > 0} == late
    sim.step(29)
    last = ages(0)
    assert max(last.values()) < 0.04
    sim.reset(np.array([False, True]))
    assert ages(0) == last
    assert set(ages(1).values()) == {np.inf}


def test_docstrings_of_sensors_give_the_shapes(sim):
    sizes = {"n_worlds": 3, "n_drones": 2, "n_rotors": 4, "n_rays": 6, "n_anchors": 2, "n_stations": 2, "n_diodes": 2}
    for name in SENSORS:
        sensor = sim.data.plugins[name]
        sizes["k"] = sum(sensor.channels.values())
        sizes["n_rows"] = 0 if sensor.samples.queue is None else sensor.samples.queue.shape[2]
        assert count_documented_arrays(sensor, **sizes) == len(jax.tree.leaves(sensor))


def test_every_sensor_measures_something(sim):
    ideal, measured = (measurements(sim, data) for data in (sim.data, sim.step_fn(sim.data, jnp.int32(20))))
    for name, x in measured.items():
        assert np.isfinite(x).all()
        changed = np.abs(x - ideal[name]).max(axis=-1) > 1e-7 * np.abs(x).max()
        assert changed.all() or name == "lighthouse.visible", name


def test_gradients_pass_through_rounding(x64):
    """The gradient of a rounded measurement is that before rounding, and finite."""
    sim = build(1, [])
    rounding_sensors = [sim.add(make()) for make in (IMU.bmi088, lambda: sensors.RotorSpeeds.telemetry(6))]
    step = build_stagewise_step(sim)

    @jax.jit
    @jax.jacrev
    def gradients(rotor_vel):
        end = step(sim.data.replace(states=sim.data.states.replace(rotor_vel=rotor_vel)), 3)
        return jnp.stack([jnp.sum(jnp.square(sensor.read(end).samples.value)) for sensor in rounding_sensors])

    result = np.asarray(gradients(jnp.asarray(sim.data.states.rotor_vel)))
    assert np.isfinite(result).all()
    assert np.abs(result).min() > 1e-9


@pytest.mark.long("compiles the derivatives of all sensors in float64")
def test_law_08_gradients_are_central_differences(x64):
    """Derivatives of each measurement by position, velocity, attitude, rates and rotor speeds at the start."""
    sim = build(1, SENSORS)
    step, names = build_stagewise_step(sim), ("pos", "vel", "quat", "ang_vel", "rotor_vel")
    start = {k: jnp.asarray(getattr(sim.data.states, k)) for k in names}
    all_sensors = [sim.plugins[name] for name in SENSORS]
    rng = np.random.default_rng(1)
    weights = [jnp.asarray(rng.normal(size=(1, 2, sum(sensor.channels.values())))) for sensor in all_sensors]
    rng = np.random.default_rng(2)
    directions = {k: jnp.asarray(rng.normal(size=x.shape)) * (100.0 if k == "rotor_vel" else 0.1)
                  for k, x in start.items()}  # fmt: skip

    def measure(x):
        """Return a weighted sum of the measurements of each sensor, and the largest of them. (n_sensors,)"""
        quat = x["quat"] / jnp.linalg.norm(x["quat"], axis=-1, keepdims=True)
        end = step(sim.data.replace(states=sim.data.states.replace(**(x | {"quat": quat}))), 8)
        values = [sensor.read(end).samples.value for sensor in all_sensors]
        sums = jnp.stack([jnp.sum(w * value) for w, value in zip(weights, values, strict=True)])
        return sums, jnp.stack([jnp.abs(value).max() for value in values])

    @jax.jit
    def derivatives(x):
        """Return the sums, their slopes along the directions by forward and by reverse derivatives, and the sizes."""
        sums, linear, sizes = jax.linearize(measure, x, has_aux=True)
        transposed = jax.vmap(lambda row: jax.linear_transpose(linear, x)(row)[0])(jnp.eye(len(all_sensors)))
        reverse_slopes = sum(jnp.sum(transposed[k] * directions[k], axis=range(1, 4)) for k in names)
        return sums, linear(directions), reverse_slopes, sizes

    h = 1e-4
    (_, slopes, reverse_slopes, sizes), *ends = (
        derivatives({k: x + sign * h * directions[k] for k, x in start.items()}) for sign in (0, 1, -1)
    )
    differences = (ends[0][0] - ends[1][0]) / (2 * h)
    for name, slope, reverse_slope, difference, size in zip(
        SENSORS, slopes, reverse_slopes, differences, sizes, strict=True
    ):
        assert abs(difference) > 1e-6 * size, name
        # The error of the difference is of order h^2.
        np.testing.assert_allclose([slope, reverse_slope], difference, rtol=1e-5, err_msg=name)
