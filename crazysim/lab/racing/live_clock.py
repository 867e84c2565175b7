"""The clock of a race in the live loop."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from crazysim.envs.race_clock import RaceClock
from crazysim.envs.tasks.race import Race
from crazysim.envs.tasks.race_rules import race_of
from crazysim.lab.live.loop import Live
from crazysim.lab.racing.flight import clock_text


class LiveClock:
    """Process that times the first drone of a live race, and shows lap, gates, splits and penalties in its viewers.

    live = Live(env.sim, env.base.freq)
    LiveClock(env.task).add_to(live)
    """

    def __init__(self, task: Race):
        self._task, track, missed = task, task.course, task.penalty
        self._advance = jax.jit(lambda clock, *motion: clock.advance(track, *motion, missed))
        self.clock = RaceClock.start(track, task.laps)
        """The clock now."""
        self._last: tuple[jax.Array, float] | None = None

    def add_to(self, live: Live) -> None:
        live.add(self, name="clock")
        live.note = self.text

    def compile(self, live: Live) -> None:
        pos = live.sim.data.states.pos[0, 0]
        self._advance(self.clock, pos, pos, 0.0, 0.0)

    def __call__(self, live: Live) -> None:
        now = live.sim.data.states.pos[0, 0], live.time
        if self._last is not None:
            self.clock = self._advance(self.clock, self._last[0], now[0], self._last[1], now[1])
        self._last = now

    def reset(self, live: Live) -> None:
        """Forget the gates that were passed later than the present time."""
        times = jnp.where(self.clock.times <= live.time, self.clock.times, jnp.inf)
        self.clock, self._last = self.clock.replace(times=times, passed=jnp.sum(jnp.isfinite(times))), None

    def text(self, live: Live) -> str:
        """Describe the clock as in films."""
        penalty = race_of(live.sim.data).penalty_sum
        return clock_text(self.clock, self._task.course, live.time, 0.0 if penalty is None else float(penalty[0, 0]))
