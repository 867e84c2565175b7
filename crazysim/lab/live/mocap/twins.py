"""Digital twins: objects of the scene at the poses that motion capture measures."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, NDArray

from crazysim.core.settings import check_settings, setting
from crazysim.drones import load_airframe
from crazysim.drones.body import body_shape
from crazysim.errors import ConfigError, UnknownNameError, require
from crazysim.lab.live.attitude import from_rpy, multiply, rotate, to_rpy
from crazysim.lab.live.loop import Live
from crazysim.lab.live.mocap.playback import Playback
from crazysim.lab.live.mocap.poll_recording import MocapRecorder
from crazysim.lab.live.mocap.source import MocapSource
from crazysim.lab.live.mocap.source_events import Reports
from crazysim.lab.live.mocap.tracker import Rules, Tracker
from crazysim.scene.objects import Handle
from crazysim.sim.sim import Sim
from crazysim.storage import Closeable
from crazysim.tables import read_numbers

HIDDEN_POSITION = (0.0, 0.0, -100.0)
"""Position of an object before its first pose, world frame, m: below every floor."""


@dataclasses.dataclass(frozen=True)
class Twin:
    """Simulated object that represents a real one.

    The measured attitude is first turned by ``turn``. Then the angles in ``fixed`` replace the measured angles, and
    ``offset``, in the resulting axes, is added to the position. With a ``parent``, the object is a part of a skeleton:
    its position follows from the pose of the parent and its own measured pose.
    """

    model: Any = "box"
    """Name of a primitive, or an MJCF file, text, spec or body, as for ``sim.scene.add``."""
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Settings of the primitive, such as ``{"size": (0.1, 0.1, 0.2)}``."""
    offset: Sequence[float] = setting(default=(0.0, 0.0, 0.0), shapes=((3,),))
    """Position of the body's frame in the turned tracked frame, m. (3,)"""
    turn: Sequence[float] = setting(default=(0.0, 0.0, 0.0), shapes=((3,),))
    """Roll, pitch and yaw of the body in the tracked frame, rad. (3,)"""
    fixed: Sequence[float | None] = (None, None, None)
    """Roll, pitch and yaw of the body in the world frame that replace measured angles, rad; None to keep a measured
    angle."""
    parent: str | None = None
    """Name of the body in the stream that carries this object; None if the object moves freely."""
    at: Sequence[float] = setting(default=(0.0, 0.0, 0.0), shapes=((3,),))
    """Position of the joint in the parent's tracked frame, m. (3,)"""
    length: float = setting(default=0.0, low=0.0)
    """Distance from the joint to the tracked frame, m, in the measured direction: zero for a hook or a hinge at the
    joint, the drawbar's length for a trailer."""

    def __post_init__(self) -> None:
        check_settings(self)
        is_sequence = isinstance(self.fixed, Sequence) and not isinstance(self.fixed, str)
        angles = [0.0 if x is None else x for x in self.fixed] if is_sequence else self.fixed
        read_numbers("fixed of Twin", angles, shapes=((3,),), remedy="Use None for angles that are measured.")

    @staticmethod
    def drone(airframe: str = "crazyflie", **settings: Any) -> Twin:
        """Return a box of the size of an airframe's collision box."""
        centre, half = np.split(body_shape(load_airframe(airframe))["collision_box"], 2)
        options = {"size": tuple((2 * half).tolist()), "rgba": (0.1, 0.5, 0.9, 1.0)}
        offset = np.asarray(settings.pop("offset", (0.0, 0.0, 0.0)), float) + centre
        return Twin("box", options, tuple(offset.tolist()), **settings)


def twin_of(name: str, twins: Mapping[str, Twin]) -> Twin | None:
    """Return the twin with the longest key that a name of the stream starts with, or None if there is no such key."""
    keys = [key for key in twins if name.startswith(key)]
    return twins[max(keys, key=len)] if keys else None


