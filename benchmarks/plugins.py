"""Cost of sensors, estimators and effects: a JSON line for each case, with the time of a step relative to no plugins.

    python benchmarks/plugins.py [--device gpu] [--worlds 262144] [--drones 2] [--cases imu kalman everything ...]

Drones hover on a constant state command, in calls of 100 steps; all cases alternate. Sensors have their default rates;
the distances of ``multi_ranger`` are computed at 10 Hz. ``kalman``, ``eskf`` and ``complementary`` are estimators with
their sensors; the controllers do not use the estimate of ``complementary``. ``all_aids`` is a Kalman filter with all
kinds of sensors that it takes. ``outdoors`` is an error-state filter with satellite navigation, barometer and
magnetometer. ``everything`` is all sensors, the Kalman filter, wind with gusts, downwash, ground effect, battery and
latency.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

import numpy as np
from measure import Flight, report_flights

from crazysim import (
    Battery,
    Downwash,
    GroundEffect,
    Kalman,
    Latency,
    Randomize,
    RangeFinder,
    RotorAerodynamics,
    Sim,
    Wind,
)
from crazysim.core.plugin import Plugin
from crazysim.plugins import sensors
from crazysim.plugins.estimators import ESKF, Complementary, Estimator

N_STEPS = 100
"""Steps per call."""
ANCHOR_POSITIONS = np.array([[-3, -3, 0.2], [3, -3, 2.4], [3, 3, 0.2], [-3, 3, 2.4]])
"""Positions of the anchors of ultra-wideband ranging, m. (4, 3)"""
LIGHTHOUSE_POSES = [[-2, -2, 2.5], [2, 2, 2.5]], [[0, 0.5, 0.8], [0, 0.5, -2.4]]
"""Positions, m, and roll, pitch and yaw, rad, of two lighthouses."""
SPACING = 3.0
"""Distance between drones of a world, m."""
MakePlugins = Callable[[], Sequence[Plugin]]
"""Function that returns new plugins."""


def _with_estimator(estimator: Estimator) -> list[Plugin]:
    return [*estimator.sensors, estimator]


SENSORS: dict[str, MakePlugins] = {
    "imu": lambda: [sensors.IMU.crazyflie()],
    "motion_capture": lambda: [sensors.MotionCapture(1e-3, 1e-3)],
    "optical_flow": lambda: [sensors.OpticalFlow(0.2)],
    "time_of_flight": lambda: [sensors.TimeOfFlight()],
    "uwb": lambda: [sensors.UWB(ANCHOR_POSITIONS, 0.1)],
    "lighthouse": lambda: [sensors.Lighthouse(*LIGHTHOUSE_POSES, 1e-3)],
    "barometer": lambda: [sensors.Barometer(1.0)],
    "magnetometer": lambda: [sensors.Magnetometer((0.0, 2e-5, -4.5e-5), sensors.Triad(noise=5e-7))],
    "gps": lambda: [sensors.GPS(0.5)],
    "rotor_speeds": lambda: [sensors.RotorSpeeds(5.0)],
    "battery_voltage": lambda: [Battery(), sensors.BatteryVoltage(0.01)],
    "multi_ranger": lambda: [RangeFinder(freq=10), sensors.MultiRanger(0.01)],
}
"""Plugins of each kind of sensor."""
EFFECTS: dict[str, MakePlugins] = {
    "wind": lambda: [Wind((1.0, 0.0, 0.0), 7.7)],
    "downwash": lambda: [Downwash()],
    "ground_effect": lambda: [GroundEffect()],
    "battery": lambda: [Battery()],
    "latency": lambda: [Latency(2)],
    "rotor_aerodynamics": lambda: [RotorAerodynamics()],
    "randomize": lambda: [Randomize.crazyflie()],
}
"""Plugins of each effect."""


def _all_aids() -> list[Plugin]:
    names = ("imu", "motion_capture", "optical_flow", "time_of_flight", "uwb", "lighthouse")
    aids = [sensor for name in names for sensor in SENSORS[name]()]
    return [*aids, Kalman(aids)]  # type: ignore[arg-type]


def _all_plugins() -> list[Plugin]:
    aids = [*SENSORS["imu"](), *SENSORS["motion_capture"]()]
    other_plugins = [
        plugin for name in (*SENSORS, *EFFECTS) if name not in NOT_IN_EVERYTHING for plugin in CASES[name]()
    ]
    return [*other_plugins, *aids, Kalman(aids)]  # type: ignore[arg-type]


OUTDOOR_SENSORS = ("imu", "gps", "barometer", "magnetometer")
"""Cases of the sensors of ``outdoors``."""
NOT_IN_EVERYTHING = ("imu", "motion_capture", "battery", "rotor_aerodynamics", "randomize")
"""Cases whose plugins ``everything`` does not take from ``CASES``. It adds ``imu`` and ``motion_capture`` together with
the filter, and ``battery`` with ``battery_voltage``; it leaves out the other two."""
CASES: dict[str, MakePlugins] = {
    "none": lambda: [],
    **SENSORS,
    "imu_vibration": lambda: [sensors.IMU.bmi088(imbalance=1e-8)],
    "motion_capture_late": lambda: [sensors.MotionCapture(1e-3, 1e-3, delay=0.01, jitter=0.01, dropout=0.05)],
    "complementary": lambda: _with_estimator(
        Complementary([sensors.IMU.crazyflie(), sensors.Barometer()], control=False)
    ),
    "kalman": lambda: _with_estimator(Kalman.default()),
    "eskf": lambda: _with_estimator(ESKF.default()),
    "outdoors": lambda: _with_estimator(ESKF([s for name in OUTDOOR_SENSORS for s in SENSORS[name]()])),  # type: ignore[misc]
    "all_aids": _all_aids,
    **EFFECTS,
    "everything": _all_plugins,
}
"""Plugins of each case."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--worlds", type=int, default=1024)
    parser.add_argument("--drones", type=int, default=1, help="drones in each world, 3 m from each other")
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--repeats", type=int, default=15)
    args = parser.parse_args()
    flights = {}
    for name in dict.fromkeys(["none", *args.cases]):
        sim = Sim(args.worlds, args.drones, device=args.device, engine=args.engine, control="state")
        for plugin in CASES[name]():
            sim.add(plugin)
        states = sim.data.states
        pos = states.pos.at[..., 0].set(SPACING * np.arange(args.drones))
        sim.data = sim.data.replace(states=states.replace(pos=pos))
        flights[name] = Flight(sim, "state", N_STEPS, args.device)
    report_flights(args.device, flights, args.repeats, dict.fromkeys(flights, "none"), benchmark="plugins")


if __name__ == "__main__":
    main()
