"""Derivatives through all effects, sensors and filters at once, against central differences."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sweep import REQUIRED_BY, SENSORS, effects

from crazysim import Battery, Downwash, GroundEffect, Latency, RangeFinder, Sim, Wind
from crazysim.engine.pytree import scopes
from crazysim.engine.stage import as_stages
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


def differentiable(data):
    """Return which leaves have slopes: all floats but shared parameters, which no stage writes."""
    pairs = zip(jax.tree.leaves(data), jax.tree.leaves(scopes(data)), strict=True)
    return [jnp.issubdtype(jnp.result_type(x), jnp.floating) and scope != "shared" for x, scope in pairs]


def push_forward(stage, has_slope):
    def run(data, slopes):
        leaves, tree = jax.tree.flatten(data)

        def advance(numbers):
            numbers = iter(numbers)
            chosen = [next(numbers) if has else x for x, has in zip(leaves, has_slope, strict=True)]
            after = jax.tree.leaves(stage(tree.unflatten(chosen)))
            return list(itertools.compress(after, has_slope)), after

        _, slopes, after = jax.jvp(advance, (list(itertools.compress(leaves, has_slope)),), (slopes,), has_aux=True)
        return tree.unflatten(after), slopes

    # Without optimisation: compiling takes longer than running.
    return jax.jit(run, compiler_options={"xla_backend_optimization_level": 0})


SLOW = pytest.mark.slow("compiles an update for each number of each sensor; the filters of the other case fuse one")


@pytest.mark.long("compiles the derivative of each stage, in float64")
@pytest.mark.parametrize("plugins", [create_each_plugin, pytest.param(create_filters_of_all_sensors, marks=SLOW)])
def test_law_08_slopes_are_central_differences(plugins, x64):
    """Derivatives of every state of the data by the states at the start, with the stages as they are written.

    Each stage is differentiated in forward mode; a gradient is its transpose. Differences have errors of their step
    squared, and of the rounding of large numbers, such as a pressure of 1e5 Pa or a charge that hardly changes.
    """
    sim = Sim(n_drones=2, control="state", engine="plain")
    for plugin in plugins():
        sim.add(plugin)
    pos = jnp.array([[[0.2, 0.1, 0.3], [0.25, 0.05, 0.9]]])
    sim.state_control(pos=np.asarray(pos) + 0.1)
    start = {  # of one type, since others would compile the stages again
        "pos": pos,
        "vel": jnp.full((1, 2, 3), 0.3, float),
        "quat": jnp.tile(jnp.array([0.1, -0.05, 0.2, 1.0]), (1, 2, 1)),
        "ang_vel": jnp.tile(jnp.array([0.4, -0.5, 0.6]), (1, 2, 1)),
        "rotor_vel": jnp.full((1, 2, 4), 15_000.0, float),
    }
    rng = np.random.default_rng(1)
    sizes = {name: 100.0 if name == "rotor_vel" else 0.1 for name in start}
    directions = {name: jnp.asarray(sizes[name] * rng.normal(size=x.shape)) for name, x in start.items()}
    has_slope = differentiable(sim.data)
    stages = [push_forward(stage, has_slope) for stage in as_stages(sim.step_pipeline)]

    def start_data(x):
        quat = x["quat"] / jnp.linalg.norm(x["quat"], axis=-1, keepdims=True)
        return sim.data.replace(states=sim.data.states.replace(**x | {"quat": quat}))

    def fly(x):
        data = start_data(x)
        _, slopes = jax.jvp(
            lambda x: list(itertools.compress(jax.tree.leaves(start_data(x)), has_slope)), (x,), (directions,)
        )
        for _ in range(N_STEPS):
            for stage in stages:
                data, slopes = stage(data, slopes)
        leaves = itertools.compress(jax.tree.leaves_with_path(data), has_slope)
        return {jax.tree_util.keystr(path): x for path, x in leaves}, slopes

    values, slopes = fly(start)
    ends = [fly({k: x + h * directions[k] for k, x in start.items()})[0] for h in (RELATIVE_STEP, -RELATIVE_STEP)]
    compared = set()
    for (name, value), slope in zip(values.items(), slopes, strict=True):
        difference = np.asarray(ends[0][name] - ends[1][name]) / (2 * RELATIVE_STEP)
        size = max(np.abs(x).max(initial=0.0) for x in (np.asarray(slope), difference))
        rounding = 1e-15 * np.abs(value).max(initial=0.0) / RELATIVE_STEP
        if size > MIN_SLOPE:
            assert np.abs(slope - difference).max() < 1e-6 * size + rounding, name
            compared.add(name)
    sensor_names = {name for name, plugin in sim.plugins.items() if hasattr(plugin, "channels")} | {"kalman", "eskf"}
    assert sensor_names <= {name.split("'")[1] for name in compared if name.startswith(".plugins")}
    assert {".states.pos", ".states.rotor_vel", ".plugins['eskf'].estimate.gyro_bias"} <= compared
