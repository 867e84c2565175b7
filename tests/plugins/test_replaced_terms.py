"""Terms of the model that plugins replace: two plugins that replace the same term are an error."""

import dataclasses

import pytest

from crazysim import ConfigError, Sim
from crazysim.plugins.effects import Battery, Downwash, GroundEffect, Residual, RotorAerodynamics, Wind
from crazysim.plugins.estimators import ESKF, Kalman
from crazysim.plugins.follow import Follow
from crazysim.plugins.sensors import IMU, MotionCapture
from crazysim.trajectories import circle

SENSORS = [IMU(), MotionCapture()]


@pytest.fixture(scope="module")
def sim():
    sim = Sim(n_drones=2, control="state", drone="cf21B_500_idsia")
    for sensor in SENSORS:
        sim.add(sensor)
    return sim


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (RotorAerodynamics(drag=1e-6, inflow=1e-6), RotorAerodynamics(drag=1e-6, inflow=1e-6)),
        (RotorAerodynamics(drag=1e-6, inflow=1e-6), Residual()),
        (Residual(), RotorAerodynamics(drag=1e-6, inflow=1e-6)),
        (Residual(), Residual()),
        (Battery(), Battery()),
        (Downwash(), Downwash()),
        (GroundEffect(), GroundEffect()),
        (Follow(circle(1.0)), Follow(circle(2.0))),
        (Kalman(SENSORS), ESKF(SENSORS)),
    ],
    ids=lambda plugin: plugin.name,
)
def test_law_09_two_plugins_that_replace_the_same_term_are_an_error_with_both_names(sim, first, second):
    second = dataclasses.replace(second, name="second")
    sim.add(first)
    kinds = type(first).__name__, type(second).__name__
    before = dict(sim.step_pipeline)
    with pytest.raises(ConfigError, match=rf"{kinds[0]} '{first.name}' and {kinds[1]} 'second'.*both provide it"):
        sim.add(second)
    assert list(sim.step_pipeline) == list(before)
    sim.replace(first)
    sim.remove(first)
    sim.add(second)
    sim.remove(second)


def test_plugins_that_replace_no_term_can_be_added_twice(sim):
    before, names = dict(sim.step_pipeline), {"first", "second", "first_filter", "second_filter"}
    for name in ("first", "second"):
        sim.add(Wind((1.0, 0.0, 0.0), name=name))
        sim.add(Kalman(SENSORS, control=False, name=f"{name}_filter"))
    assert names <= sim.data.plugins.keys()
    assert {"first_filter", "second_filter"} <= sim.step_pipeline.keys()
    for name in ("first_filter", "second_filter", "first", "second"):
        sim.remove(name)
    assert not names & sim.data.plugins.keys()
    assert list(sim.step_pipeline) == list(before)
