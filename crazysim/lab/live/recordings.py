"""Recordings of a live simulation, written sample by sample."""

from __future__ import annotations

import logging
from itertools import count
from pathlib import Path

from crazysim.media.flight_recorder import Recorder
from crazysim.sim.sim import Sim

log = logging.getLogger(__name__)


class Recordings:
    """The recording that is being written, if there is one, and the path that was requested last."""

    last_path: Path | None
    """Path that was requested last; None before the first recording."""
    failures: int
    """Number of recordings that ended because they could not be written."""

    def __init__(self, sim: Sim, control_freq: int):
        self.last_path, self.failures = None, 0
        self._sim, self._control_freq = sim, control_freq
        self._recorder: Recorder | None = None

    @property
    def is_open(self) -> bool:
        """True while a recording is being written."""
        return self._recorder is not None

    def start(self, path: str | Path, period: int) -> Path:
        """Finish the present recording, start another, write its first sample, and return its path.

        Args:
            path: Path; a number is added if it exists, so that no earlier recording is lost.
            period: Control steps from one sample to the next.

        Raises:
            ConfigError: If the file cannot be created.
        """
        self.close()
        self.last_path, unused_path = Path(path), free_path(Path(path))
        self._recorder, self._period, self._n_steps = Recorder(self._sim, path=unused_path), period, 0
        self.add()
        return unused_path

    def add(self) -> None:
        """Write a sample if one is due, at the start and after every control step.

        If writing fails, as on a full disk, the recording ends and the flight continues.
        """
        if self._recorder is None:
            return
        step, self._n_steps = self._n_steps, self._n_steps + 1
        if step % self._period:
            return
        try:
            self._recorder.add(step / self._control_freq)
        except OSError as error:
            log.warning("recording %s ended after %.2f s: %s", self.last_path, step / self._control_freq, error)
            self.failures += 1
            self.close()

    def close(self) -> None:
        """Finish the recording, if there is one."""
        if self._recorder is not None:
            self._recorder.close()
            self._recorder = None


def free_path(path: Path) -> Path:
    """Return the path if it does not exist, else the first unused path with a number after its name."""
    candidates = (path.with_name(f"{path.stem}-{k}{path.suffix}") for k in count(2))
    return path if not path.exists() else next(candidate for candidate in candidates if not candidate.exists())
