"""Snapshots of a live simulation, to go back in time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from numpy.typing import NDArray

from crazysim.core.data import SimData


@dataclass(frozen=True, eq=False)
class Snapshot:
    """Data and commands at a control step."""

    step: int
    """Control step."""
    data: SimData
    """Data of the simulation; immutable, so a snapshot needs no copy."""
    commands: NDArray | None
    """Commands that processes had written; None before the first. (n_worlds, n_drones, k)"""


class History:
    """The first snapshot since a reset, and the latest snapshots."""

    def __init__(self, length: int):
        self._first: Snapshot | None = None
        self._latest: deque[Snapshot] = deque(maxlen=length)

    def add(self, snapshot: Snapshot) -> None:
        """Add a snapshot, unless the history has one of the same or a later step, as after a jump back."""
        if self._first is None:
            self._first = snapshot
        elif snapshot.step > (self._latest[-1] if self._latest else self._first).step:
            self._latest.append(snapshot)

    def rewind(self, step: int) -> Snapshot | None:
        """Remove the snapshots after a control step, and return the latest remaining snapshot; None if none remains."""
        while self._latest and self._latest[-1].step > step:
            self._latest.pop()
        if self._latest:
            return self._latest[-1]
        return self._first if self._first is not None and self._first.step <= step else None

    def clear(self) -> None:
        self._first = None
        self._latest.clear()
