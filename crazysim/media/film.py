"""Films: pictures at a rate of simulated time, encoded as they come."""

from __future__ import annotations

import contextlib
import subprocess
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from crazysim.errors import ConfigError, RenderError
from crazysim.media.flight import Flight
from crazysim.media.recording import Clock, put
from crazysim.media.view import View
from crazysim.sim.sim import Sim

ENCODERS = {
    ".mp4": ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "22", "-movflags", "+faststart"],
    ".gif": ["-vf", "split[a][b];[a]palettegen[p];[b][p]paletteuse"],
}
"""How each kind of file is encoded."""


class Film:
    """A file that takes pictures of a simulation while it flies.

        with Film("flight.mp4", View(worlds=[0, 1, 2, 3]), fps=30) as film:
            for _ in range(500):
                sim.step(10)
                film.add(sim)

    Its clock is that of the first world shown: of calls that come faster than frames only those are drawn that are
    due, and where they come slower a picture stays for several frames. A reset does not turn it back.
    """

    n_frames: int
    """Frames so far."""

    def __init__(
        self,
        path: str | Path,
        view: View | None = None,
        fps: float = 30,
        speed: float = 1.0,
        progress: bool = False,
        total: int | None = None,
    ):
        """Prepare a film; the file comes to be with its first frame.

        Args:
            path: An ``.mp4`` or a ``.gif``.
            view: What is seen; world 0 in 1280 x 720 pixels if left out.
            fps: Frames per second of film.
            speed: Simulated seconds per second of film: 0.1 is slow motion, 10 a time lapse.
            progress: Whether to show a bar, which needs tqdm.
            total: How many frames there will be, for the bar.

        Raises:
            ConfigError: If no such film can be.
            ImportError: If imageio-ffmpeg, or tqdm for a bar, is not installed.
        """
        self.path, self.view = Path(path), View() if view is None else view
        if self.path.suffix.lower() not in ENCODERS:
            raise ConfigError(f"{self.path} is no film; its name must end with {' or '.join(ENCODERS)}")
        if not self.path.parent.is_dir():
            raise ConfigError(f"{self.path} cannot be written: there is no folder {self.path.parent}")
        for name, value in (("fps", fps), ("speed", speed)):
            if not np.isfinite(value) or value <= 0:
                raise ConfigError(f"{name} is {value!r}; it must be positive")
        size = self.view.width, self.view.height
        if self.path.suffix.lower() == ".mp4" and any(n % 2 for n in size):
            even = [n + n % 2 for n in size]
            raise ConfigError(
                f"H.264 has even sizes only, not {size[0]} x {size[1]} pixels; {even[0]} x {even[1]} would do"
            )
        self.fps, self.speed, self.n_frames = float(fps), float(speed), 0
        self._command = self._encode(*size)
        self._ffmpeg: subprocess.Popen[bytes] | None = None
        self._bar = _bar(total) if progress else None
        self._clock = Clock()

    def add(self, sim: Sim) -> int:
        """Take the pictures that are due, and return how many frames that made.

        Raises:
            ValueError: If the view shows what the simulation has not.
            RenderError: If this machine cannot draw, or the file cannot be written.
        """
        first = self.view.worlds[0]
        if first not in range(sim.n_worlds):
            raise ConfigError(f"world {first!r} does not exist; worlds go from 0 to {sim.n_worlds - 1}")
        elapsed = self._clock.at(float(sim.time[first, 0]))
        due = int(elapsed * self.fps / self.speed + 1e-4) + 1 - self.n_frames
        if due > 0:
            self.write(self.view.picture(sim), due)
        return max(due, 0)

    def play(self, sim: Sim, flight: Flight) -> int:
        """Take a whole recorded flight, and return how many frames that made.

        Args:
            sim: A simulation like the one that was recorded; afterwards its data is what it was.
            flight: The flight.

        Raises:
            ValueError: If the simulation is another, or the view shows a world that was not recorded.
            RenderError: If this machine cannot draw, or the file cannot be written.
        """
        for world in self.view.worlds:
            flight.index(world)
        data = sim.data
        times = np.arange(0, flight.time[-1] + 1e-4 * self.speed / self.fps, self.speed / self.fps)
        if self._bar is not None and self._bar.total is None:
            self._bar.total = len(times)
        try:
            for time in times:
                put(sim, flight, float(time))
                self.write(self.view.picture(sim))
        finally:
            sim.data = data
        return len(times)

    def write(self, picture: ArrayLike, n_frames: int = 1) -> None:
        """Add a picture of one's own for some frames.

        Args:
            picture: (height, width, 3), uint8, in the view's size.
            n_frames: For how many.

        Raises:
            ConfigError: If it is no such picture.
            RenderError: If the file cannot be written.
        """
        pixels, needed = np.asarray(picture), (self.view.height, self.view.width, 3)
        if pixels.shape != needed or pixels.dtype != np.uint8:
            raise ConfigError(f"this film takes pictures of shape {needed}, uint8; got {pixels.shape}, {pixels.dtype}")
        if self._ffmpeg is None:
            self._ffmpeg = subprocess.Popen(self._command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
        try:
            for _ in range(n_frames):
                self._ffmpeg.stdin.write(pixels.tobytes())
        except OSError:
            self._end(self._ffmpeg)
        self.n_frames += n_frames
        if self._bar is not None:
            self._bar.update(n_frames)

    def close(self) -> None:
        """Finish the file.

        Raises:
            ConfigError: If it has no frame.
            RenderError: If it could not be written.
        """
        if self._bar is not None:
            self._bar.close()
        if self._ffmpeg is not None:
            self._end(self._ffmpeg)
        elif not self.n_frames:
            raise ConfigError(f"nothing was recorded, so there is no {self.path}; call film.add(sim) between steps")

    def _end(self, ffmpeg: subprocess.Popen[bytes]) -> None:
        self._ffmpeg = None
        with contextlib.suppress(OSError):
            ffmpeg.stdin.close()
        message = ffmpeg.stderr.read().decode(errors="replace").strip()
        ffmpeg.stderr.close()
        if ffmpeg.wait() != 0:
            raise RenderError(f"{self.path} could not be written: {message or 'ffmpeg failed'}")

    def _encode(self, width: int, height: int) -> list[str]:
        try:
            from imageio_ffmpeg import get_ffmpeg_exe
        except ImportError as error:
            raise ImportError("films need imageio-ffmpeg; pip install 'crazysim[demo]'") from error
        raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{self.fps:g}", "-i", "-"]
        encoder = ENCODERS[self.path.suffix.lower()]
        return [get_ffmpeg_exe(), "-loglevel", "error", *raw, *encoder, "-y", str(self.path)]

    def __enter__(self) -> Film:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
            return
        with contextlib.suppress(ConfigError, RenderError):  # what went wrong before is what matters
            self.close()


def _bar(total: int | None) -> Any:
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise ImportError("progress=True needs tqdm; pip install 'crazysim[demo]'") from error
    return tqdm(total=total, desc="filming", unit="frame", ncols=80)
