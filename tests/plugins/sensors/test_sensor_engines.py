"""Every sensor: changing measurements, ages, documented shapes, and slopes through rounding."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import count_documented_arrays, hover_rotor_state, with_states
from sweep import REQUIRED_BY, SENSORS
from tangents import push_forward

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
        "RandomColors",
        "RandomPose",
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
    observations = sim.plugins.observations(data)
    return {name: np.asarray(x) for name, x in observations.items() if name.split(".")[0] in SENSORS}


@pytest.fixture(scope="module")
def sim():
    sim = build(3, SENSORS, engine="interpret")
    for sensor in (Camera(2, 1), Lidar((0.0,), (0.0,))):
        sim.add(sensor)
    return sim


@pytest.mark.long("traces all sensors, and compiles the images of two")
def test_the_age_of_every_sensor_is_infinite_until_it_has_measured(sim):
    names = {x for x in sensors.__all__ if "freq" in {field.name for field in fields_of(getattr(sensors, x))}}
    all_sensors = [x for x in sim.plugins.values() if type(x).__name__ in names]
    assert {type(x).__name__ for x in all_sensors} == names - {"ImageSensor", "Sensor"}

    def ages(data, world):
        return {x.name: np.asarray(x.age(data))[world].max() for x in all_sensors}

    late = {x.name for x in all_sensors if getattr(x, "delay", 0) or getattr(x, "dropout", 0)}
    assert set(ages(sim.data, 0).values()) == {np.inf}
    data = sim.step_fn(sim.data, jnp.int32(1))
    first = ages(data, 0)
    assert {name for name in first if first[name] > 0} == late
    data = sim.step_fn(data, jnp.int32(29))
    last = ages(data, 0)
    assert max(last.values()) < 0.04
    data = sim.reset_fn(data, sim.default_data, np.array([False, True, False]))
    assert ages(data, 0) == last
    assert set(ages(data, 1).values()) == {np.inf}


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


def test_slopes_pass_through_rounding(x64):
    """The slope of a rounded measurement is that before rounding, and finite; a gradient is its transpose."""
    sim = build(1, [], engine="interpret")
    sensors_that_round = [sim.add(make()) for make in (IMU.bmi088, lambda: sensors.RotorSpeeds.telemetry(6))]
    data = jax.tree.map(lambda x: x.astype(float) if x.dtype == np.float32 else x, sim.data)
    slopes = push_forward(sim.step_fn, data, {".states.rotor_vel": 1.0}, 3)
    for sensor in sensors_that_round:
        slope = slopes[f".plugins[{sensor.name!r}].samples.value"]
        assert np.isfinite(slope).all()
        assert np.abs(slope).max() > 1e-9
