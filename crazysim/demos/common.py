"""Parts common to the demonstrations: frames, and a film of world 0 that is made while the drones fly."""

from __future__ import annotations

import time
from pathlib import Path

import jax

from crazysim.errors import RenderError
from crazysim.media import Film, View
from crazysim.sim.sim import Sim

FPS = 25
"""Rate of frames, Hz."""


def frames_of(seconds: float) -> int:
    """Return the number of frames of a flight.

    Raises:
        ValueError: If the flight is shorter than one frame.
    """
    if seconds < 1 / FPS:
        raise ValueError(f"expected --seconds of at least {1 / FPS}, got {seconds}; use a longer flight")
    return round(seconds * FPS)


def counted(n: int, noun: str) -> str:
    """Return a number with a noun in singular or plural, such as "1 world" or "1,024 worlds"."""
    return f"{n:,} {noun}{'s' * (n != 1)}"


class FilmedFlight:
    """Steps by frames, with the time that they take, and a film unless this machine cannot make one."""

    def __init__(self, sim: Sim, path: Path, view: View, film: bool):
        """Prepare the film.

        Args:
            sim: Simulation.
            path: File of the film.
            view: Camera of the film.
            film: True to make a film.
        """
        self._sim, self._path = sim, path
        self._film = None
        self._seconds: list[float] = []
        try:
            self._film = Film(path, view, fps=FPS) if film else None
        except ImportError as error:
            print(f"no film: {error}")

    def fly_frame(self) -> None:
        """Step to the next frame."""
        begin = time.perf_counter()
        self._sim.step(self._sim.freq // FPS)
        jax.block_until_ready(self._sim.data.states.pos)
        self._seconds.append(time.perf_counter() - begin)

    def film_frame(self) -> None:
        """Film the frame; print one line where that is impossible, and make no film."""
        if self._film is None:
            return
        try:
            self._film.add(self._sim)
        except (ImportError, RenderError) as error:
            print(f"no film: {error}")
            self._film = None

    def print_rate(self) -> None:
        """Print the steps per second of all drones, without the first frame, which compiles."""
        n_steps = self._sim.n_worlds * self._sim.n_drones * (len(self._seconds) - 1) * (self._sim.freq // FPS)
        print(f"steps per second  {n_steps / max(sum(self._seconds[1:]), 1e-9) / 1e6:.2f} M")

    def close_film(self) -> None:
        """Write the film, if there is one."""
        if self._film is not None:
            self._film.close()
            print(f"wrote {self._path}")