class Twins(Closeable):
    """Objects of a simulation that follow a motion capture source.

        twins = Twins(sim, source, {"cf": Twin.drone(), "obst": Twin("pole")}, ["cf1", "obst2"])
        while True:
            twins.update(sim)
            sim.step(5)

    ``update`` reads all frames that have arrived, applies the rules of ``Tracker``, and writes all poses and velocities
    into ``data.objects`` of every world at once. Contact reports, ``ContactResponse``, range finders and images then
    include the twins like any other objects. A reset hides objects below the floor until the next update.
    """

    def __init__(
        self,
        sim: Sim,
        source: MocapSource,
        twins: Mapping[str, Twin],
        names: Iterable[str],
        rules: Rules | None = None,
        record: str | None = None,
    ):
        self.names, self.source = tuple(names), source
        twin_by_name = {}
        for name in self.names:
            twin = twin_of(name, twins)
            if twin is None:
                raise UnknownNameError(
                    f"expected names that begin with one of {list(twins)}, got {name!r}. Add a twin for it."
                )
            twin_by_name[name] = twin
        self.twins = twin_by_name
        self._order = _order_parents_first(twin_by_name)
        with sim.scene.restore_on_error():
            self.handles: dict[str, Handle] = {
                name: sim.scene.add(t.model, name, pos=HIDDEN_POSITION, mocap=True, **t.options)
                for name, t in twin_by_name.items()
            }
        self._rows = np.array([handle.rows[0] for handle in self.handles.values()], np.int32)
        self.tracker = Tracker(self.names, rules, source.name)
        self._is_frozen, self._step = np.zeros(len(self.names), bool), 0
        self._recorder = None if record is None else MocapRecorder(record)
        twin_list = twin_by_name.values()
        self._turn_quat = from_rpy([t.turn for t in twin_list]).reshape(-1, 4)
        self._offsets = np.array([t.offset for t in twin_list], float).reshape(-1, 3)
        fixed = np.array([[np.nan if x is None else x for x in t.fixed] for t in twin_list], float).reshape(-1, 3)
        self._fixed_angles, self._is_fixed = fixed, np.isfinite(fixed).any(-1)
        self._poses = (
            np.tile(HIDDEN_POSITION, (len(twin_by_name), 1)),
            np.tile([0.0, 0, 0, 1], (len(twin_by_name), 1)),
            np.zeros((len(twin_by_name), 3)),
        )
        self._lock = threading.Lock()

    @property
    def reports(self) -> Reports:
        """Reports of the source and its bodies."""
        return self.tracker.reports

    def __call__(self, live: Live) -> None:
        self.update(live.sim)

    def update(self, sim: Sim) -> None:
        """Read the frames that have arrived, and write all poses; it never waits for the source."""
        step = int(sim.data.core.steps[0, 0])
        if self.source.simulated and step < self._step:
            self.tracker.restart()
        self._step = step
        poll = self.source.poll(step, sim.freq)
        if self._recorder is not None:
            self._recorder.write(poll)
        for frame in poll.frames:
            self.tracker.accept(frame)
        self.tracker.advance(poll.now, poll.lost, self.source.ended)
        self._compute_poses()
        data = sim.data
        objects = data.objects
        require(
            objects is not None,
            "expected the simulation whose scene has the twins, got one without movable objects. Pass the one that "
            "Twins(sim, ...) was made for.",
        )
        new_poses = _write_poses((objects.pos, objects.quat, objects.vel), self._rows, self._poses)
        sim.data = data.replace(objects=objects.replace(pos=new_poses[0], quat=new_poses[1], vel=new_poses[2]))

    def freeze(self, *names: str) -> None:
        """Keep bodies at their present poses and ignore the source; without names, all bodies."""
        self._is_frozen[self._find_indices(names)] = True

    def thaw(self, *names: str) -> None:
        """Make frozen bodies follow the source again; without names, all bodies."""
        self._is_frozen[self._find_indices(names)] = False

    def pose(self, name: str) -> tuple[NDArray, NDArray, NDArray]:
        """Return position, m (3,), attitude, xyzw (4,), and velocity, m/s (3,), of the object of a body."""
        k = self._find_indices([name])[0]
        return tuple(x[k].copy() for x in self._poses)  # type: ignore[return-value]

    def playback(
        self, source: MocapSource, seconds: float, freq: int = 100, start: ArrayLike = 0.0, name: str = "playback"
    ) -> Playback:
        """Make a plugin that moves the objects within the compiled step, in every world, for ``sim.add``.

        Args:
            source: Source in simulated time, such as ``ReplaySource(path, by="time")``. Rules, offsets and skeletons
                are applied to its frames.
            seconds: Duration to sample, s.
            freq: Samples per second, Hz; poses between them are interpolated.
            start: Time of the recording at the reset of a world, s. () or (n_worlds,)
        """
        require(2 <= seconds * freq <= 1e7, f"expected a time of at least two samples, {2 / freq} s, got {seconds} s")
        saved_state = self.tracker, self._poses
        self.tracker = Tracker(self.names, self.tracker.rules, source.name)
        samples = []
        try:
            for k in range(round(seconds * freq)):
                poll = source.poll(k, freq)
                for frame in poll.frames:
                    self.tracker.accept(frame)
                self._compute_poses()
                samples.append(self._poses[:2])
        finally:
            self.tracker, self._poses = saved_state
        pos, quat = (np.stack(x) for x in zip(*samples, strict=True))
        return Playback(list(self.handles.values()), pos, quat, float(freq), start, name)

    def close(self) -> None:
        self.source.close()
        if self._recorder is not None:
            self._recorder.close()

    def _find_indices(self, names: Sequence[str]) -> list[int]:
        for name in names:
            if name not in self.names:
                raise UnknownNameError(f"expected one of the bodies {list(self.names)}, got {name!r}")
        return [self.names.index(name) for name in names] if names else list(range(len(self.names)))

    def _compute_poses(self) -> None:
        tracker = self.tracker
        pos, vel = tracker.pos.copy(), tracker.vel
        for k in self._order:
            twin = self.twins[self.names[k]]
            parent = self.names.index(twin.parent)  # type: ignore[arg-type]
            joint = pos[parent] + rotate(tracker.quat[parent], np.asarray(twin.at, float))
            direction = pos[k] - joint
            distance = np.linalg.norm(direction)
            pos[k] = joint + (twin.length / distance * direction if distance > 0 else 0.0)
        quat = multiply(tracker.quat, self._turn_quat)
        if self._is_fixed.any():
            rpy = to_rpy(quat[self._is_fixed])
            fixed = self._fixed_angles[self._is_fixed]
            quat[self._is_fixed] = from_rpy(np.where(np.isfinite(fixed), fixed, rpy))
        pos += rotate(quat, self._offsets)
        is_shown = tracker.seen & ~self._is_frozen
        for k in self._order:
            is_shown[k] &= tracker.seen[self.names.index(self.twins[self.names[k]].parent)]  # type: ignore[arg-type]
        old_pos, old_quat, old_vel = self._poses
        self._poses = (
            np.where(is_shown[:, None], pos, old_pos),
            np.where(is_shown[:, None], quat, old_quat),
            np.where(is_shown[:, None], vel, 0.0 * old_vel),
        )


