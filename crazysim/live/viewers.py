"""The viewers of a live simulation, and the times at which they get pictures."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING

from crazysim.live.viewer import Viewer

if TYPE_CHECKING:
    from crazysim.live.loop import Live

log = logging.getLogger(__name__)


class Viewers:
    """Open viewers, which get pictures at one rate; one that fails is closed, and the others continue."""

    n_pictures: int
    """Number of pictures so far."""
    failures: int
    """Number of viewers that failed."""
    next_at: float
    """Time at which the next picture is due, s, by ``time.perf_counter``."""

    def __init__(self, fps: float):
        """Begin without viewers.

        Args:
            fps: Pictures per second.
        """
        self.period = 1.0 / fps
        self.n_pictures = self.failures = 0
        self.next_at = 0.0
        self._open: list[Viewer] = []

    def __bool__(self) -> bool:
        """Return True if a viewer is open."""
        return bool(self._open)

    def open(self, live: Live, viewer: Viewer) -> None:
        """Open a viewer.

        Raises:
            RenderError: If this machine cannot show it, or a port is in use.
        """
        viewer.open(live)
        self._open.append(viewer)

    def draw(self, live: Live, due: float) -> bool:
        """Send a picture to every viewer if a time has come, and return True if it has."""
        now = time.perf_counter()
        if not self._open or now < due:
            return False
        self.next_at = max(self.next_at + self.period, now - self.period)
        self.update(live)
        return True

    def update(self, live: Live) -> None:
        """Send a picture to every viewer, and stop the loop with the last one."""
        for viewer in list(self._open):
            try:
                if viewer.is_open:
                    viewer.update(live)
                    continue
            except Exception as error:
                self.failures += 1
                log.warning("%s failed at %.2f s and is closed: %s", type(viewer).__name__, live.time, error)
            self._open.remove(viewer)
            viewer.close()
            if not self._open:
                live.stop()
        self.n_pictures += bool(self._open)

    def close(self) -> None:
        """Close all viewers."""
        for viewer in self._open:
            viewer.close()
        self._open.clear()
