"""Times of planned flights over race tracks, beside published ones, with rotor lag, and with a battery that sags.

    python benchmarks/racing.py [--small]

``deviation_cm`` is the largest distance between a plan and its thrusts flown by the simulator's dynamics, and ``cpu_s``
the processor time of the plan.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
from measure import report, round_digits

from crazysim import Battery, Sim, load_airframe
from crazysim.envs import load_track
from crazysim.trajectories import fly_open_loop, plan_race

CASES = (
    ("split_s_waypoints", "17.56 s (CPC)", "uzh_cpc", 0.3, 0.5, False, (0.04, 0.02)),
    ("split_s_waypoints", "17.60 s (TOGT-Planner, refined)", "uzh_cpc", 3.0, None, False, (0.04, 0.02)),
    ("split_s_gates", "16.83 s (AOS-TOGT)", "uzh_cpc", 3.0, 0.3, False, (0.04, 0.02)),
    ("split_s_shapes", "7.01 s (TOGT-Planner, refined)", "uzh_cpc", 3.0, 0.3, False, (0.04, 0.02)),
    *(("split_s_gates", "", "uzh_5inch", 3.0, 0.3, lag, (0.04,)) for lag in (False, True)),
    *(("split_s_shapes", "", "uzh_5inch", 3.0, 0.3, lag, (0.04,)) for lag in (False, True)),
)
"""Track, published time, drone, largest yaw rate, rad/s, floor, m, rotor lag, and times between changes of thrust."""
SAG_TIMES = (10, 40)
"""Times at full thrust after which a sagging battery is measured, s."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--small", action="store_true", help="the first case of the shortest track alone")
    small = parser.parse_args().small
    for track, published, drone, yaw_rate, floor, rotor_lag, steps in CASES[3:4] if small else CASES:
        for dt in steps[:1] if small else steps:
            times = plan(track, drone, (15.0, 15.0, yaw_rate), floor, dt, rotor_lag)
            case = {"track": track, "published": published, "drone": drone, "yaw_rate": yaw_rate, "floor": floor}
            report("cpu", case="plan", **case, rotor_lag=rotor_lag, dt=dt, **times)
    for seconds, voltage, thrust in () if small else sagging_thrusts("uzh_5inch"):
        airframe = {"base": "uzh_5inch", "rotors": {"thrust_max": thrust / 4}}
        times = plan("split_s_gates", airframe, (15.0, 15.0, 3.0), 0.3, 0.04, False)
        report("cpu", case="battery", seconds=seconds, voltage=voltage, thrust=thrust, **times)


def plan(track: str, drone: Any, rates: tuple[float, ...], floor: float | None, dt: float, lag: bool) -> dict[str, Any]:
    start = time.process_time()
    flight = plan_race(load_track(track), drone, body_rate=rates, floor=floor, dt=dt, rotor_lag=lag)
    cpu_s = time.process_time() - start
    deviation = np.linalg.norm(fly_open_loop(flight)[:, :3] - flight.pos, axis=-1).max()
    return {
        "duration_s": round(flight.duration, 3),
        "deviation_cm": round_digits(100 * float(deviation)),
        "cpu_s": round_digits(cpu_s),
    }


def sagging_thrusts(drone: str) -> list[tuple[int, float, float]]:
    """Return times, s, voltages, V, and thrusts of all rotors, N, at full rotor speed from a full battery."""
    airframe, sim = load_airframe(drone), Sim(drone=drone, control="rotor_vel")
    sim.add(Battery())
    sim.rotor_vel_control(np.full((1, 1, 4), airframe.rotor_vel_limits.max()))
    results = []
    for before, now in zip((0, *SAG_TIMES), SAG_TIMES, strict=False):
        sim.step((now - before) * sim.freq)
        rotor_vel = np.asarray(sim.data.states.rotor_vel)[0, 0]
        thrust = np.polynomial.polynomial.polyval(rotor_vel, airframe.value("rotors.thrust_curve")).sum()
        voltage = float(sim.data.plugins["battery"].voltage[0, 0, 0])
        results.append((now, round_digits(voltage), round_digits(float(thrust))))
    return results


if __name__ == "__main__":
    main()