def discover(source: MocapSource, twins: Mapping[str, Twin], seconds: float = 1.0) -> tuple[str, ...]:
    """Return the names of a running source's bodies that have a twin, after polling it for a time, s."""
    pause, names = threading.Event(), dict[str, None]()
    for k in range(max(round(seconds / 0.05), 1)):
        for frame in source.poll(k, 20).frames:
            names.update(dict.fromkeys(frame.names))
        pause.wait(0.05)
    return tuple(name for name in names if twin_of(name, twins) is not None)


@jax.jit
def _write_poses(old: tuple[Array, Array, Array], rows: Array, new: tuple[NDArray, NDArray, NDArray]) -> list[Array]:
    return [x.at[..., rows, :].set(jnp.asarray(y, x.dtype)) for x, y in zip(old, new, strict=True)]


def _order_parents_first(twins: Mapping[str, Twin]) -> list[int]:
    names, order = list(twins), list[int]()
    for name, twin in twins.items():
        chain, parent = [name], twin.parent
        while parent is not None:
            if parent not in twins or parent in chain:
                raise ConfigError(
                    f"expected parents among {names} without a circle, got {twin.parent!r} as the parent of {name!r}"
                )
            chain.append(parent)
            parent = twins[parent].parent
        for part in reversed(chain):
            k = names.index(part)
            if twins[part].parent is not None and k not in order:
                order.append(k)
    return order
