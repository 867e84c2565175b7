"""Motion capture systems of laboratories, read through the package ``motioncapture`` (libmotioncapture).

That package holds Python's global interpreter lock while it waits for the network (seen with its version 1.1, for
OptiTrack and Vicon), which would stop the simulation too. It therefore runs in another process, and a thread reads the
frames from a pipe.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import threading
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from crazysim.errors import ConfigError, not_installed, require
from crazysim.lab.live.mocap.frames import Convention, Frame
from crazysim.lab.live.mocap.source import ThreadSource

SYSTEMS = ("optitrack", "vicon", "qualisys", "vrpn", "nokov", "motionanalysis")
"""Systems by their names in the package; a release may have been built without some of them."""
WORKER_PROGRAM = Path(__file__).with_name("worker.py")
"""Program that runs the package."""
MAX_LINE_BYTES = 1 << 20
"""Longest line of the worker, bytes."""


class MotionCaptureSource(ThreadSource):
    """Rigid bodies of OptiTrack (NatNet), Vicon, Qualisys, VRPN and others.

    The package passes no time stamps, so ``stamp`` is the time at which the worker received a frame.
    """

    def __init__(
        self,
        system: str,
        hostname: str,
        convention: Convention | None = None,
        command: list[str] | None = None,
    ):
        require(system in SYSTEMS, f"expected one of {', '.join(SYSTEMS)}, got {system!r}")
        if command is None and find_spec("motioncapture") is None:
            raise ConfigError(not_installed("motion capture needs", "motioncapture", "mocap"))
        super().__init__(f"{system} at {hostname}", convention)
        command = [sys.executable, str(WORKER_PROGRAM)] if command is None else command
        self._worker = subprocess.Popen([*command, system, hostname], stdout=subprocess.PIPE, stdin=subprocess.DEVNULL)
        self.start()

    def stream(self, stop_event: threading.Event) -> Iterator[Frame]:
        while not stop_event.is_set():
            line = self._worker.stdout.readline(MAX_LINE_BYTES)
            if not line:
                raise ConnectionError(f"the worker ended with code {self._worker.wait()}")
            message = json.loads(line)
            if "error" in message:
                raise ConnectionError(message["error"])
            yield parse_frame(message)

    def close(self) -> None:
        self._stop_event.set()
        self._worker.kill()
        super().close()
        self._worker.wait()
        if self._worker.stdout is not None:
            self._worker.stdout.close()


def parse_frame(message: dict) -> Frame:
    """Return the frame of a worker's message: ``{"t": s, "bodies": [[name, x, y, z, qx, qy, qz, qw], ...]}``.

    Raises:
        ValueError: If the message is malformed.
    """
    bodies = message["bodies"]
    if not all(len(body) == 8 and isinstance(body[0], str) for body in bodies):
        raise ValueError(f"expected bodies of a name and 7 numbers, got {bodies!r:.200}")
    poses = np.array([body[1:] for body in bodies], float).reshape(len(bodies), 7)
    stamp = float(message["t"])
    require(math.isfinite(stamp), f"expected a finite time, got {stamp}", ValueError)
    return Frame(stamp, tuple(body[0] for body in bodies), poses[:, :3], poses[:, 3:], stamp)
