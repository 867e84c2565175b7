"""The live loop: control steps, pictures and recordings, each at its rate, in real time or at another speed."""

from __future__ import annotations

import contextlib
import logging
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from itertools import count
from pathlib import Path
from time import perf_counter, sleep
from typing import TypeVar

import jax
import numpy as np
from numpy.typing import NDArray

from crazysim.core.settings import positive_integer
from crazysim.errors import ConfigError, require
from crazysim.lab.live.history import History, Snapshot
from crazysim.lab.live.interaction import Interaction
from crazysim.lab.live.pace import LiveReport, Pace, Speed, protect_loop
from crazysim.lab.live.process import OnError, Process, RateLimit, steps_per_call
from crazysim.lab.live.staging import StagedCommands, compile_step
from crazysim.lab.live.viewer import Viewer
from crazysim.lab.live.viewers import Viewers
from crazysim.media.flight_recorder import Recorder
from crazysim.sim.sim import Sim
from crazysim.storage import Closeable

MAX_SLEEP = 0.01
"""Longest sleep before clicks and keys are handled again, s."""
WARNING_LATENESS = 0.02
"""Lateness of a control step above which a warning is logged, s."""
WARNING_PERIOD = 10.0
"""Shortest time between two warnings of lateness, s."""

V = TypeVar("V", bound="Viewer[Live]")
log = logging.getLogger(__name__)


