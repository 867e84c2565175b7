"""Processes of a live simulation: functions that its loop calls between steps."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from crazysim.errors import ConfigError

OnError = Literal["raise", "report"]
"""Reaction of the loop to an error of a process: end with it, or log it and continue."""
MIN_LOG_INTERVAL = 1.0
"""Shortest time between two log messages of one kind, s."""

log = logging.getLogger(__name__)


class RateLimit:
    """Limit to one log message per period."""

    def __init__(self, period: float = MIN_LOG_INTERVAL):
        self._period, self._last_time = period, -math.inf

    def __call__(self) -> bool:
        now = time.monotonic()
        if now - self._last_time < self._period:
            return False
        self._last_time = now
        return True


@dataclass
class Process:
    """A function that is called every ``period`` control steps, with statistics of its calls."""

    name: str
    """Name in messages."""
    callback: Callable[[], object]
    """The function; it must return at once, as the loop waits for it."""
    reset: Callable[[], object]
    """Function that is called after a reset or a jump in time."""
    compile: Callable[[], object]
    """Function that is called before the clock starts, to compile what ``callback`` uses."""
    period: int
    """Control steps from one call to the next."""
    on_error: OnError = "raise"
    """``"raise"`` or ``"report"``."""
    longest_call: float = 0.0
    """Duration of the longest call, s."""
    longest_call_time: float = 0.0
    """Simulated time at which the longest call began, s."""
    failures: int = 0
    """Number of errors that were reported."""
    _may_warn: RateLimit = field(default_factory=RateLimit, repr=False)

    def run(self, now: float) -> None:
        """Call the function and measure the duration; ``now`` is the simulated time, s."""
        start_time = time.perf_counter()
        try:
            self.callback()
        except Exception as error:
            if self.on_error == "raise":
                raise
            self.failures += 1
            if self._may_warn():
                log.warning("%s failed at %.3f s (%d in all): %s", self.name, now, self.failures, error)
        duration = time.perf_counter() - start_time
        if duration > self.longest_call:
            self.longest_call, self.longest_call_time = duration, now


def steps_per_call(freq: float | None, control_freq: int, name: str) -> int:
    """Return the number of control steps from one call to the next.

    Args:
        freq: Rate of the calls, Hz; None for the rate of the control steps.
        control_freq: Rate of the control steps, Hz.
    """
    if freq is None:
        return 1
    period = round(control_freq / freq) if freq > 0 else 0
    if period < 1 or abs(period * freq - control_freq) > 1e-6 * control_freq:
        raise ConfigError(f"expected a rate of {name!r} that divides {control_freq} Hz, got {freq!r} Hz")
    return period
