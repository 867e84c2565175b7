"""Motion capture: time of one frame of many objects, from its arrival to the poses in the data.

    python benchmarks/mocap.py --objects 50 --freq 240 --seconds 10

A thread sends frames in real time, and the simulation takes them between control steps, as a live loop does. One JSON
line has two times, as median and 99th percentile: of a frame in the tracker, and of an update of the scene.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import jax
import numpy as np
from measure import report, round_digits

from crazysim import Sim
from crazysim.lab.live.mocap import FunctionSource, RealTimeSource, Twin, Twins


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", type=int, default=50, help="number of tracked objects")
    parser.add_argument("--freq", type=float, default=240.0, help="frames per second, Hz")
    parser.add_argument("--seconds", type=float, default=10.0, help="real time to measure, s")
    args = parser.parse_args()
    measure(args.objects, args.freq, args.seconds)


def circling_bodies(n_objects: int) -> Callable[[float], dict]:
    """Return a function of time, s, that returns the poses of objects, which circle around different centres."""
    phases = np.arange(n_objects)

    def bodies(t: float) -> dict:
        xy = np.stack([phases % 10 + 0.2 * np.cos(t + phases), phases // 10 + 0.2 * np.sin(t + phases)], axis=-1)
        half = 0.5 * np.sin(t)
        quat = (0.0, 0.0, np.sin(half), np.cos(half))
        return {f"cf{k}": ((*p, 1.0), quat) for k, p in enumerate(xy.tolist())}

    return bodies


def measure(n_objects: int, freq: float, seconds: float) -> None:
    bodies = circling_bodies(n_objects)
    sim = Sim(n_drones=4, control="state")
    source = RealTimeSource(FunctionSource(bodies, freq))
    twins = Twins(sim, source, {"cf": Twin.drone()}, [f"cf{k}" for k in range(n_objects)])
    twins.update(sim)
    sim.step(5)
    twins.update(sim)

    source.start()
    update_times, n_steps, start_time = [], 0, time.monotonic()
    while time.monotonic() - start_time < seconds:
        sim.step(5)
        jax.block_until_ready(sim.data.states.pos)
        step_start = time.perf_counter()
        twins.update(sim)
        jax.block_until_ready(sim.data.objects.pos)  # type: ignore[union-attr]
        update_times.append(time.perf_counter() - step_start)
        n_steps += 1
        time.sleep(max(start_time + n_steps / 100 - time.monotonic(), 0.0))
    twins.close()

    frames = [FunctionSource(bodies, freq).frame(100 + k / freq) for k in range(500)]
    rule_times = []
    for frame in frames:
        step_start = time.perf_counter()
        twins.tracker.accept(frame)
        rule_times.append(time.perf_counter() - step_start)
    report(
        "cpu",
        benchmark="mocap",
        n_objects=n_objects,
        freq=freq,
        frames=twins.tracker.n_frames - len(frames),
        lost=twins.reports.count("overrun"),
        frame_ms=round_digits(1e3 * float(np.median(rule_times))),
        frame_p99_ms=round_digits(1e3 * float(np.percentile(rule_times, 99))),
        update_ms=round_digits(1e3 * float(np.median(update_times))),
        update_p99_ms=round_digits(1e3 * float(np.percentile(update_times, 99))),
    )


if __name__ == "__main__":
    main()
