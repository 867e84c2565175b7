"""Cost of sensors and estimators: time of a step with each over that without, one JSON line each.

    python benchmarks/sensors.py [--device gpu] [--worlds 262144] [--cases imu kalman ...]

Drones hover on a constant state command, in calls of 100 steps; all cases alternate. Sensors have their default rates;
``kalman`` and ``complementary`` are what ``Sim(estimator=...)`` adds with its sensors (the latter only runs along), and
``all`` is one filter on all kinds of sensors that it takes.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from measure import Flight, digits, engine_of, medians, report

from crazysim import Battery, Kalman, RangeFinder, Sim
from crazysim.core.plugin import Plugin
from crazysim.plugins import sensors
from crazysim.plugins.estimators import Complementary, Estimator

N_STEPS = 100
"""Steps per call."""
CORNERS = np.array([[-3, -3, 0.2], [3, -3, 2.4], [3, 3, 0.2], [-3, 3, 2.4]])
"""Positions of anchors, m."""
STATIONS = [[-2, -2, 2.5], [2, 2, 2.5]], [[0, 0.5, 0.8], [0, 0.5, -2.4]]
"""Positions, m, and roll, pitch and yaw, rad, of lighthouses."""


def _fused() -> list[Plugin]:
    aids = [
        sensors.IMU.crazyflie(),
        sensors.MotionCapture(1e-3, 1e-3),
        sensors.OpticalFlow(0.2),
        sensors.TimeOfFlight(),
        sensors.UWB(CORNERS, 0.1),
        sensors.Lighthouse(*STATIONS, 1e-3),
    ]
    return [*aids, Kalman(aids)]  # type: ignore[list-item]


def _on(estimator: Estimator) -> list[Plugin]:
    return [*estimator.sensors, estimator]


CASES: dict[str, Callable[[], list[Plugin]]] = {
    "none": lambda: [],
    "imu": lambda: [sensors.IMU.crazyflie()],
    "imu_vibration": lambda: [sensors.IMU.bmi088(imbalance=1e-8)],
    "motion_capture": lambda: [sensors.MotionCapture(1e-3, 1e-3)],
    "motion_capture_late": lambda: [sensors.MotionCapture(1e-3, 1e-3, delay=0.01, jitter=0.01, dropout=0.05)],
    "optical_flow": lambda: [sensors.OpticalFlow(0.2)],
    "time_of_flight": lambda: [sensors.TimeOfFlight()],
    "barometer": lambda: [sensors.Barometer(1.0)],
    "magnetometer": lambda: [sensors.Magnetometer((0.1, 0.2, -0.45), sensors.Triad(noise=1e-3))],
    "gps": lambda: [sensors.GPS(0.5)],
    "uwb": lambda: [sensors.UWB(CORNERS, 0.1)],
    "lighthouse": lambda: [sensors.Lighthouse(*STATIONS, 1e-3)],
    "rotor_speeds": lambda: [sensors.RotorSpeeds(5.0)],
    "battery_voltage": lambda: [Battery(0.25, 0.1), sensors.BatteryVoltage(0.01)],
    "multi_ranger": lambda: [RangeFinder(), sensors.MultiRanger(0.01)],
    "complementary": lambda: _on(Complementary([sensors.IMU.crazyflie(), sensors.Barometer()], control=False)),
    "kalman": lambda: _on(Kalman.default()),
    "all": _fused,
}
"""Plugins of each case."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--worlds", type=int, default=1024)
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--repeats", type=int, default=15)
    args = parser.parse_args()
    flights = {}
    for name in dict.fromkeys(["none", *args.cases]):
        sim = Sim(args.worlds, device=args.device, engine=args.engine, control="state")
        for plugin in CASES[name]():
            sim.add(plugin)
        flights[name] = Flight(sim, "state", N_STEPS, args.device)
    taken = medians({name: flight.seconds for name, flight in flights.items()}, args.repeats)
    for name, flight in flights.items():
        flight.require_flying()
        report(
            args.device,
            benchmark="sensors",
            case=name,
            engine=engine_of(flight.sim),
            n_worlds=args.worlds,
            call_s=digits(taken[name]),
            steps_per_s=digits(args.worlds * N_STEPS / taken[name]),
            ratio=digits(taken[name] / taken["none"]),
        )


if __name__ == "__main__":
    main()
