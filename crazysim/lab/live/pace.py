"""Pace of a live simulation: when each control step is due, and how late it began."""

from __future__ import annotations

import contextlib
import gc
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Literal

import numpy as np

from crazysim.errors import require
from crazysim.lab.live.process import Process

Speed = float | Literal["max"]
"""Simulated seconds per second, or ``"max"`` for as fast as possible."""
LATE_TOLERANCE = 2e-3
"""Lateness above which a control step counts as late, s."""
MAX_LAG = 0.25
"""Lateness above which the loop gives up the lost time instead of catching up, s."""
BIN_WIDTH = 1e-4
"""Width of the bins of the statistics of lateness, s."""
SWITCH_INTERVAL = 5e-4
"""Time after which another Python thread yields to the loop, s."""
N_BINS = 5000
"""Number of bins of the statistics of lateness; the last bin also counts any greater lateness."""
MAX_LISTED_PROCESSES = 3
"""Largest number of processes that a report lists."""


def check_speed(speed: Speed) -> Speed:
    if speed == "max":
        return "max"
    require(
        not isinstance(speed, (bool, str)) and np.isfinite(speed) and speed > 0,
        f"expected a positive speed or 'max', got {speed!r}",
    )
    return float(speed)


@dataclass(frozen=True)
class LiveReport:
    """Figures of a live run."""

    simulated_s: float
    """Simulated time, s."""
    wall_s: float
    """Wall-clock time without pauses, s."""
    n_steps: int
    """Number of control steps."""
    n_late_steps: int
    """Number of control steps that began more than ``LATE_TOLERANCE`` late."""
    lateness_999: float
    """Lateness that 99.9% of the control steps did not exceed, s; 0 at ``speed="max"``."""
    max_lateness: float
    """Greatest lateness, s."""
    max_lateness_time: float
    """Simulated time at which it occurred, s."""
    lost_s: float
    """Time that was given up because the simulation could not catch up, s."""
    n_pictures: int
    """Number of pictures sent to viewers."""
    slowest_processes: str
    """Processes with the longest calls, the longest first; empty without processes."""
    failures: int
    """Number of errors that were logged without ending the run."""

    @property
    def factor(self) -> float:
        """Achieved number of simulated seconds per second."""
        return self.simulated_s / self.wall_s if self.wall_s > 0 else 0.0

    def __str__(self) -> str:
        lines = [f"{self.simulated_s:.2f} s in {self.wall_s:.2f} s: {self.factor:.2f} times real time"]
        if self.max_lateness > 0:
            lines.append(
                f"control steps     {self.n_steps}, {self.n_late_steps} more than {1e3 * LATE_TOLERANCE:g} ms late; "
                f"99.9% within {1e3 * self.lateness_999:.1f} ms, worst {1e3 * self.max_lateness:.1f} ms at "
                f"{self.max_lateness_time:.2f} s"
            )
        if self.lost_s > 0:
            lines.append(f"real time missed  {self.lost_s:.2f} s were given up; use a lower speed or fewer pictures")
        if self.n_pictures:
            lines.append(f"pictures          {self.n_pictures}, {self.n_pictures / self.wall_s:.1f} per second")
        if self.slowest_processes:
            lines.append(f"longest calls     {self.slowest_processes}")
        if self.failures:
            lines.append(f"failures          {self.failures}, see the log")
        return "\n".join(lines)


class Pace:
    """Due times of control steps, and statistics of their lateness in constant memory."""

    n_steps: int
    """Number of control steps so far."""
    n_late_steps: int
    """Number of control steps that began more than ``LATE_TOLERANCE`` late."""
    max_lateness: float
    """Greatest lateness, s."""
    max_lateness_time: float
    """Simulated time at which it occurred, s."""
    lost_s: float
    """Time that was given up because the simulation could not catch up, s."""

    def __init__(self, dt: float, speed: Speed, clock: Callable[[], float] = perf_counter):
        self._dt, self._clock = dt, clock
        self._speed: Speed = check_speed(speed)
        self._counts = np.zeros(N_BINS, np.int64)
        self.n_steps = self.n_late_steps = 0
        self.max_lateness = self.max_lateness_time = self.lost_s = 0.0
        self._due_time = clock()

    @property
    def speed(self) -> Speed:
        """Simulated seconds per second, or ``"max"``; assigning to it takes effect at once."""
        return self._speed

    @speed.setter
    def speed(self, speed: Speed) -> None:
        self._speed = check_speed(speed)
        self.restart()

    def restart(self) -> None:
        """Make the next control step due now, after a pause or a jump in time."""
        self._due_time = self._clock()

    def time_until_due(self) -> float:
        """Return the time until the next control step is due, s; zero or negative if it is due already."""
        return 0.0 if self._speed == "max" else self._due_time - self._clock()

    def record_step(self, time: float) -> float:
        """Record the start of a control step, and return its lateness, s.

        Args:
            time: Simulated time, s.
        """
        self.n_steps += 1
        if self._speed == "max":
            return 0.0
        lateness = max(self._clock() - self._due_time, 0.0)
        self._counts[min(int(lateness / BIN_WIDTH), N_BINS - 1)] += 1
        self.n_late_steps += lateness > LATE_TOLERANCE
        if lateness > self.max_lateness:
            self.max_lateness, self.max_lateness_time = lateness, time
        if lateness > MAX_LAG:
            self.lost_s += lateness
            self.restart()
        self._due_time += self._dt / float(self._speed)
        return lateness

    def quantile(self, fraction: float) -> float:
        """Return the lateness that a fraction of the control steps, 0 to 1, did not exceed, s."""
        total = self._counts.sum()
        if not total:
            return 0.0
        bin_index = int(np.searchsorted(np.cumsum(self._counts), fraction * total))
        return min((bin_index + 1) * BIN_WIDTH, self.max_lateness) if bin_index < N_BINS - 1 else self.max_lateness

    def report(
        self, processes: Sequence[Process], simulated_s: float, wall_s: float, n_pictures: int, failures: int
    ) -> LiveReport:
        """Return the figures of a run.

        Args:
            simulated_s: Simulated time, s.
            wall_s: Wall-clock time without pauses, s.
            failures: Number of logged errors of requests, viewers and recordings; errors of the processes are added.
        """
        slowest = sorted(processes, key=lambda process: -process.longest_call)[:MAX_LISTED_PROCESSES]
        slowest_processes = ", ".join(
            f"{p.name} {1e3 * p.longest_call:.1f} ms at {p.longest_call_time:.2f} s" for p in slowest
        )
        failures += sum(process.failures for process in processes)
        return LiveReport(
            simulated_s, wall_s, self.n_steps, self.n_late_steps, self.quantile(0.999), self.max_lateness,
            self.max_lateness_time, self.lost_s,
            n_pictures, slowest_processes, failures,
        )  # fmt: skip


@contextlib.contextmanager
def protect_loop() -> Iterator[None]:
    """Keep other Python threads and the garbage collector from delaying the loop."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL)
    gc.freeze()  # exempt the objects of JAX and MuJoCo, whose collection takes 0.1 s and more
    try:
        yield
    finally:
        gc.unfreeze()
        sys.setswitchinterval(interval)