class Live(Interaction, Closeable):
    """A simulation that advances in real time, or at any other speed, and can be watched and commanded.

        with Live(sim, control_freq=100) as live:
            live.show(Browser())
            live.record("flight.journal")
            print(live.run(seconds=20))

    The loop calls processes, timed events and requests of viewers between two steps, in one thread. They may read and
    write ``live.sim``; functions in other threads use ``post``.
    """

    step: int
    """Control steps since the last reset."""
    n_steps_run: int
    """Control steps since the loop was created; resets and jumps do not set it back."""

    def __init__(
        self,
        sim: Sim,
        control_freq: int = 100,
        speed: Speed = 1.0,
        fps: float = 50.0,
        snapshot_s: float = 1.0,
        n_snapshots: int = 60,
    ):
        control_freq = positive_integer("control_freq", control_freq)
        require(
            sim.freq % control_freq == 0,
            f"expected a control_freq that divides freq={sim.freq} Hz, got {control_freq!r} Hz",
        )
        for name, value in (("fps", fps), ("snapshot_s", snapshot_s)):
            require(np.isfinite(value) and value > 0, f"expected a positive {name}, got {value!r}")
        super().__init__(sim)
        self.control_freq = control_freq
        self.n_substeps = sim.freq // control_freq
        self.step = round(float(sim.time[0, 0]) * control_freq)
        self.n_steps_run = 0
        self._dt = 1.0 / control_freq
        self._pace = Pace(self._dt, speed, perf_counter)
        self._commands = StagedCommands(sim)
        self._history = History(positive_integer("n_snapshots", n_snapshots))
        self._snapshot_steps = max(round(snapshot_s * control_freq), 1)
        self._processes: list[Process] = []
        self._events: dict[int, list[tuple[str, Callable[[], object]]]] = defaultdict(list)
        self._viewers = Viewers[Live](fps, self.stop)
        self._recorder: Recorder | None = None
        self._recording_path, self._recording_period, self._recording_start = Path("flight.journal"), 1, 0
        self._paused = self._is_stopped = self._in_step = False
        self._n_refused_requests = self._n_failed_recordings = 0
        self._factor_sample = (perf_counter(), 0, 0.0)  # wall-clock time, s; steps run until then; real-time factor
        self._may_warn = RateLimit(WARNING_PERIOD)
        for key, callback in KEY_CALLBACKS.items():
            self.keyboard.bind(key, callback)

    # Time -----------------------------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Simulated time since the last reset, s."""
        return self.step / self.control_freq

    @property
    def speed(self) -> Speed:
        """Simulated seconds per second, or ``"max"``; may be assigned at any time."""
        return self._pace.speed

    @speed.setter
    def speed(self, speed: Speed) -> None:
        self._pace.speed = speed

    @property
    def paused(self) -> bool:
        """Whether the simulation is paused; may be assigned at any time."""
        return self._paused

    @paused.setter
    def paused(self, paused: bool) -> None:
        self._paused = bool(paused)
        self._pace.restart()

    def toggle_pause(self) -> None:
        """Pause, or continue."""
        self.paused = not self.paused

    def advance(self, n_steps: int = 1) -> None:
        """Advance by control steps as fast as possible, even while paused."""
        n_steps = positive_integer("n_steps", n_steps)
        self._between_steps(lambda _: self._advance(n_steps))

    def reset(self) -> None:
        """Return to the default data. Timed events are called again when their time comes."""
        self._between_steps(lambda _: self._reset())

    def go_to(self, time: float) -> None:
        """Go to a time since the last reset, s.

        Forwards, the loop advances as fast as possible. Backwards, it restores the latest snapshot before that time and
        advances from there. Processes and events are called on the way. After a jump backwards, ``reset(live)`` of the
        processes is called first.
        """
        require(np.isfinite(time) and time >= 0, f"expected a time of 0 s or more, got {time!r}")
        self._between_steps(lambda _: self._go_to(round(time * self.control_freq)))

    def stop(self) -> None:
        """End ``run`` before the next control step."""
        self._is_stopped = True

    # Parts ----------------------------------------------------------------------------------------------------------

    @property
    def command(self) -> NDArray:
        """Commands of all drones, which processes write. From the first access on, every control step applies them.

        (n_worlds, n_drones, k)
        """
        return self._commands.array

    def add(
        self,
        process: Callable[[Live], object],
        freq: float | None = None,
        name: str | None = None,
        on_error: OnError = "raise",
    ) -> Process:
        """Add a process: a function of the loop that is called before control steps, in the order of adding.

        Args:
            process: Function; must not wait. If it has a method ``reset(live)``, this is called after a reset or a jump
                backwards. If it has a method ``compile(live)``, ``run`` calls this before the clock starts.
            freq: Rate of the calls in simulated time, Hz, a divisor of the rate of control steps; None for every
                control step.
            name: Name in messages; None for the name of the function.
            on_error: ``"raise"`` to end ``run`` with its errors, ``"report"`` to log them and continue, for external
                sources such as motion capture.
        """
        require(callable(process), f"expected a function of the loop, got {process!r}")
        require(on_error in ("raise", "report"), f"expected on_error 'raise' or 'report', got {on_error!r}")
        label = str(name or getattr(process, "__name__", type(process).__name__))
        period = steps_per_call(freq, self.control_freq, label)
        reset, compile_fn = (partial(getattr(process, x, lambda _: None), self) for x in ("reset", "compile"))
        self._processes.append(Process(label, partial(process, self), reset, compile_fn, period, on_error))
        return self._processes[-1]

    def call_at(self, time: float, callback: Callable[[Live], object], name: str | None = None) -> None:
        """Call a function with the loop when the simulation reaches a time, s, and again after every reset."""
        step = int(np.ceil(time * self.control_freq - 1e-6)) if np.isfinite(time) else -1
        require(step >= self.step, f"expected a time of {self.time:g} s or later, got {time!r}")
        self._events[step].append((name or getattr(callback, "__name__", "event"), partial(callback, self)))

    def show(self, viewer: V) -> V:
        """Show the simulation in a viewer, and return the viewer; ``run`` ends when all viewers have been closed.

        Raises:
            RenderError: If this machine cannot show it, or a port is in use.
        """
        self._viewers.open(self, viewer)
        return viewer

    # Recording ------------------------------------------------------------------------------------------------------

    def record(self, path: str | Path, freq: float = 50.0) -> Path:
        """Record poses into a new file from now on, and return its path, which has a number if ``path`` exists.

        Each sample is written at once, so after a crash the file is complete up to the crash. Load it with
        ``crazysim.media.Flight.load``.

        Args:
            freq: Rate of samples in simulated time, Hz; a divisor of the rate of control steps.

        Raises:
            ConfigError: If the file cannot be created, or the rate is invalid.
        """
        period = steps_per_call(freq, self.control_freq, "recording")
        self.stop_recording()
        unused_path = _unused_path(Path(path))
        self._recorder = Recorder(self.sim, path=unused_path)
        self._recording_path, self._recording_period, self._recording_start = Path(path), period, self.n_steps_run
        self._record_sample()
        return unused_path

    @property
    def is_recording(self) -> bool:
        """Whether a recording is being written."""
        return self._recorder is not None

    def stop_recording(self) -> None:
        """Finish the recording, if there is one."""
        if self._recorder is not None:
            self._recorder.close()
            self._recorder = None

    def toggle_recording(self) -> None:
        """Finish the present recording, or start a new one, named like the last."""
        if self.is_recording:
            self.stop_recording()
        else:
            self.record(self._recording_path)

    def _record_sample(self) -> None:
        step = self.n_steps_run - self._recording_start
        if self._recorder is None or step % self._recording_period:
            return
        try:
            self._recorder.add(step / self.control_freq)
        except OSError as error:  # as on a full disk: the flight continues
            log.warning("recording %s ended after %.2f s: %s", self._recording_path, step / self.control_freq, error)
            self._n_failed_recordings += 1
            self.stop_recording()

    # Running --------------------------------------------------------------------------------------------------------

    def run(self, seconds: float | None = None) -> LiveReport:
        """Run for some simulated time, or until ``stop``, Ctrl-C or the closing of all viewers; return a report.

        Args:
            seconds: Simulated time, s; None for no end.
        """
        require(
            seconds is None or (np.isfinite(seconds) and seconds > 0),
            f"expected a positive duration, s, got {seconds!r}",
        )
        end = None if seconds is None else self.n_steps_run + round(seconds * self.control_freq)
        self._is_stopped = False
        self._warm_up()
        self._pace = Pace(self._dt, self._pace.speed, perf_counter)
        first_step, first_picture = self.n_steps_run, self._viewers.n_pictures
        paused_s, start_time = 0.0, perf_counter()
        with protect_loop(), contextlib.suppress(KeyboardInterrupt):
            while not self._is_stopped and (end is None or self.n_steps_run < end):
                paused_s += self._run_once()
        jax.block_until_ready(self.sim.data.states.pos)
        wall_s = perf_counter() - start_time - paused_s
        simulated_s = (self.n_steps_run - first_step) * self._dt
        failures = self._n_refused_requests + self._viewers.failures + self._n_failed_recordings
        n_pictures = self._viewers.n_pictures - first_picture
        return self._pace.report(self._processes, simulated_s, wall_s, n_pictures, failures)

    def close(self) -> None:
        self.stop_recording()
        self._viewers.close()

    @property
    def status(self) -> str:
        """Time, speed, pause, recording and the note as text, for viewers."""
        now, (last_time, last_n_steps, factor) = perf_counter(), self._factor_sample
        if now - last_time > 0.5:
            factor = (self.n_steps_run - last_n_steps) * self._dt / (now - last_time)
            self._factor_sample = (now, self.n_steps_run, factor)
        parts = [f"{self.time:.2f} s", f"{factor:.2f} x real time"]
        parts += ["paused"] * self._paused + ["recording"] * self.is_recording
        parts += [] if self.note is None else self.note(self).split("\n")
        return ", ".join(parts)

    def _run_once(self) -> float:
        viewers = self._viewers
        self._run_posted()
        if self._is_stopped:
            return 0.0
        if self._paused:
            start_time = perf_counter()
            viewers.draw(self, viewers.next_picture_time)
            sleep(MAX_SLEEP)
            return perf_counter() - start_time
        wait = self._pace.time_until_due()
        if wait > 0:
            if not viewers.draw(self, viewers.next_picture_time):
                picture_wait = viewers.next_picture_time - perf_counter() if viewers else MAX_SLEEP
                sleep(max(min(wait, picture_wait, MAX_SLEEP), 0.0))
            return 0.0
        lateness = self._pace.record_step(self.time)
        if lateness > WARNING_LATENESS and self._may_warn():
            log.warning("real time missed at %.2f s: %.0f ms late", self.time, 1e3 * lateness)
        self._run_control_step()
        # At real-time speeds a picture waits for idle time, but at most until the next picture is due.
        viewers.draw(self, viewers.next_picture_time + (0.0 if self.speed == "max" else viewers.period))
        return 0.0

    def _run_control_step(self) -> None:
        self._in_step = True
        try:
            if self.step % self._snapshot_steps == 0:
                self._history.add(Snapshot(self.step, self.sim.data, self._commands.copy()))
            for process in self._processes:
                if self.step % process.period == 0:
                    process.run(self.time)
            for name, callback in self._events.get(self.step, ()):
                log.info("%s at %.2f s", name, self.time)
                callback()
            self._commands.stage()
            self.sim.step(self.n_substeps)
        finally:
            self._in_step = False
        self.step += 1
        self.n_steps_run += 1
        self._record_sample()

    def _run_posted(self) -> None:
        try:
            self.keyboard.run(self)
            while self._posted_callbacks:
                self._posted_callbacks.popleft()(self)
        except ConfigError as error:
            self._n_refused_requests += 1
            log.warning("refused at %.2f s: %s", self.time, error)

    def _between_steps(self, callback: Callable[[Live], object]) -> None:
        if self._in_step:
            self.post(callback)
        else:
            callback(self)

    def _advance(self, n_steps: int) -> None:
        for _ in range(n_steps):
            self._run_control_step()
        self._pace.restart()

    def _reset(self) -> None:
        self.sim.reset()
        self.step = 0
        self._history.clear()
        self._commands.restore(None)
        self._reset_processes()

    def _go_to(self, step: int) -> None:
        if step < self.step:
            snapshot = self._history.rewind(step)
            if snapshot is None:
                raise ConfigError(
                    f"expected a time that was flown in this loop, got {step / self.control_freq:g} s. Use reset() to "
                    f"return to the start."
                )
            self.sim.data, self.step = snapshot.data, snapshot.step
            self._commands.restore(snapshot.commands)
            self._reset_processes()
        self._advance(step - self.step)

    def _reset_processes(self) -> None:
        for process in self._processes:
            process.reset()
        self._pace.restart()

    def _warm_up(self) -> None:
        self._commands.stage()
        compile_step(self.sim, self.n_substeps)
        for process in self._processes:
            process.compile()
        self._viewers.update(self)
        self._viewers.next_picture_time = perf_counter()


def _unused_path(path: Path) -> Path:
    numbered = (path.with_name(f"{path.stem}-{k}{path.suffix}") for k in count(2))
    return path if not path.exists() else next(candidate for candidate in numbered if not candidate.exists())


KEY_FRACTION = 0.05
"""Fraction of a slider's range by which a key moves it."""


def _scale_speed(factor: float) -> Callable[[Live], None]:
    def scale(live: Live) -> None:
        live.speed = factor * (1.0 if live.speed == "max" else live.speed)

    return scale


KEY_CALLBACKS: dict[str, Callable[[Live], object]] = {
    "space": Live.toggle_pause,
    ".": Live.advance,
    "backspace": Live.reset,
    "tab": Live.select_next,
    "+": _scale_speed(2.0),
    "-": _scale_speed(0.5),
    "r": Live.toggle_recording,
    "[": lambda live: live.move_slider(-KEY_FRACTION),
    "]": lambda live: live.move_slider(KEY_FRACTION),
    "'": Live.choose_next_slider,
    "escape": Live.stop,
}
"""Keys that every live simulation has, and the functions that they call."""
