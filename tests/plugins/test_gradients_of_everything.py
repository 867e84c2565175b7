"""Derivatives through all effects, sensors and filters at once, against central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sweep import REQUIRED_BY, SENSORS, effects
from tangents import push_forward

from crazysim import Battery, Downwash, GroundEffect, Latency, RangeFinder, Sim, Wind
from crazysim.engine import Step
from crazysim.plugins import sensors
from crazysim.plugins.estimators import ESKF, Kalman
from crazysim.plugins.sensors import IMU, UWB, MotionCapture, OpticalFlow, TimeOfFlight, Triad

ANCHORS = [(-3, -3, 0.2), (3, -3, 2.4), (3, 3, 0.2)]
ERRORS = Triad(noise=1e-3, bias=0.01, scale=0.01, misalignment=0.02, instability=0.01, bandwidth=80.0)
N_STEPS = 10
"""Steps of 2 ms: two predictions of each filter, and a measurement of each sensor."""
MIN_SLOPE, RELATIVE_STEP = 1e-9, 1e-5
"""Largest slope that is not compared, and step of the differences as a multiple of the directions."""


def create_each_plugin():
    """Return every effect and sensor, a filter that controls the drones, and another one that only estimates.

    The filters fuse one number, since each adds an update of all states to compile.
    """
    sensors = {name: make() for name, make in SENSORS.items()}
    inputs = [sensors["imu"], sensors["time_of_flight"]]
    filters = [Kalman(inputs), ESKF(inputs, control=False)]
    return [*effects(), REQUIRED_BY["multi_ranger"](), *sensors.values(), *filters]


def create_filters_of_all_sensors():
    imu, tracked = IMU(ERRORS, ERRORS, (0.01, 0.0, 0.0), imbalance=1e-8), MotionCapture(1e-3, 1e-2, delay=0.004)
    aids = [
        OpticalFlow(0.1),
        TimeOfFlight(resolution=None),
        UWB(ANCHORS, 0.1),
        UWB(ANCHORS, 0.1, tdoa=True, name="tdoa"),
        sensors.Lighthouse([(-2, -2, 2.5)], [(0, 0.5, 0.8)], 1e-3),
        sensors.GPS(0.5),
        sensors.Barometer(1.0),
        sensors.Magnetometer((2e-5, 0.0, -4.5e-5), Triad(noise=5e-7)),
    ]
    air = [Wind((1.0, 0.0, 0.0), 7.7), Downwash(), GroundEffect(), Battery(), Latency(2), RangeFinder()]
    others = [sensors.MultiRanger(0.01), sensors.RotorSpeeds(5.0), sensors.BatteryVoltage(0.01)]
    estimating_filter = ESKF([imu, tracked, *aids], control=False)
    return [*air, *others, imu, tracked, *aids, Kalman([imu, tracked]), estimating_filter]


SLOW = pytest.mark.slow("traces an update for each number of each sensor; the filters of the other case fuse one")


@pytest.mark.long("traces every stage, and its derivative")
@pytest.mark.parametrize("plugins", [create_each_plugin, pytest.param(create_filters_of_all_sensors, marks=SLOW)])
def test_law_08_slopes_are_central_differences(plugins, x64):
    """Derivatives of every state of the data by the states at the start, in forward mode; a gradient is the transpose.

    Differences have errors of their step squared, and of the rounding of large numbers, such as a pressure of 1e5 Pa or
    a charge that hardly changes.
    """
    sim = Sim(n_drones=2, control="state", engine="interpret")
    for plugin in plugins():
        sim.add(plugin)
    pos = np.array([[[0.2, 0.1, 0.3], [0.25, 0.05, 0.9]]])
    sim.state_control(pos=pos + 0.1)
    start = {
        "pos": pos,
        "vel": np.full((1, 2, 3), 0.3),
        "quat": np.tile(np.array([0.1, -0.05, 0.2, 1.0]) / np.sqrt(1.0525), (1, 2, 1)),
        "ang_vel": np.tile([0.4, -0.5, 0.6], (1, 2, 1)),
        "rotor_vel": np.full((1, 2, 4), 15_000.0),
    }
    rng = np.random.default_rng(1)
    sizes = {name: 100.0 if name == "rotor_vel" else 0.1 for name in start}
    directions = {name: sizes[name] * rng.normal(size=x.shape) for name, x in start.items()}
    step = Step(sim.step_pipeline, "interpret")

    def start_data(h=0.0):
        states = sim.data.states.replace(**{name: jnp.asarray(x + h * directions[name]) for name, x in start.items()})
        return jax.tree.map(lambda x: x.astype(float) if x.dtype == np.float32 else x, sim.data.replace(states=states))

    ends = [jax.tree.leaves_with_path(step(start_data(h), N_STEPS)) for h in (0.0, RELATIVE_STEP, -RELATIVE_STEP)]
    value, ahead, behind = ({jax.tree_util.keystr(path): x for path, x in end} for end in ends)
    slopes = push_forward(step, start_data(), {f".states.{name}": x for name, x in directions.items()}, N_STEPS)
    compared = set()
    for name, slope in slopes.items():
        difference = np.asarray(ahead[name] - behind[name]) / (2 * RELATIVE_STEP)
        size = max(np.abs(x).max(initial=0.0) for x in (slope, difference))
        rounding = 1e-15 * np.abs(value[name]).max(initial=0.0) / RELATIVE_STEP
        if size > MIN_SLOPE:
            assert np.abs(slope - difference).max() < 1e-6 * size + rounding, name
            compared.add(name)
    sensor_names = {name for name, plugin in sim.plugins.items() if hasattr(plugin, "channels")} | {"kalman", "eskf"}
    assert sensor_names <= {name.split("'")[1] for name in compared if name.startswith(".plugins")}
    assert {".states.pos", ".states.rotor_vel", ".plugins['eskf'].estimate.gyro_bias"} <= compared
