"""Recordings of a live simulation, written as they come."""

from __future__ import annotations

import logging
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from crazysim.media.recording import Recorder
from crazysim.sim.sim import Sim

if TYPE_CHECKING:
    from crazysim.live.loop import Live

log = logging.getLogger(__name__)


class LiveRecording:
    """A file that poses are appended to."""

    path: Path
    """Path of the file."""

    def __init__(self, sim: Sim, path: str | Path, period: int):
        """Create the file.

        Args:
            sim: Simulation.
            path: Path; numbered if it exists, so that no earlier recording is lost.
            period: Control steps from one sample to the next.

        Raises:
            ConfigError: If it cannot be created.
        """
        self.path = free_path(Path(path))
        self._recorder = Recorder(sim, path=self.path)
        self._period = period
        self._begin: int | None = None

    def add(self, live: Live) -> bool:
        """Write a sample if one is due, and return False if that is impossible, for example for want of space."""
        if self._begin is None:
            self._begin = live.flown
        flown = live.flown - self._begin
        if flown % self._period:
            return True
        try:
            self._recorder.add(flown / live.control_freq)
        except OSError as error:
            log.warning("recording %s ended at %.2f s: %s", self.path, live.time, error)
            return False
        return True

    def close(self) -> None:
        """Finish the file."""
        self._recorder.close()


def free_path(path: Path) -> Path:
    """Return a path, or one with a number behind its name, that does not exist."""
    numbered = (path.with_name(f"{path.stem}-{k}{path.suffix}") for k in count(2))
    return path if not path.exists() else next(p for p in numbered if not p.exists())
