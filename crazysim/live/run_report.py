"""Figures of a live run, put together."""

from __future__ import annotations

from collections.abc import Sequence

from crazysim.live.pace import LiveReport, Pace
from crazysim.live.process import Process

LISTED = 3
"""Most processes that a report lists."""


def make_report(
    pace: Pace, processes: Sequence[Process], simulated_s: float, wall_s: float, pictures: int, failures: int
) -> LiveReport:
    """Return the figures of a run.

    Args:
        pace: Pace of the run.
        processes: Processes of the loop.
        simulated_s: Simulated time, s.
        wall_s: Time without pauses, s.
        pictures: Number of pictures.
        failures: Number of errors of viewers and recordings that were passed over.
    """
    longest = sorted(processes, key=lambda process: -process.longest)[:LISTED]
    return LiveReport(
        simulated_s=simulated_s,
        wall_s=wall_s,
        steps=pace.steps,
        late=pace.late,
        lateness_999=pace.quantile(0.999),
        worst=pace.worst,
        worst_at=pace.worst_at,
        lost_s=pace.lost,
        pictures=pictures,
        slowest=", ".join(f"{p.name} {1e3 * p.longest:.1f} ms at {p.longest_at:.2f} s" for p in longest),
        failures=failures + sum(process.failures for process in processes),
    )
