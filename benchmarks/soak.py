"""A live simulation with all its parts, run for a long time: memory, lateness of control steps, lost frames.

    python benchmarks/soak.py [--seconds 3600] [--drones 30] [--objects 50]

Drones circle in real time, and poses are recorded. Motion capture sends 240 frames a second, and a client of the page
receives 50 pictures a second. Linux only. The program prints one JSON line with these keys, among others:

- ``factor``: simulated seconds per second;
- ``memory_mb``: resident memory of the process, MB, at the first reading after a tenth of the time and at the end;
- ``growth_mb_per_hour``: slope of a line fitted to all readings after that tenth, MB/h;
- ``frames``, ``frames_lost``: frames of motion capture that were accepted, and polls that found lost frames;
- ``pictures_per_s``, ``recorded_mb``: pictures sent per second, and size of the recording, MB;
- ``late``: number of control steps that began more than 2 ms late;
- ``lateness_999_ms``, ``worst_ms``: 99.9th percentile and maximum of the lateness of control steps, ms;
- ``lost_s``: time that was given up because the simulation could not catch up, s;
- ``failures``: errors that were logged without ending the run.

Memory in the first tenth of the time is not counted, because programs are compiled then. In a run of ten minutes or
more, this tenth also contains the first minute, in which the snapshots of the loop reach their largest number.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from live import show_to_client
from measure import report, round_digits
from mocap import circling_bodies

from crazysim import Sim
from crazysim.lab.live import FunctionSource, Live, RealTimeSource, Twin, Twins
from crazysim.lab.live.circles import Circles

FREQ = 240.0
"""Frames per second of motion capture, Hz."""
WARM_UP = 0.1
"""Fraction of the run, from the beginning, in which readings of the memory are left out."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3600.0, help="time to run, s")
    parser.add_argument("--drones", type=int, default=30)
    parser.add_argument("--objects", type=int, default=50, help="number of tracked objects")
    args = parser.parse_args()
    measure(args.seconds, args.drones, args.objects)


def measure(seconds: float, n_drones: int, n_objects: int) -> None:
    """Run the simulation for a time, s, and print the line."""
    sim = Sim(n_drones=n_drones, control="state", freq=500)
    source = RealTimeSource(FunctionSource(circling_bodies(n_objects), FREQ))
    names = [f"cf{k}" for k in range(n_objects)]
    with (
        tempfile.TemporaryDirectory() as folder,
        Twins(sim, source, {"cf": Twin.drone()}, names) as twins,
        Live(sim, control_freq=100) as live,
        Memory(period_s=min(10.0, seconds / 100)) as memory,
    ):
        live.add(Circles(live, piloted=False), name="circles")
        live.add(twins, on_error="report")
        path = live.record(Path(folder) / "flight.journal")
        show_to_client(live)
        source.start()
        result = live.run(seconds)
        recorded = path.stat().st_size
    times, memory_mb = memory.samples(WARM_UP * seconds)
    report(
        "cpu",
        benchmark="soak",
        n_drones=n_drones,
        n_objects=n_objects,
        seconds=seconds,
        factor=round_digits(result.factor),
        memory_mb=[round(memory_mb[0]), round(memory_mb[-1])],
        growth_mb_per_hour=round_digits(3600 * np.polyfit(times, memory_mb, 1)[0]),
        frames=twins.tracker.n_frames,
        frames_lost=twins.reports.count("overrun"),
        pictures_per_s=round_digits(result.n_pictures / result.wall_s),
        recorded_mb=round_digits(1e-6 * recorded),
        late=result.n_late_steps,
        lateness_999_ms=round_digits(1e3 * result.lateness_999),
        worst_ms=round_digits(1e3 * result.max_lateness),
        lost_s=round_digits(result.lost_s),
        failures=result.failures,
    )


class Memory:
    """Resident memory of this process over time, read by a thread."""

    def __init__(self, period_s: float):
        self._period_s, self._readings, self._stop_event = period_s, [], threading.Event()

    def __enter__(self) -> Memory:
        self._start_time = time.monotonic()
        threading.Thread(target=self._read_memory, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop_event.set()

    def samples(self, start_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return times since the start of the thread, s (n,), and memory, MB (n,), of readings from ``start_s`` on."""
        times, memory_mb = np.asarray(self._readings).T
        return times[times >= start_s], memory_mb[times >= start_s]

    def _read_memory(self) -> None:
        size = os.sysconf("SC_PAGE_SIZE")
        while not self._stop_event.wait(self._period_s):
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            self._readings.append((time.monotonic() - self._start_time, 1e-6 * pages * size))


if __name__ == "__main__":
    main()
