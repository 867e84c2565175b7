"""Fly a race track alone, as fast as its rotors can."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import StagePlacement, state
from crazysim.core.settings import setting
from crazysim.drones import Airframe
from crazysim.drones.body import body_shape
from crazysim.engine.pytree import static
from crazysim.envs import terms
from crazysim.envs.actions import Actions, rotor_speeds
from crazysim.envs.random import draw, scale_symmetric
from crazysim.envs.spawn import flying
from crazysim.envs.tasks import race_rules as rules
from crazysim.envs.tasks.goals import pick_entry
from crazysim.envs.tasks.race import Race
from crazysim.envs.tracks import Track, gates_of_track
from crazysim.errors import expect
from crazysim.lab.racing.flight import flight_of_plan
from crazysim.lab.racing.time_optimal import plan_race
from crazysim.sim.sim import Sim

STEP = 0.02
"""Time between the rows of the table of a plan, s: straight lines between them deviate by 4 mm at 80 m/s^2."""
AHEAD = (0.0, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3)
"""Times by which observed points of the plan are ahead of the drone, s."""
SLOW = 0.5
"""Speed of the plan below which the phase follows the drone more slowly, m/s: at rest a place has no time."""
MISSED = 0.15
"""Time behind the plan's passing of a gate after which a drone has missed the gate, s."""
START_PHASE = 0.1
"""Phase at the start, s: the plan is at rest before."""
MAX_RATE = 3.0
"""Largest rate at which the phase follows the drone, as a multiple of the plan's."""
MAX_BODY_RATES = (15.0, 15.0, 3.0)
"""Largest roll, pitch and yaw rates of the plan, rad/s, beyond which a flight costs."""
RATE_RESERVE = 1.2
"""Largest commanded body rates as a multiple of the plan's largest ones, 1: corrections add to the plan's rates. Our
choice."""
FINISH_RADIUS = 0.3
"""Radius of the waypoint at the finish, m."""
PRACTICE_DEVIATION = {"pos": 0.2, "rpy": 0.2, "vel": 1.0, "ang_vel": 1.0}
"""Largest deviations from the plan along each axis at starts for practice, m, rad, m/s, rad/s."""


