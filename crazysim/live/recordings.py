"""Recordings of a live simulation, written as they come."""

from __future__ import annotations

import logging
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from crazysim.media.flight_recorder import Recorder
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
        """Write a sample if one is due, and return False if it cannot be written, as on a full disk."""
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


class Recordings:
    """The recording that is being written, if there is one, and the path that was requested last."""

    last_path: Path | None
    """Path that was requested last; None before the first recording."""
    failures: int
    """Number of recordings that ended because they could not be written."""

    def __init__(self) -> None:
        """Begin without a recording."""
        self.last_path, self.failures = None, 0
        self._open: LiveRecording | None = None

    @property
    def is_open(self) -> bool:
        """True while a recording is being written."""
        return self._open is not None

    def start(self, live: Live, path: str | Path, period: int) -> Path:
        """Finish the present recording, begin another, and return its path.

        Args:
            live: Loop.
            path: Path; numbered if it exists.
            period: Control steps from one sample to the next.

        Raises:
            ConfigError: If it cannot be created.
        """
        self.close()
        self._open, self.last_path = LiveRecording(live.sim, path, period), Path(path)
        self._open.add(live)
        return self._open.path

    def add(self, live: Live) -> None:
        """Write a sample if one is due; a recording that cannot be written ends, and the flight continues."""
        if self._open is not None and not self._open.add(live):
            self.failures += 1
            self.close()

    def close(self) -> None:
        """Finish the recording, if there is one."""
        if self._open is not None:
            self._open.close()
            self._open = None


def free_path(path: Path) -> Path:
    """Return a path, or one with a number behind its name, that does not exist."""
    numbered = (path.with_name(f"{path.stem}-{k}{path.suffix}") for k in count(2))
    return path if not path.exists() else next(p for p in numbered if not p.exists())
