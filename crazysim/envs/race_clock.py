"""The clock of a race: which gates a drone has passed, and when."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from numpy.typing import ArrayLike

from crazysim import rotation
from crazysim.engine.pytree import PyTree, leaf
from crazysim.envs.tasks.goals import pick_entry
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

    def advance(
        self, track: Track, before: Array, now: Array, time_before: Array, time_now: Array, missed: float | None = None
    ) -> Self:
        """Return the clock after a straight motion of the drone, which passes at most one gate, tunnels at their ends.

        Args:
            track: The track, which is constant in compiled programs.
            before: Position before, m. (3,)
            now: Position now, m. (3,)
            time_before: Time before, s.
            time_now: Time now, s.
            missed: Penalty for a gate that is missed, s: passing the gate after it counts both. None if all gates must
                be passed. Of two gates, none can be missed.
        """
        before, now = jnp.asarray(before), jnp.asarray(now)
        gates, openings, n_all = gates_of_track(track), Openings.of(track), len(self.times)
        ends = np.array([gate.pos + gate.rot[:, 0] * gate.length / 2 for gate in gates], now.dtype)
        rots = np.array([gate.rot.ravel() for gate in gates], now.dtype)

        def passes(number: Array) -> tuple[Array, Array]:
            gate = number % track.n_gates
            rot = pick_entry(rots, gate).reshape(3, 3)
            start, end = (rot.T @ (x - pick_entry(ends, gate)) for x in (before, now))
            is_passed, share = openings.crosses(gate, start, end)
            return is_passed & (number < n_all), share

        is_passed, share = passes(self.passed)
        passed, penalty = self.passed + is_passed, self.penalty
        if missed is not None and track.n_gates > 2:
            skips, share_after = passes(self.passed + 1)
            skips &= ~is_passed
            passed, penalty = passed + 2 * skips, penalty + missed * skips
            share = jnp.where(skips, share_after, share)
        time = time_before + share * (time_now - time_before)
        number = np.arange(n_all)
        times = jnp.where((number >= self.passed) & (number < passed), time, self.times)
        return self.replace(passed=passed, times=times, penalty=penalty)

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


@dataclass(frozen=True)
class Openings:
    """Openings of the gates of a track, as constants of a compiled program."""

    planes: tuple[tuple[tuple[float, ...], ...], ...]
    """Half-planes of each gate, as ``Gate.half_planes``. (n_gates, n, 3)"""
    radii: tuple[tuple[float], ...]
    """Radius of balls, m; zero for polygons. (n_gates, 1)"""
    sizes: tuple[tuple[float, float], ...]
    """Width and height of each opening, m. (n_gates, 2)"""

    @classmethod
    def of(cls, track: Track) -> Self:
        gates = gates_of_track(track)
        everywhere = [(0.0, 0.0, 1.0)]  # a half-plane without an edge
        planes = [everywhere if gate.is_ball else list(map(tuple, gate.half_planes.tolist())) for gate in gates]
        n = max(map(len, planes))
        return cls(
            tuple(tuple(x + everywhere * (n - len(x))) for x in planes),
            tuple((float(gate.opening) if gate.is_ball else 0.0,) for gate in gates),
            tuple(tuple(gate.size.tolist()) for gate in gates),
        )

    def crosses(self, gate: Array, start: Array, end: Array) -> tuple[Array, Array]:
        """Return whether a straight motion passes a gate, and the share of the motion up to there.

        Polygons are passed forwards, and balls where the motion enters them.

        Args:
            gate: Index of the gate. (...)
            start: Position before, in the gate's frame, m. (..., 3)
            end: Position after, in the gate's frame, m. (..., 3)
        """
        way = end - start
        planes = np.reshape(np.array(self.planes, end.dtype), (len(self.planes), -1))
        y, z, distance = jnp.moveaxis(pick_entry(planes, gate).reshape(*gate.shape, -1, 3), -1, 0)
        radius = pick_entry(np.array(self.radii, end.dtype), gate)[..., 0]
        # Polygons: forwards through the plane.
        forwards = (start[..., 0] < 0) & (end[..., 0] >= 0)
        share = -start[..., 0] / jnp.where(forwards, way[..., 0], 1)
        point = start + share[..., None] * way
        through = forwards & jnp.all(y * point[..., 1:2] + z * point[..., 2:] < distance, axis=-1)
        # Balls: the first point of the line within the radius.
        a, b, square = (jnp.sum(x * y, axis=-1) for x, y in ((way, way), (start, way), (start, start)))
        c = square - radius * radius
        root = rotation.safe_sqrt(jnp.maximum(b * b - a * c, 0))
        entry = jnp.where(c <= 0, 0.0, (-b - root) / jnp.where(a > 0, a, 1))
        enters = (c <= 0) | ((b * b >= a * c) & (entry >= 0) & (entry <= 1) & (a > 0))
        return jnp.where(radius > 0, enters, through), rotation.clip(jnp.where(radius > 0, entry, share), 0, 1)


def time_flight(
    track: Track, times: ArrayLike, pos: ArrayLike, laps: int = 1, missed: float | None = None
) -> RaceClock:
    """Return the clock at the end of a recorded flight of one drone.

    Args:
        times: Times, s. (n,)
        pos: Positions, m. (n, 3)
        laps: Number of laps.
        missed: Penalty for a gate that is missed, s, as in ``RaceClock.advance``.
    """
    t, x = (jnp.asarray(values, jnp.float32) for values in (times, pos))

    def advance(clock: RaceClock, row: tuple[Array, Array, Array, Array]) -> tuple[RaceClock, None]:
        return clock.advance(track, *row, missed), None

    return jax.jit(lambda *rows: lax.scan(advance, RaceClock.start(track, laps), rows)[0])(x[:-1], x[1:], t[:-1], t[1:])
