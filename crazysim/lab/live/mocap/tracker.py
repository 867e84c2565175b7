"""Tracking of bodies through frames that are late, lost, repeated, wrong or out of order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazysim.core.settings import check_settings, setting
from crazysim.errors import require
from crazysim.lab.live.mocap.frames import Frame
from crazysim.lab.live.mocap.source_events import Reports

N_INTERVALS = 32
"""Number of intervals between frames that are measured to find the period of the source, which is their median."""
MAX_COORDINATE = 1e6
"""Magnitude at which a coordinate becomes invalid, m."""
MAX_DELAY_AGE = 10.0
"""Age after which the smallest delay is replaced by the present one, s, because clocks drift."""


@dataclass(frozen=True)
class Rules:
    """Limits beyond which frames and poses are reported or refused."""

    max_speed: float = setting(default=10.0, low=0.0)
    """Largest speed of a body, m/s; a faster motion counts as a jump."""
    slack: float = setting(default=0.05, low=0.0)
    """Distance that a body may move beyond ``max_speed`` times the elapsed time before it counts as a jump, m."""
    confirm: int = setting(default=3, low=1)
    """Number of consecutive frames that must agree on a new position before a jump is accepted."""
    late: float = setting(default=0.05, low=0.0)
    """Delay beyond the smallest recent delay above which a frame is reported as late, s."""
    lost: float = setting(default=0.2, low=0.0)
    """Time without a valid pose after which a body counts as lost, s."""
    stalled: float = setting(default=0.2, low=0.0)
    """Time without a frame after which the source counts as stalled, s."""
    restart: float = setting(default=1.0, low=0.0)
    """Backward step of the source's clock above which the source counts as restarted, s; after a smaller step the frame
    counts as old."""

    def __post_init__(self) -> None:
        check_settings(self)


class Tracker:
    """Last valid pose and velocity of every known body.

    | Frame or body | Rule | Report |
    | --- | --- | --- |
    | same time as the last frame | frame refused | `repeated` |
    | older than the last frame | frame refused | `backwards` |
    | older by more than `restart` | accepted, velocities zero: the source has restarted | `restarted` |
    | time not finite | frame refused | `invalid` |
    | gap of more than 1.5 periods | accepted; the number of missing frames is counted | `dropped` |
    | delayed by more than `late` | accepted | `late` |
    | pose not finite or beyond 1000 km, quaternion zero | body keeps its pose | `invalid` |
    | body faster than `max_speed` | body keeps its pose until `confirm` frames agree | `jumped`, `relocated` |
    | name that is not known | ignored; once for each name | `unknown` |
    | name twice in a frame | body keeps its pose | `duplicate` |
    | body missing for `lost` | keeps its pose, velocity zero | `lost`, `found` |
    | no frame for `stalled` | all keep their poses, velocities zero | `stalled`, `resumed` |
    | more frames than the reader took | the oldest are lost | `overrun` |
    | thread or connection ended | as stalled | `ended` |
    """

    pos: NDArray
    """Positions of the bodies, world frame, m. (n, 3)"""
    vel: NDArray
    """Velocities of the bodies, world frame, m/s. (n, 3)"""
    quat: NDArray
    """Attitudes of the bodies, body to world, xyzw. (n, 4)"""
    seen: NDArray
    """True for bodies that have had a valid pose. (n,)"""
    n_frames: int
    """Number of accepted frames."""

    def __init__(self, names: Sequence[str], rules: Rules | None = None, source: str = "mocap"):
        require(len(set(names)) == len(names), f"expected different names, got {list(names)}. List each body once.")
        n = len(names)
        self.names, self.rules, self.source = tuple(names), rules or Rules(), source
        self.reports = Reports()
        self.pos, self.vel = np.zeros((n, 3)), np.zeros((n, 3))
        self.quat = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
        self.seen = np.zeros(n, bool)
        self.n_frames = 0
        self._row_by_name = {name: k for k, name in enumerate(names)}
        self._rows_by_names: dict[tuple[str, ...], tuple[NDArray, NDArray, list[str]]] = {}
        self._unknown_names: set[str] = set()
        self._stamps = np.full(n, -np.inf)
        self._is_lost = np.zeros(n, bool)
        self._suspect_pos, self._n_suspect_frames = np.zeros((n, 3)), np.zeros(n, int)
        self._stamp: float | None = None
        self._received: float | None = None
        self._is_stalled = self._has_ended = False
        self._intervals: list[float] = []
        self._period: float | None = None
        self._least_delay, self._least_delay_time = np.inf, -np.inf

    @property
    def stalled(self) -> bool:
        """Whether the source has sent no frame for longer than ``Rules.stalled``."""
        return self._is_stalled

    def accept(self, frame: Frame) -> bool:
        """Process a frame, and return True unless it was refused."""
        now, rules = frame.stamp, self.rules
        if not np.isfinite(now):
            self._report("invalid", self.source, frame.received, f"time {now}")
            return False
        self._received = frame.received
        if self._is_stalled:
            self._is_stalled = False
            self._report("resumed", self.source, now, "frames arrive again")
        last_stamp = self._stamp
        if last_stamp is not None and now <= last_stamp:
            if now == last_stamp:
                self._report("repeated", self.source, now, "frame refused")
                return False
            if last_stamp - now <= rules.restart:
                self._report(
                    "backwards", self.source, now, f"frame refused: {last_stamp - now:.4f} s before the last one"
                )
                return False
            self._report("restarted", self.source, now, f"clock stepped back by {last_stamp - now:.3f} s")
            self.restart()
            last_stamp, self._received = None, frame.received
        if last_stamp is not None:
            self._watch_interval(now, now - last_stamp)
        self._watch_delay(now, frame.received - now)
        self._stamp = now
        self.n_frames += 1
        with np.errstate(over="ignore", invalid="ignore"):  # such numbers are refused below
            self._update_bodies(frame, now)
        is_missing = self.seen & ~self._is_lost & (now - self._stamps > rules.lost) & np.isfinite(self._stamps)
        for k in np.flatnonzero(is_missing):
            self._is_lost[k], self.vel[k] = True, 0.0
            self._report("lost", self.names[k], now, f"no valid pose for {now - self._stamps[k]:.3f} s; it stays there")
        return True

    def restart(self) -> None:
        """Accept the next frame with any time; poses are kept, and velocities restart at zero."""
        self._stamps[self.seen] = -np.inf
        self._least_delay, self._least_delay_time, self._stamp, self._received = np.inf, -np.inf, None, None

    def advance(self, now: float, lost: int = 0, ended: str | None = None) -> None:
        """Report, at the end of a poll, lost frames and a source that has stalled or ended.

        Args:
            now: Time of the poll, s.
            lost: Number of frames that the reader lost.
            ended: Reason for which the source has ended; None if it has not.
        """
        if lost:
            self._report("overrun", self.source, now, f"{lost} frames lost: the reader was too slow")
        if ended is not None and not self._has_ended:
            self._has_ended = True
            self._report("ended", self.source, now, ended)
        if self._received is None:
            self._received = now
        silence = now - self._received
        if silence > self.rules.stalled and not self._is_stalled:
            self._is_stalled = True
            self.vel[:] = 0.0
            self._report("stalled", self.source, now, f"no frame for {silence:.3f} s; all bodies stay where they are")

    def _report(self, kind: str, name: str, time: float, text: str) -> None:
        self.reports.add(kind, name, time, text)

    def _watch_interval(self, now: float, interval: float) -> None:
        if self._period is None:
            self._intervals.append(interval)
            if len(self._intervals) == N_INTERVALS:
                self._period = float(np.median(self._intervals))
        elif interval > 1.5 * self._period:
            n = round(interval / self._period) - 1
            self._report("dropped", self.source, now, f"{n} frames missing in {interval:.4f} s")

    def _watch_delay(self, now: float, delay: float) -> None:
        if delay < self._least_delay or now - self._least_delay_time > MAX_DELAY_AGE:
            self._least_delay, self._least_delay_time = delay, now
        elif delay - self._least_delay > self.rules.late:
            self._report("late", self.source, now, f"{delay - self._least_delay:.3f} s after the quickest frame")

    def _find_rows(self, names: tuple[str, ...], now: float) -> tuple[NDArray, NDArray]:
        mapping = self._rows_by_names.get(names)
        if mapping is None:
            duplicates = sorted({name for name in names if names.count(name) > 1} & set(self._row_by_name))
            entries = [i for i, name in enumerate(names) if name in self._row_by_name and name not in duplicates]
            rows = np.array([self._row_by_name[names[i]] for i in entries], int)
            mapping = np.array(entries, int), rows, duplicates
            if len(self._rows_by_names) > 1000:
                self._rows_by_names.clear()
            self._rows_by_names[names] = mapping
            for name in set(names) - set(self._row_by_name) - self._unknown_names:
                if len(self._unknown_names) < 1000:
                    self._unknown_names.add(name)
                    self._report("unknown", name, now, "no object of the scene has this name; it is ignored")
        entries, rows, duplicates = mapping
        for name in duplicates:
            self._report("duplicate", name, now, "name twice in a frame; it keeps its pose")
        return entries, rows

    def _update_bodies(self, frame: Frame, now: float) -> None:
        entries, rows = self._find_rows(frame.names, now)
        pos, quat = frame.pos[entries], frame.quat[entries]
        # Invalid poses.
        norm = np.sqrt((quat * quat).sum(-1))
        is_valid = (np.abs(pos) < MAX_COORDINATE).all(-1) & (norm > 1e-3) & np.isfinite(norm)
        if not is_valid.all():
            for k in rows[~is_valid]:
                self._report("invalid", self.names[k], now, "pose not finite, or quaternion zero; it keeps its pose")
            rows, pos, quat, norm = rows[is_valid], pos[is_valid], quat[is_valid], norm[is_valid]
        # Jumps that are too fast to be motion.
        dt = now - self._stamps[rows]
        displacement = pos - self.pos[rows]
        was_seen = self.seen[rows] & np.isfinite(dt)
        distance = np.sqrt((displacement * displacement).sum(-1))
        is_plausible = ~was_seen | (distance <= self.rules.max_speed * np.where(was_seen, dt, 0.0) + self.rules.slack)
        is_relocated = np.zeros(len(rows), bool)
        if not is_plausible.all():
            is_relocated = self._confirm_jumps(rows, pos, distance, is_plausible, now)
            is_plausible |= is_relocated
        self._n_suspect_frames[rows[is_plausible]] = 0
        for k in rows[is_plausible & self._is_lost[rows]]:
            self._report("found", self.names[k], now, "valid pose again")
        # Poses and velocities of the others.
        rows, pos, quat, norm, dt, displacement = (
            rows[is_plausible],
            pos[is_plausible],
            quat[is_plausible],
            norm[is_plausible],
            dt[is_plausible],
            displacement[is_plausible],
        )
        has_no_speed = ~was_seen[is_plausible] | is_relocated[is_plausible] | self._is_lost[rows]
        dt = np.where(has_no_speed, np.inf, np.maximum(dt, distance[is_plausible] / self.rules.max_speed))
        self.vel[rows] = displacement / np.where(dt > 0, dt, np.inf)[:, None]
        self.pos[rows], self.quat[rows] = pos, quat / norm[:, None]
        self._stamps[rows], self.seen[rows], self._is_lost[rows] = now, True, False

    def _confirm_jumps(
        self, rows: NDArray, pos: NDArray, distance: NDArray, is_plausible: NDArray, now: float
    ) -> NDArray:
        is_accepted = np.zeros(len(rows), bool)
        for i in np.flatnonzero(~is_plausible):
            k = rows[i]
            is_near = np.linalg.norm(pos[i] - self._suspect_pos[k]) <= self.rules.slack
            self._n_suspect_frames[k] = self._n_suspect_frames[k] + 1 if is_near and self._n_suspect_frames[k] else 1
            self._suspect_pos[k] = pos[i]
            if self._n_suspect_frames[k] >= self.rules.confirm:
                is_accepted[i] = True
                self._report(
                    "relocated", self.names[k], now, f"{distance[i]:.3f} m away in {self.rules.confirm} frames"
                )
            else:
                self._report("jumped", self.names[k], now, f"{distance[i]:.3f} m; it keeps its pose")
        return is_accepted