class TimeTrial(Race):
    """Fly through the gates of a track, alone, as fast as the rotors can.

    A time-optimal plan (``plan_race``) shows the way: its time at the place of the drone is the *phase*, and the reward
    is the phase that is won. A policy observes points of the plan that are ahead of its phase and the next gates, and
    may be slower or faster than the plan. A flight fails when the drone is ``width`` away from the plan, misses a gate,
    or touches something. It ends when it has passed all gates and ``Track.finish``, which is a waypoint of one lap, at
    any speed, and succeeds if that takes at most ``slack`` longer than the plan. The error is the time behind the plan,
    s.
    """

    name = "time_trial"
    control = "rotor_vel"
    drone = "uzh_cpc"
    freq = 100
    unit = "s"
    other_failures = ", missed a gate or was too far from the plan"
    recipe = {
        "n_worlds": 16384,
        "iterations": 5000,
        "evaluate_every": 1000,
        "n_steps": 32,
        "minibatches": 8,
        "learning_rate": 1.5e-3,
        "discount": 0.985,
        "gae_lambda": 0.95,
        "entropy": 0.0,
        "init_std": 0.4,
        "hidden": (128, 128),
        "practice": {"practice": True},
    }

    track: Track | str | Path = "split_s_waypoints"
    """The course, or a name or file for ``load_track``."""
    seconds: float = 30.0
    """Length of an episode, s."""
    margin: float = setting(default=0.1, low=0.0)
    """Distance that the plan keeps from the edges of the gates, and the drone from the floor unless the start or a gate
    is lower, m."""
    width: float = setting(default=1.0, positive=True)
    """Largest distance from the plan, m."""
    slack: float = setting(default=0.05, low=0.0)
    """Time that a flight may take longer than the plan, as a fraction of its duration."""
    phase: Array = state((1,))
    """Time of the plan at the place of the drone, s."""
    phase_before: Array = state((1,))
    """The same before this environment step, s."""
    start_time: Array = state((1,))
    """Time of the plan at the start of the episode, s."""
    reference: Reference = static()
    """The plan."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.laps == 1 and self.course.finish is not None:
            object.__setattr__(self, "track", _with_finish(self.course))

    def add_states(self, sim: Sim, placements: Sequence[StagePlacement] = (), **initial: Any) -> None:
        airframe = sim.airframes[0]
        # Drones touch the floor before their middle does; gates may be lower.
        floor = self.margin + float(body_shape(airframe)["collision_sphere"][3])
        floor = min([floor, *(z for *_, z in (self.course.start, *self.course.gates_pos))])
        reference = Reference.of(self.course, airframe, self.margin, floor, self.laps)
        super().add_states(sim, placements, reference=reference, **initial)

    def actions(self, sim: Sim) -> Actions:
        if sim.control == "rotor_vel":
            return rotor_speeds(sim.default_data.params)
        actions = super().actions(sim)
        if sim.control == "body_rate":
            actions.scale[..., :3] = np.multiply(RATE_RESERVE, MAX_BODY_RATES)
        return actions

    def spawn(self, data: SimData, key: Array) -> SimData:
        data = Race.spawn(dataclasses.replace(self, practice=False), data, key)
        reference: Reference = self.read(data).reference
        if not self.practice:
            return self.write(data, phase=jnp.full_like(self.read(data).phase, START_PHASE))
        x = draw(key, data.core.n_drones, phase=1, at_start=1, **dict.fromkeys(PRACTICE_DEVIATION, 3))
        deviation = {name: scale_symmetric(x[name], size) for name, size in PRACTICE_DEVIATION.items()}
        phase = START_PHASE + x["phase"] * (reference.duration - 2 * START_PHASE)
        pos, vel, quat, ang_vel = reference.at(phase)
        from_start = x["at_start"] < 0.1
        phase = jnp.where(from_start, START_PHASE, phase)
        s = data.states
        data = flying(
            data,
            jnp.where(from_start, s.pos, pos + deviation["pos"]),
            jnp.where(from_start, s.quat, rotation.multiply(quat, rotation.from_rpy(deviation["rpy"]))),
            jnp.where(from_start, s.vel, vel + deviation["vel"]),
            jnp.where(from_start, s.ang_vel, ang_vel + deviation["ang_vel"]),
        )
        passed = jnp.sum((phase > np.asarray(reference.passes)).astype(jnp.int32), axis=-1)
        return self.write(data, phase=phase, start_time=phase, passed=passed, last_pos=data.states.pos)

    def before_step(self, data: SimData) -> SimData:
        return self.write(super().before_step(data), phase_before=self.read(data).phase)

    def judge(self, data: SimData, succeeds: Array, fails: Array) -> SimData:
        record = self.read(data)
        pos, vel = record.reference.at(record.phase)[:2]
        offset = data.states.pos - pos
        way, square = (jnp.sum(x * vel, axis=-1, keepdims=True) for x in (offset, vel))
        change = rotation.clip(way / (square + SLOW**2), 0.0, MAX_RATE / data.core.freq)
        phase = jnp.minimum(record.phase + change, record.reference.duration)
        passes = np.asarray([*record.reference.passes, np.inf], phase.dtype)
        due = jnp.asarray(passes)[jnp.minimum(record.passed, len(passes) - 1)][..., None]
        is_lost = (rotation.safe_norm(offset) > self.width) | (phase > due + MISSED)
        return super().judge(self.write(data, phase=phase), succeeds, fails | is_lost[..., 0])

    def observe(self, data: SimData) -> dict[str, Array]:
        """Return attitude, velocities, points of the plan ahead and the next two gates, in the body frame."""
        s, record = data.states, self.read(data)
        times = record.phase[..., None] + np.array(AHEAD, s.pos.dtype)[:, None]
        pos, vel = record.reference.at(jnp.minimum(times, record.reference.duration))[:2]
        n_gates = len(record.reference.passes)
        gates = [
            pick_entry(rules.gates_of(data)[0], jnp.minimum(record.passed + k, n_gates - 1) % self.course.n_gates)
            for k in (0, 1)
        ]
        vectors = {
            "plan_pos": pos - s.pos[..., None, :],
            "plan_vel": vel[..., :4, :],
            "gates": jnp.stack(gates, axis=-2) - s.pos[..., None, :],
            "vel": s.vel[..., None, :],
        }
        inverse = jnp.swapaxes(rotation.matrix(s.quat), -1, -2)[..., None, :, :]
        obs = {name: rotation.matvec(inverse, x).reshape(*x.shape[:-2], -1) for name, x in vectors.items()}
        return obs | {"rot": rotation.matrix(s.quat).reshape(*s.pos.shape[:-1], 9), "ang_vel": s.ang_vel}

    def rewards(self, data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
        record = self.read(data)
        excess = jnp.abs(data.states.ang_vel) - np.array(MAX_BODY_RATES, data.states.pos.dtype)
        return {
            "phase": 100.0 * (record.phase - record.phase_before)[..., 0],
            "rate": -0.05 * jnp.sum(jnp.maximum(excess, 0.0), axis=-1),
            "action_rate": -0.005 * terms.action_rate(action, last_action),
            "beyond": -0.02 * jnp.sum(jnp.square(action - rotation.clip(action, -1.0, 1.0)), axis=-1),
            "lost": -10.0 * record.failure,
            "finish": 10.0 * record.success,
        }

    @property
    def criterion(self) -> str:
        return f"all gates, at most {100 * self.slack:g}% longer than the plan"

    def succeeded(self, data: SimData) -> Array:
        return self.read(data).success & (self.error(data) <= self.slack * self.read(data).reference.passes[-1])

    def error(self, data: SimData) -> Array:
        record = self.read(data)
        time = record.start_time[..., 0] + data.core.steps / data.core.freq
        return time - jnp.where(record.success, record.reference.passes[-1], record.phase[..., 0])


def _with_finish(track: Track) -> Track:
    gates = gates_of_track(track)
    return dataclasses.replace(
        track,
        gates_pos=(*track.gates_pos, track.finish),
        gates_rpy=(*track.gates_rpy, track.gates_rpy[-1]),
        openings=(*(x.opening for x in gates), FINISH_RADIUS),
        frames=(*(x.frame for x in gates), FINISH_RADIUS),
        lengths=(*(x.length for x in gates), 0.0),
        finish=None,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Reference:
    """A plan as a table of states, a constant of compiled programs."""

    rows: NDArray[np.float32]
    """Position, m, velocity, m/s, attitude, xyzw, and angular velocity, rad/s, every ``STEP``. (n, 13)"""
    passes: tuple[float, ...]
    """Times at which the plan passes the gates, s."""
    duration: float
    """Duration of the plan, s."""

    @staticmethod
    def of(track: Track, airframe: Airframe, margin: float, floor: float, laps: int) -> Reference:
        """Plan a flight that keeps a distance from the edges of the gates and a height, once in a process."""
        key = repr((track, airframe.values, margin, floor, laps))
        if key in _REFERENCES:
            return _REFERENCES[key]
        gates = gates_of_track(track)
        openings = [
            float(x.opening) - margin if x.is_ball else np.asarray(x.opening) * (1 - 2 * margin / x.size) for x in gates
        ]
        half = min(float(np.min(x.size)) for x in gates) / 2
        expect(margin < half, f"a margin below {half:g} m, half of the smallest opening", margin)
        inner = dataclasses.replace(track, openings=openings)
        plan = plan_race(inner, airframe, laps=laps, body_rate=MAX_BODY_RATES, floor=floor)
        flight = flight_of_plan(plan, track, laps)
        times = np.arange(0.0, plan.duration + STEP, STEP)
        names = ("pos", "vel", "quat", "ang_vel")
        rows = np.column_stack([np.interp(times, plan.time, x) for name in names for x in getattr(plan, name).T])
        for k, x in enumerate(flight.pos.T):
            rows[:, k] = np.interp(times, flight.time, x)
        passes = np.asarray(flight.clock.times, float)
        _REFERENCES[key] = Reference(rows.astype(np.float32), tuple(passes.tolist()), plan.duration)
        return _REFERENCES[key]

    def at(self, time: Array) -> tuple[Array, Array, Array, Array]:
        """Return position, velocity, attitude and angular velocity at a time. (..., 1) to (..., 3 or 4) each"""
        u = time[..., 0] / STEP
        index = jnp.clip(u.astype(jnp.int32), 0, len(self.rows) - 2)
        share = (u - index)[..., None]
        table = jnp.asarray(self.rows, time.dtype)
        row = (1 - share) * table[index] + share * table[index + 1]
        pos, vel, quat, ang_vel = jnp.split(row, [3, 6, 10], axis=-1)
        return pos, vel, quat / rotation.safe_norm(quat), ang_vel


_REFERENCES: dict[str, Reference] = {}
"""Plans of this process. Programs are the same for the same plan, which is compared by its identity."""
