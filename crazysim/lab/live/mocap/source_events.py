"""Reports of events in motion capture, swarms and links: kind, name, time and description."""

from __future__ import annotations

import logging
from collections import Counter, deque
from typing import NamedTuple

log = logging.getLogger(__name__)

MAX_REPORTS = 1000
"""Largest number of reports that are kept."""


class Report(NamedTuple):
    """One event, such as a lost frame or a refused command."""

    kind: str
    """Kind, such as ``"dropped"`` or ``"unknown"``."""
    name: str
    """Name of the body, drone or source."""
    time: float
    """Time of the event, s."""
    text: str
    """Description with numbers."""


class Reports:
    """The latest reports, and counts of all reports. Report 1, 10, 100, ... of each kind and name is logged."""

    def __init__(self) -> None:
        self.latest: deque[Report] = deque(maxlen=MAX_REPORTS)
        self.counts: Counter[tuple[str, str]] = Counter()

    def add(self, kind: str, name: str, time: float, text: str) -> None:
        """Add a report."""
        self.latest.append(Report(kind, name, time, text))
        self.counts[kind, name] += 1
        n = self.counts[kind, name]
        if n == 10 ** (len(str(n)) - 1):
            log.warning("%s %s at %.3f s: %s%s", name, kind, time, text, f" ({n} times)" if n > 1 else "")

    def count(self, kind: str) -> int:
        """Return the number of reports of a kind."""
        return sum(n for (k, _), n in self.counts.items() if k == kind)
