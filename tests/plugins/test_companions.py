"""Plugins that read others, whose settings are replaced later: the flight is that of a simulation built with these."""

import jax
import numpy as np
import pytest
from cases import hover_command, repeat_command, trees_equal
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import Array

from crazysim import (
    IMU,
    Battery,
    Hook,
    Kalman,
    MotionCapture,
    Plugin,
    RangeFinder,
    RotorJet,
    Sim,
    SlungLoad,
)
from crazysim.core import derived
from crazysim.plugins.estimators import ESKF, Complementary
from crazysim.plugins.sensors import (
    GPS,
    UWB,
    Barometer,
    BatteryVoltage,
    Lighthouse,
    Magnetometer,
    MultiRanger,
    OpticalFlow,
    TimeOfFlight,
)

ANCHORS, STATIONS = [(2.0, 2.0, 2.0), (-2.0, 1.0, 2.0)], [(0, 0, -2.4), (0, 0.2, -0.8)]
N_STEPS = 60


class Share(Plugin):
    """A number that follows from another plugin's."""

    half: Array = derived()
    name: str = "share"

    @property
    def companions(self):
        return {"battery": Battery}

    def bind(self, sim):
        return self.with_arrays(sim, half=sim.data.plugins["battery"].capacity / 2)

    def observations(self, data):
        return {"half": self.half}


VERSIONS = {
    "imu": [IMU(), IMU.crazyflie(), IMU(rpy=(0, 0, 0.1), delay=0.004), IMU(freq=250)],
    "optical_flow": [OpticalFlow(0.1), OpticalFlow(0.1, freq=50), OpticalFlow(0.2, 30.0), OpticalFlow(delay=0.02)],
    "motion_capture": [
        MotionCapture(0.01, freq=50),
        MotionCapture(0.01, delay=0.06),
        MotionCapture(0.02, delay=0.02, jitter=0.01, freq=50),
        MotionCapture(0.01, delay=0.01, max_delay=0.03),
    ],
    "lighthouse": [Lighthouse(ANCHORS[:1], STATIONS[:1]), Lighthouse(ANCHORS, STATIONS, 1e-3),
                   Lighthouse(ANCHORS[1:], STATIONS[1:], 1e-3, [(0.01, 0, 0), (-0.01, 0, 0)])],
    "uwb": [UWB(ANCHORS[:1]), UWB(ANCHORS, 0.1), UWB(ANCHORS, tdoa=True, delay=0.02), UWB(ANCHORS[1:], freq=100)],
    "time_of_flight": [TimeOfFlight(), TimeOfFlight(freq=50, max_range=0.9), TimeOfFlight(delay=0.04)],
    "barometer": [Barometer(), Barometer(2.0, freq=25), Barometer(altitude=100.0)],
    "gps": [GPS(0.1), GPS(0.1, freq=50, pos=(0.1, 0, 0)), GPS(0.1, delay=0.1, vel_noise=0.1)],
    "magnetometer": [Magnetometer((2e-5, 0, 4e-5)), Magnetometer((0, 2e-5, 4e-5), rpy=(0.1, 0, 0), freq=100)],
    "load": [SlungLoad(0.01, 0.3, in_scene=False), SlungLoad(0.02, 0.3, in_scene=False, size=0.1),
             SlungLoad(0.01, 0.3, True, in_scene=False, size=(0.1, 0.2, 0.05))],
    "hook": [Hook(0.02, in_scene=False), Hook(0.02, in_scene=False, size=(0.2, 0.2, 0.1))],
    "battery": [Battery(0.25, 0.1), Battery(0.1, 0.2), Battery(0.25, 0.1, charge=0.5)],
    "range_finder": [RangeFinder(), RangeFinder(np.eye(3)[[0, 1, 2, 0, 1, 2]], 0.8), RangeFinder(freq=50)],
}  # fmt: skip
"""Plugins with several settings each."""
DEPENDANTS = {
    "kalman": (Kalman, ("imu", "optical_flow", "motion_capture", "lighthouse", "uwb", "time_of_flight")),
    "eskf": (ESKF, ("imu", "motion_capture", "uwb", "gps", "barometer", "magnetometer", "optical_flow", "lighthouse")),
    "complementary": (Complementary, ("imu", "barometer", "time_of_flight")),
    "jet": (RotorJet, ("load",)),
    "jet on hook": (RotorJet, ("hook",)),
    "voltage": (BatteryVoltage, ("battery",)),
    "ranger": (MultiRanger, ("range_finder",)),
    "share": (Share, ("battery",)),
}
"""Plugins that read others, and the names of these."""


def build(dependant, companions):
    sim = Sim(n_worlds=2, control="attitude", integrator="symplectic_euler", engine="interpret")
    pos = sim.data.states.pos.at[..., 2].set(1.0)
    sim.data = sim.data.replace(states=sim.data.states.replace(pos=pos))
    sim.build_default_data()
    for companion in companions:
        sim.add(companion)
    sim.add(dependant(companions) if hasattr(dependant, "kinds") else dependant())
    return sim


def fly(sim):
    sim.reset()
    sim.attitude_control(repeat_command(sim.data, 1.02 * hover_command(sim.data)))
    sim.step(N_STEPS)
    return jax.device_get(sim.data)


@st.composite
def replacements(draw):
    """Draw a dependant, its other companions, and the settings with which one is replaced, once or twice."""
    dependant, names = DEPENDANTS[draw(st.sampled_from(list(DEPENDANTS)))]
    replaced = draw(st.sampled_from(names))
    aid = draw(st.sampled_from(names[1:] or names))
    needed = [] if "imu" not in names else ["imu", aid if replaced == "imu" else replaced]
    others = [draw(st.sampled_from(VERSIONS[name])) for name in needed if name != replaced]
    return dependant, others, draw(st.lists(st.sampled_from(VERSIONS[replaced]), min_size=2, max_size=3))


@settings(max_examples=settings().max_examples // 6)
@given(drawn=replacements())
@pytest.mark.long("traces the steps of drawn plugins")
def test_plugins_follow_what_they_read(drawn):
    dependant, others, (first, *later) = drawn
    sim = build(dependant, [*others, first])
    for plugin in later:
        sim.replace(plugin)
    expected = build(dependant, [*others, later[-1]])
    assert list(sim.step_pipeline) == list(expected.step_pipeline)
    for plugin in sim.plugins.values():
        assert all(sensor is sim.plugins[sensor.name] for sensor in getattr(plugin, "sensors", ()))
    assert trees_equal(fly(sim), fly(expected))
