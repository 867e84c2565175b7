"""Films: images at a constant rate of simulated time, encoded as they are added.

The camera is the view's: ``envs/rendering.py`` makes the view of an environment, with the camera of its task.
"""

from __future__ import annotations

import contextlib
import math
import subprocess
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike

from crazysim.arguments import check_arguments, check_flag
from crazysim.errors import ConfigError, RenderError, optional_import, require
from crazysim.media.flight import Flight
from crazysim.media.flight_recorder import Clock, show_flight_at
from crazysim.media.view import View
from crazysim.media.worlds import require_world
from crazysim.progress import progress_bar
from crazysim.sim.sim import Sim
from crazysim.storage import check_writable, unfinished_path

ENCODERS = {
    # Fragments of a second, each written at once, keep the unfinished file readable if the program is killed.
    ".mp4": [
        "-c:v", "libx264", "-preset", "veryfast", "-pix_fmt", "yuv420p", "-crf", "22",
        "-movflags", "+frag_keyframe+empty_moov", "-flush_packets", "1",
    ],
    ".gif": ["-vf", "split[a][b];[a]palettegen[p];[b][p]paletteuse"],
}  # fmt: skip
"""Arguments of ffmpeg for each suffix."""


MAX_FPS = 1000
"""Largest number of frames per second of film."""


class Film:
    """A film of a simulation.

        with Film("flight.mp4", View(worlds=[0, 1, 2, 3]), fps=30) as film:
            for _ in range(500):
                sim.step(10)
                film.add(sim)

    Its clock is the simulated time of the first world shown; a reset of that world does not set the clock back. ``add``
    draws nothing before the next frame is due; if several frames are due, they all show the same image.
    """

    n_frames: int
    """Number of frames so far."""

    @check_arguments
    def __init__(
        self,
        path: str | Path,
        view: View | None = None,
        fps: float = 30,
        speed: float = 1.0,
        progress: bool = False,
        total: int | None = None,
    ):
        self.path, self.view = Path(path), View() if view is None else view
        check_writable(self.path, tuple(ENCODERS))
        # The working directory may change, and ffmpeg would take the relative path -y.mp4 for an option.
        self._absolute_path = self.path.absolute()
        self._unfinished_path = unfinished_path(self._absolute_path)
        for name, value in (("fps", fps), ("speed", speed)):
            require(np.isfinite(value) and value > 0, f"expected a positive {name}, got {value!r}")
        require(fps <= MAX_FPS, f"expected fps of at most {MAX_FPS}, got {fps!r}. Use a smaller speed for slow motion.")
        size = self.view.width, self.view.height
        if self.path.suffix.lower() == ".mp4" and any(n % 2 for n in size):
            even_size = [n + n % 2 for n in size]
            raise ConfigError(
                f"expected an even width and height for .mp4, got {size[0]} x {size[1]} pixels. Use "
                f"{even_size[0]} x {even_size[1]}."
            )
        self.fps, self.speed, self.n_frames = float(fps), float(speed), 0
        self._command = self._ffmpeg_command(*size)
        self._ffmpeg: subprocess.Popen[bytes] | None = None
        shows_progress = check_flag("progress", progress)
        self._bar = progress_bar(label="filming", required=True, total=total) if shows_progress else None
        self._clock = Clock()

    def add(self, sim: Sim) -> int:
        """Add the frames that are due, and return their number.

        Raises:
            RenderError: If this machine cannot draw, or the file cannot be written.
        """
        first_world = self.view.worlds[0]
        require_world(sim, first_world)
        elapsed = self._clock.elapsed_at(float(sim.time[first_world, 0]))
        n_due = int(elapsed * self.fps / self.speed + 1e-4) + 1 - self.n_frames
        if n_due > 0:
            self.write(self.view.render(sim), n_due)
        return max(n_due, 0)

    def play(self, sim: Sim, flight: Flight) -> int:
        """Add all frames of a recorded flight, and return their number.

        Args:
            sim: Simulation like the recorded one; its data is restored afterwards.

        Raises:
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
                show_flight_at(sim, flight, float(time))
                self.write(self.view.render(sim))
        finally:
            sim.data = data
        return len(times)

    def write(self, image: ArrayLike, n_frames: int = 1) -> None:
        """Add frames that show a given image.

        Args:
            image: Image of the view's size, uint8. (height, width, 3)

        Raises:
            RenderError: If the file cannot be written.
        """
        pixels, shape = np.asarray(image), (self.view.height, self.view.width, 3)
        require(
            pixels.shape == shape and pixels.dtype == np.uint8,
            f"expected an image of shape {shape}, uint8, got {pixels.shape}, {pixels.dtype}",
        )
        if self._ffmpeg is None:
            self._ffmpeg = subprocess.Popen(self._command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
        try:
            for _ in range(n_frames):
                self._ffmpeg.stdin.write(pixels.tobytes())
        except OSError:
            self._finish_file(self._ffmpeg)
        self.n_frames += n_frames
        if self._bar is not None:
            self._bar.update(n_frames)

    def close(self) -> None:
        """Finish the file.

        Raises:
            RenderError: If the file cannot be written.
        """
        if self._bar is not None:
            self._bar.close()
        if self._ffmpeg is not None:
            self._finish_file(self._ffmpeg)
        elif not self.n_frames:
            raise ConfigError(
                f"expected at least one frame of {str(self.path)!r}, got none. Call film.add(sim) between steps."
            )

    def _finish_file(self, ffmpeg: subprocess.Popen[bytes]) -> None:
        self._ffmpeg = None
        with contextlib.suppress(OSError):
            ffmpeg.stdin.close()
        message = ffmpeg.stderr.read().decode(errors="replace").strip()
        ffmpeg.stderr.close()
        if ffmpeg.wait() == 0:
            self._unfinished_path.replace(self._absolute_path)
        else:
            self._unfinished_path.unlink(missing_ok=True)
            raise RenderError(
                f"expected a file that can be written, got {str(self.path)!r}: {message or 'ffmpeg failed'}"
            )

    def _ffmpeg_command(self, width: int, height: int) -> list[str]:
        with optional_import("films need", "imageio-ffmpeg", "demo"):
            from imageio_ffmpeg import get_ffmpeg_exe
        input_options = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{self.fps:g}"]
        input_options += ["-i", "-"]
        key_frame_options = ["-g", f"{math.ceil(self.fps)}"]  # a key frame every second
        encoder_options = [*ENCODERS[self.path.suffix.lower()], *key_frame_options]
        output = str(self._unfinished_path)
        format_options = ["-f", self.path.suffix[1:].lower()]
        return [get_ffmpeg_exe(), "-loglevel", "error", *input_options, *encoder_options, *format_options, "-y", output]

    def __enter__(self) -> Film:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
            return
        with contextlib.suppress(ConfigError, RenderError):  # the earlier error is the one to raise
            self.close()
