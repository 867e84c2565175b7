"""Sources of motion capture frames: threads, functions of time, and trajectories of a show."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from crazysim.errors import require
from crazysim.lab.live.attitude import from_yaw
from crazysim.lab.live.host_trajectory import to_host_trajectories
from crazysim.lab.live.mocap.frames import Convention, Frame
from crazysim.storage import Closeable
from crazysim.trajectories import Trajectory

log = logging.getLogger(__name__)

MAX_QUEUED_FRAMES = 4096
"""Largest number of frames that wait for the reader, 17 s at 240 Hz; if more arrive, the oldest are lost."""


class Poll(NamedTuple):
    """Frames that have arrived since the last poll, and the time of the poll."""

    now: float
    """Time of the poll, s, on the clock of ``Frame.received``: this computer's or the simulation's."""
    frames: list[Frame]
    """Frames, in the order of their arrival."""
    lost: int = 0
    """Number of frames lost because the reader was too slow."""


class MocapSource(Closeable):
    """Interface of motion capture sources. ``poll`` never waits."""

    name: str = "mocap"
    """Name in reports."""
    simulated: bool = False
    """Whether the frames follow simulated time, which a reset sets back."""

    def poll(self, step: int, freq: int) -> Poll:
        """Return the frames that have arrived since the last call.

        Args:
            step: Number of physics steps of the simulation since its last reset.
            freq: Physics steps per second, Hz.
        """
        raise NotImplementedError

    @property
    def ended(self) -> str | None:
        """Reason for which the source sends no more frames; None while it may still send frames."""
        return None

    def close(self) -> None:
        """Disconnect."""


class FunctionSource(MocapSource):
    """Poses as a function of simulated time, sampled at a fixed rate; a run can be repeated bit for bit."""

    simulated = True

    def __init__(
        self,
        function: Callable[[float], Mapping[str, tuple[ArrayLike, ArrayLike]]],
        freq: float = 120.0,
        convention: Convention | None = None,
        name: str = "function",
    ):
        require(0 < freq < np.inf, f"expected a positive number of frames per second, got {freq!r}. Use freq=120.")
        self.name, self.freq = name, float(freq)
        self._function, self._convention, self._next_sample = function, convention or Convention(), 0

    def poll(self, step: int, freq: int) -> Poll:
        now = step / freq
        last = int(np.floor(now * self.freq + 1e-9))
        if last < self._next_sample - 1:
            self._next_sample = 0
        first, self._next_sample = max(self._next_sample, last + 1 - MAX_QUEUED_FRAMES), last + 1
        return Poll(now, [self.frame(k / self.freq) for k in range(first, last + 1)])

    def frame(self, stamp: float) -> Frame:
        """Return the frame of a time, s."""
        return self._convention.convert(Frame.of(stamp, dict(self._function(stamp))))


def show_source(
    trajectories: Trajectory | Sequence[Trajectory], names: Sequence[str] | None = None, freq: float = 120.0
) -> FunctionSource:
    """Make a source of level bodies that follow trajectories, such as a show's from ``load_show(path)``.

    Args:
        trajectories: One trajectory for each body, or one record with a leading axis.
        names: Names of the bodies; None for ``vcf0``, ``vcf1``, ...
        freq: Frames per second, Hz.
    """
    paths = to_host_trajectories(trajectories)
    names = [f"vcf{k}" for k in range(len(paths))] if names is None else list(names)
    require(
        len(names) == len(paths) and len(set(names)) == len(names),
        f"expected {len(paths)} different names, one for each trajectory, got {names}. Leave them out for vcf0, "
        f"vcf1, ...",
    )

    def poses_at(stamp: float) -> dict[str, tuple[ArrayLike, ArrayLike]]:
        points = [path.setpoint(stamp) for path in paths]
        return {n: (p[:3], from_yaw(p[3])) for n, p in zip(names, points, strict=True)}

    return FunctionSource(poses_at, freq, name="show")


class ThreadSource(MocapSource):
    """Base of sources that wait for frames in a thread, such as network clients.

    A subclass yields frames from ``stream`` in the convention of its system. An error in ``stream`` ends the source,
    not the simulation, and ``ended`` gives the reason.
    """

    def __init__(self, name: str, convention: Convention | None = None):
        self.name, self._convention = name, convention or Convention()
        self._frames: deque[Frame] = deque(maxlen=MAX_QUEUED_FRAMES)
        self._n_received = self._n_polled = 0
        self._end_reason: str | None = None
        self._stop_event = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"mocap-{name}", daemon=True)

    def start(self) -> ThreadSource:
        """Start the thread, and return the source."""
        self._thread.start()
        return self

    def stream(self, stop_event: threading.Event) -> Iterator[Frame]:
        """Yield frames until there are no more, or the event is set."""
        raise NotImplementedError

    def poll(self, step: int, freq: int) -> Poll:
        frames = []
        while self._frames:
            frames.append(self._frames.popleft())
        n_received = self._n_received  # read last, so that it counts at least the frames above
        lost = max(n_received - self._n_polled - len(frames) - len(self._frames), 0)
        self._n_polled += len(frames) + lost
        return Poll(time.monotonic(), frames, lost)

    @property
    def ended(self) -> str | None:
        return self._end_reason

    def close(self) -> None:
        self._stop_event.set()
        if self._thread.is_alive():
            self._thread.join(1.0)

    def _run(self) -> None:
        try:
            for frame in self.stream(self._stop_event):
                self._frames.append(self._convention.convert(frame))
                self._n_received += 1
                if self._stop_event.is_set():
                    return
            self._end_reason = "the stream ended"
        except Exception as error:
            self._end_reason = f"{type(error).__name__}: {error}"
            if not self._stop_event.is_set():
                log.warning("%s ended: %s", self.name, self._end_reason)


class RealTimeSource(ThreadSource):
    """Source that sends the frames of another source in real time, as a motion capture system would."""

    def __init__(self, source: FunctionSource, speed: float = 1.0):
        super().__init__(f"real-time {source.name}")
        self._source, self._speed = source, speed

    def stream(self, stop_event: threading.Event) -> Iterator[Frame]:
        start_time, k = time.monotonic(), 0
        while not stop_event.is_set():
            stamp = k / self._source.freq
            wait = start_time + stamp / self._speed - time.monotonic()
            if wait > 0 and stop_event.wait(wait):
                return
            frame = self._source.frame(stamp)
            yield Frame(frame.stamp, frame.names, frame.pos, frame.quat, time.monotonic())
            k += 1
