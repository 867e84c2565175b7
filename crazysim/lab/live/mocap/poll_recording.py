"""Recordings of motion capture, which stay readable after a crash, and their replay.

A file is a journal (``crazysim.media.journal``) of names of bodies (JSON) and of polls with their frames: what a source
sent, exactly and with its losses, which the poses of a recorded flight do not tell.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from crazysim.errors import require
from crazysim.lab.live.mocap.frames import Frame
from crazysim.lab.live.mocap.source import MocapSource, Poll
from crazysim.media.journal import Journal, read_journal
from crazysim.storage import Closeable, wrap_read_errors

NAMES_CHUNK, POLL_CHUNK = b"NAME", b"POLL"
"""Kinds of chunks: names of bodies that were not seen before, and a poll."""
POLL_LAYOUT = struct.Struct("<dII")
"""Layout of a poll before its frames: time, s, number of frames, and number of frames lost."""
FRAME_LAYOUT = struct.Struct("<ddI")
"""Layout of a frame before its bodies: stamp and time of arrival, s, and number of bodies."""


class MocapRecorder(Closeable):
    """Writer of a recording."""

    def __init__(self, path: str | Path):
        self._journal = Journal(path, replace=True)
        self._ids: dict[str, int] = {}

    def write(self, poll: Poll) -> None:
        """Append a poll with its frames, without keeping them in memory."""
        new_names = [name for frame in poll.frames for name in frame.names if name not in self._ids]
        if new_names:
            new_names = list(dict.fromkeys(new_names))
            self._ids.update({name: k for k, name in enumerate(new_names, start=len(self._ids))})
            self._journal.append(NAMES_CHUNK, json.dumps(new_names).encode())
        parts = [POLL_LAYOUT.pack(poll.now, len(poll.frames), poll.lost)]
        for frame in poll.frames:
            ids = np.array([self._ids[name] for name in frame.names], "<u4")
            poses = np.concatenate([frame.pos, frame.quat], axis=1).astype("<f8")
            parts += [FRAME_LAYOUT.pack(frame.stamp, frame.received, len(ids)), ids.tobytes(), poses.tobytes()]
        self._journal.append(POLL_CHUNK, b"".join(parts))

    def close(self) -> None:
        self._journal.close()


def read_polls(path: str | Path) -> Iterator[Poll]:
    """Yield the polls of a recording.

    Raises:
        ConfigError: If the file does not exist.
        DamagedFileError: If the file is not a recording.
    """
    remedy = "Write a recording with Twins(..., record=path)."
    names: list[str] = []
    with wrap_read_errors(path, "a recording of motion capture", remedy):
        for kind, content in read_journal(path):
            if kind == NAMES_CHUNK:
                names += json.loads(content)
            elif kind == POLL_CHUNK:
                yield _parse_poll(content, names)
            else:
                raise ValueError(f"expected chunks of kinds {NAMES_CHUNK!r} and {POLL_CHUNK!r}, got {kind!r}")


def _parse_poll(content: bytes, names: list[str]) -> Poll:
    now, n_frames, lost = POLL_LAYOUT.unpack_from(content)
    offset, frames = POLL_LAYOUT.size, []
    for _ in range(n_frames):
        stamp, received, n = FRAME_LAYOUT.unpack_from(content, offset)
        offset += FRAME_LAYOUT.size
        ids = np.frombuffer(content, "<u4", n, offset)
        poses = np.frombuffer(content, "<f8", 7 * n, offset + 4 * n).reshape(n, 7)
        offset += 60 * n
        frames.append(Frame(stamp, tuple(names[k] for k in ids), poses[:, :3], poses[:, 3:], received))
    return Poll(now, frames, lost)


class ReplaySource(MocapSource):
    """Source of the frames in a recording.

    With ``by="poll"``, the k-th poll returns the frames of the k-th recorded poll. A simulation that takes the same
    steps between polls as in the recording then reproduces the run bit for bit. With ``by="time"``, a frame that
    arrived t seconds after the first frame is returned at simulated time t, whichever steps the simulation takes.
    """

    def __init__(self, path: str | Path, by: str = "poll"):
        require(by in ("poll", "time"), f"expected by as 'poll' or 'time', got {by!r}")
        self.name, self.by, self.path = f"replay of {Path(path).name}", by, path
        self.simulated = by == "time"
        self._polls = list(read_polls(path))
        self._frames = [frame for poll in self._polls for frame in poll.frames]
        self._next_index, self._step = 0, -1
        self._offset = self._frames[0].received if self._frames else 0.0

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self._frames)

    @property
    def duration(self) -> float:
        """Time from the first to the last frame, s."""
        return self._frames[-1].received - self._offset if self._frames else 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all bodies."""
        return tuple(dict.fromkeys(name for frame in self._frames for name in frame.names))

    @property
    def ended(self) -> str | None:
        n = len(self._polls) if self.by == "poll" else len(self._frames)
        return "the recording ended" if self._next_index >= n else None

    def poll(self, step: int, freq: int) -> Poll:
        if self.by == "poll":
            if self._next_index < len(self._polls):
                self._next_index += 1
                return self._polls[self._next_index - 1]
            return Poll(self._polls[-1].now if self._polls else 0.0, [])
        if step < self._step:
            self._next_index = 0
        self._step, now = step, step / freq + self._offset
        first = self._next_index
        while self._next_index < len(self._frames) and self._frames[self._next_index].received <= now + 1e-9:
            self._next_index += 1
        return Poll(now, self._frames[first : self._next_index])
