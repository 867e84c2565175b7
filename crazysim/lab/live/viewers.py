"""The open viewers of a live simulation, and the rate of their pictures."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Generic, TypeVar

from crazysim.lab.live.viewer import Viewer

L = TypeVar("L")
"""Class of the live loop: ``crazysim.lab.live.Live``, which cannot be imported here."""

log = logging.getLogger(__name__)


class Viewers(Generic[L]):
    """Open viewers, which all get pictures at the same times. A viewer that fails is closed; other viewers continue."""

    period: float
    """Time between two pictures, s."""

    n_pictures: int
    """Number of pictures sent so far; a picture sent to several viewers counts once."""
    failures: int
    """Number of viewers that failed."""
    next_picture_time: float
    """Time of the next picture in the sequence of ``period``, s, by ``time.perf_counter``."""

    def __init__(self, fps: float, on_last_closed: Callable[[], object]):
        self.period = 1.0 / fps
        self.n_pictures = self.failures = 0
        self.next_picture_time = 0.0
        self._open_viewers: list[Viewer[L]] = []
        self._on_last_closed = on_last_closed

    def __bool__(self) -> bool:
        return bool(self._open_viewers)

    def open(self, live: L, viewer: Viewer[L]) -> None:
        """Open a viewer.

        Raises:
            RenderError: If this machine cannot show it, or a port is in use.
        """
        viewer.open(live)
        self._open_viewers.append(viewer)

    def draw(self, live: L, due_time: float) -> bool:
        """Send a picture to every viewer if ``due_time`` has come; return True if a picture was sent.

        Args:
            due_time: Earliest time of this picture, s, by ``time.perf_counter``.
        """
        now = time.perf_counter()
        if not self._open_viewers or now < due_time:
            return False
        self.next_picture_time = max(self.next_picture_time + self.period, now - self.period)
        self.update(live)
        return True

    def update(self, live: L) -> None:
        """Send a picture to every viewer, and remove viewers that are closed or fail."""
        for viewer in list(self._open_viewers):
            try:
                if viewer.is_open:
                    viewer.update(live)
                    continue
            except Exception as error:
                self.failures += 1
                log.warning("%s failed and is closed: %s", type(viewer).__name__, error)
            self._open_viewers = [x for x in self._open_viewers if x is not viewer]  # "is": viewers may compare equal
            viewer.close()
            if not self._open_viewers:
                self._on_last_closed()
        self.n_pictures += bool(self._open_viewers)

    def close(self) -> None:
        for viewer in self._open_viewers:
            viewer.close()
        self._open_viewers.clear()
