"""The clock of a race: which gates a drone has passed, and when."""

from __future__ import annotations

from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from numpy.typing import ArrayLike

from crazysim.engine.pytree import PyTree, leaf
from crazysim.envs.tracks import Track, gates_of_track
from crazysim.errors import expect


class RaceClock(PyTree):
    """Times at which one drone passed the gates of its laps, and its penalties, as a pure function of its positions.

    clock = RaceClock.start(track, laps=3)
    clock = clock.advance(track, before, now, time_before, time_now)  # in jit, vmap and scan
    clock.lap_times(track)
    """

    passed: Array = leaf("opaque", 0)
    """Number of gates passed, of all laps. ()"""
    times: Array = leaf("opaque", 1)
    """Time at which each gate of each lap was passed, s; infinite before. (n_laps * n_gates,)"""
    penalty: Array = leaf("opaque", 0)
    """Sum of the penalties, s. ()"""

    @classmethod
    def start(cls, track: Track, laps: int = 1) -> Self:
        """Return the clock at the start of a race."""
        expect(laps >= 1, "at least one lap", laps)
        return cls(jnp.zeros((), jnp.int32), jnp.full(laps * track.n_gates, jnp.inf), jnp.zeros(()))

    def advance(self, track: Track, before: Array, now: Array, time_before: Array, time_now: Array) -> Self:
        """Return the clock after a straight motion of the drone, which passes at most one gate.

        Args:
            track: The track, which is constant in compiled programs.
            before: Position before, m. (3,)
            now: Position now, m. (3,)
            time_before: Time before, s.
            time_now: Time now, s.
        """
        before, now = jnp.asarray(before), jnp.asarray(now)
        is_passed, share = crosses(track, self.passed % track.n_gates, before, now)
        is_passed &= self.passed < len(self.times)
        time = time_before + share * (time_now - time_before)
        times = jnp.where(is_passed & (np.arange(len(self.times)) == self.passed), time, self.times)
        return self.replace(passed=self.passed + is_passed, times=times)

    def add_penalty(self, seconds: Array | float) -> Self:
        """Return the clock with a further penalty, for example for a touched gate, s."""
        return self.replace(penalty=self.penalty + seconds)

    @property
    def finished(self) -> Array:
        """Whether all gates of all laps are passed. ()"""
        return self.passed == len(self.times)

    @property
    def time(self) -> Array:
        """Time at the last gate of the last lap with penalties, s; infinite before. ()"""
        return self.times[-1] + self.penalty

    def splits(self, track: Track) -> Array:
        """Return the times from gate to gate, s; the first is from the start. (n_laps, n_gates)"""
        return jnp.diff(self.times, prepend=0.0).reshape(-1, track.n_gates)

    def lap_times(self, track: Track) -> Array:
        """Return the times of the laps, s; the first is from the start. (n_laps,)"""
        return jnp.diff(self.times[track.n_gates - 1 :: track.n_gates], prepend=0.0)


def crosses(track: Track, gate: Array, before: Array, now: Array) -> tuple[Array, Array]:
    """Return whether a straight motion passes a gate, and the share of the motion up to there.

    Openings that are polygons are passed forwards at the end of the gate, and balls where the motion enters them.

    Args:
        gate: Index of the gate. ()
        before: Position before, m. (3,)
        now: Position now, m. (3,)
    """
    gates = gates_of_track(track)
    pos = np.array([gate.pos + gate.rot[:, 0] * gate.length / 2 for gate in gates])
    rot = np.array([gate.rot for gate in gates])
    is_ball = np.array([gate.is_ball for gate in gates])
    radius = np.array([float(gate.opening) if gate.is_ball else 1.0 for gate in gates])
    n_planes = max(1 if gate.is_ball else len(gate.half_planes) for gate in gates)
    everywhere = np.array([0.0, 0.0, 1.0])  # a half-plane without an edge
    planes = np.array([[everywhere] * n_planes for _ in gates])
    for k, entry in enumerate(gates):
        if not entry.is_ball:
            planes[k, : len(entry.half_planes)] = entry.half_planes

    def pick(values: np.ndarray) -> Array:
        return jnp.asarray(values, now.dtype)[gate]

    start, end = (pick(rot).T @ (x - pick(pos)) for x in (before, now))
    way = end - start
    # Polygons: forwards through the plane.
    forwards = (start[0] < 0) & (end[0] >= 0)
    share = -start[0] / jnp.where(forwards, way[0], 1)
    point = (start + share * way)[1:]
    through = forwards & jnp.all(pick(planes)[:, :2] @ point < pick(planes)[:, 2])
    # Balls: the first point of the line within the radius.
    a, b, c = way @ way, start @ way, start @ start - pick(radius) ** 2
    root = jnp.sqrt(jnp.maximum(b * b - a * c, 0))
    entry_share = jnp.where(c <= 0, 0.0, (-b - root) / jnp.where(a > 0, a, 1))
    enters = (c <= 0) | ((b * b >= a * c) & (entry_share >= 0) & (entry_share <= 1) & (a > 0))
    ball = jnp.asarray(is_ball)[gate]
    return jnp.where(ball, enters, through), jnp.where(ball, entry_share, share).clip(0, 1)


def time_flight(track: Track, times: ArrayLike, pos: ArrayLike, laps: int = 1) -> RaceClock:
    """Return the clock at the end of a recorded flight of one drone.

    Args:
        times: Times, s. (n,)
        pos: Positions, m. (n, 3)
        laps: Number of laps.
    """
    t, x = (jnp.asarray(values, jnp.float32) for values in (times, pos))

    def advance(clock: RaceClock, row: tuple[Array, ...]) -> tuple[RaceClock, None]:
        return clock.advance(track, *row), None

    return jax.jit(lambda *rows: lax.scan(advance, RaceClock.start(track, laps), rows)[0])(x[:-1], x[1:], t[:-1], t[1:])
