"""Race through gates in their order without touching anything."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData, SimParams
from crazysim.core.plugin import StagePlacement, state
from crazysim.core.settings import setting
from crazysim.engine.pytree import device_array, host_array, static
from crazysim.engine.stage import stage
from crazysim.envs.race_clock import Openings
from crazysim.envs.random import draw
from crazysim.envs.spawn import flying
from crazysim.envs.tasks import race_rules as rules
from crazysim.envs.tasks.goals import OutcomeTask, ProgressTask, collision_placements, pick_entry
from crazysim.envs.tasks.race_observations import observe, visited_objects
from crazysim.envs.tasks.race_rules import OPENING, POLE_HEIGHT, dense, gates_of, race_of
from crazysim.envs.track_files import load_track
from crazysim.envs.tracks import (
    GATE_COLOR,
    Track,
    check_track,
    count_random_numbers,
    gate_body,
    gates_of_track,
    random_course,
    ranks,
    start_offsets,
)
from crazysim.errors import require
from crazysim.scene.objects import Handle
from crazysim.sim.sim import Sim

SENSOR_RANGE = 0.7
"""Distance in the plane below which a drone observes the true pose of a gate or obstacle, m."""
START_JITTER = (0.1, 0.1, 0.05, 0.1, 0.1, 0.1)
"""Largest offset of a start along x, y and z, m, and largest roll, pitch and yaw at the start, rad."""
MASS_DEVIATION, INERTIA_DEVIATION = 0.115, 0.04
"""Largest relative deviations of mass and inertia from the airframe's values, at level 1 and above. For a cf21B_500
these are 5 g and 1e-6 kg m^2, as in lsy_drone_racing."""
GATE_JITTER = (0.15, 0.15, 0.1, 0.05, 0.1, 0.2)
"""Largest displacement of a gate along x, y and z, m, and by roll, pitch and yaw, rad, at level 2 and above."""
OBSTACLE_JITTER = (0.15, 0.15, 0.05)
"""Largest displacement of an obstacle along x, y and z at level 2 and above, m."""
FOOT_TO_TOP = np.array([0.0, 0.0, POLE_HEIGHT])
"""Vector from the foot of an obstacle to its upper end, m."""

Rewards = Callable[[SimData, Array, Array], dict[str, Array]]
"""``rewards(data, action, last_action)``: terms by name. (n_drones,) each"""


class Race(ProgressTask, OutcomeTask):
    """Race through gates among obstacles, by the rules of the drone racing project lsy_drone_racing.

    A drone passes a gate when it crosses the gate's plane within the opening, in the direction of the gate's x axis. A
    drone is disabled when it touches a gate, an obstacle, the floor or another drone, or leaves the arena. Contacts are
    checked at every physics step. The other drones continue, and do not collide with disabled drones. An episode ends
    when every drone is disabled or has passed all gates.

    With ``penalty``, gates that are touched or missed cost seconds instead, and drones fly through their frames.

    | Level | Random in every episode |
    | --- | --- |
    | 0 | start of each drone, within 0.1 m |
    | 1 | also mass and inertia of each drone |
    | 2 | also the displacement of gates and obstacles from their nominal poses |
    | 3 | also the nominal poses |
    """

    name = "race"
    outcomes = ("finished", "disabled")
    film_view = {"elevation": -50}
    other_failures: ClassVar[str] = ""
    """What else ends flights of a class, in messages."""
    check_freq: ClassVar[int | None] = None
    """Rate at which gates, contacts and limits are checked, Hz; None for every physics step."""
    shuffles: ClassVar[bool] = False
    """Whether drones draw their places at the start, and in practice their gates."""

    level: int = setting(default=0, low=0, high=3)
    """Amount of randomness, 0 to 3, as in the table above."""
    track: Track | str | Path = field(default_factory=Track)
    """The course, or a name or file for ``load_track``. Level 3 uses only the limits of the arena, and numbers and
    heights of gates and obstacles."""
    sensor_range: float = setting(default=SENSOR_RANGE, low=0.0)
    """Distance in the plane below which a drone observes the true pose of a gate or obstacle, m."""
    laps: int = setting(default=1, low=1, high=100)
    """Number of laps."""
    penalty: float | None = setting(default=None, low=0.0)
    """Seconds that each contact with a gate and each missed gate cost: a gate is missed if the gate after it is passed
    instead; of two gates, none can be missed. None if a contact with a gate disables, and all gates must be passed."""
    seconds: float = 12.0
    """Length of an episode, s."""
    reward: Rewards = dense
    """Function that returns the terms of the reward; ``race_rules.sparse`` is an alternative."""
    practice: bool = False
    """True to start anywhere on the course, for learning: with equal probability at the start or just behind any gate
    except the last. The gates up to there count as passed. Several drones all begin at the start, or behind different
    gates, and one of them at the start if there are as many drones as gates."""

    passed: Array = state((), dtype=np.int32)
    """Number of gates passed in all laps."""
    last_pos: Array = state((3,))
    """Position one physics step ago, m."""
    gates_visited: Array = state(("gates",), dtype=bool)
    """True for gates that the drone was near before this environment step."""
    obstacles_visited: Array = state(("obstacles",), dtype=bool)
    """True for obstacles that the drone was near before this environment step."""
    passed_before: Array = state((), dtype=np.int32)
    """Number of gates passed before this environment step."""
    penalty_sum: Array | None = state((), optional=True)
    """Sum of the penalties, s; None without."""
    penalty_before: Array | None = state((), optional=True)
    """Sum of the penalties before this environment step, s; None without."""
    touches_gate: Array | None = state((), dtype=bool, optional=True)
    """Whether the drone touched a gate in the last physics step; None without penalties."""
    nominal_pos: Array | None = state(("objects", 3), scope="world", optional=True)
    """Nominal positions of gates, then of upper ends of obstacles, m; None if objects are not displaced."""
    nominal_quat: Array | None = state(("gates", 4), scope="world", optional=True)
    """Nominal attitudes of gates, xyzw; None if objects are not displaced."""
    gates: Handle = static()
    """Handle of the gates, in their order."""
    obstacles: Handle | None = static()
    """Handle of the obstacles; None without."""
    openings: Openings | None = static()
    """Openings of the gates; None for squares of 0.45 m."""
    n_laps: int = static()
    """Number of laps."""

    def __post_init__(self) -> None:
        if not isinstance(self.track, Track):
            object.__setattr__(self, "track", load_track(self.track))
        super().__post_init__()

    def install(self, sim: Sim) -> None:
        require(
            not self.practice or sim.n_drones <= self.course.n_gates,
            f"expected at most as many drones as gates for practice, got {sim.n_drones} drones and "
            f"{self.course.n_gates} gates: drones start behind different gates. Use practice=False.",
        )
        jitter = np.linalg.norm(START_JITTER[:2]) + (np.linalg.norm(GATE_JITTER[:2]) if self.level == 2 else 0)
        course = check_track(self.course, sim.n_drones, float(jitter), self.level == 3)
        gates, obstacles = self._add_gates(sim), None
        if course.n_obstacles:
            feet = np.asarray(course.obstacles_pos, float) - FOOT_TO_TOP
            obstacles = sim.scene.add("pole", "obstacle", count=course.n_obstacles, pos=feet, height=POLE_HEIGHT)
        if self.level >= 1:
            _repeat_per_drone(sim, {"mass": 1, "J": 2, "J_inv": 2})
        openings = None if course.openings is None else Openings.of(course)
        # Balls have nothing to touch.
        framed = [gates] if openings is None else [gates[k] for k, (r,) in enumerate(openings.radii) if not r]
        fatal = [*(framed if self.penalty is None else []), *([] if obstacles is None else [obstacles])]
        touches_any, touches_gate = self.touch_fn(sim, fatal, True), None
        if self.penalty is not None and framed:
            touches_gate = self.touch_fn(sim, framed, False)
        n_all = self.laps * course.n_gates
        period = 1 if self.check_freq is None else sim.freq // self.check_freq

        @stage("drone", when=None if period == 1 else lambda data: (data.core.steps + 1) % period == 0)
        def judge(data: SimData) -> SimData:
            fails = self.leaves_arena(data) | touches_any(data)
            record, passes = race_of(data), rules.passes_gate(data)
            flies = ~(record.failure | fails)
            passed = record.passed + (passes & flies)
            if self.penalty is not None:
                skips = ~passes & flies & (passed + 1 < n_all) & rules.passes_gate(data, ahead=1)
                skips &= course.n_gates > 2
                touches = jnp.zeros_like(passes) if touches_gate is None else touches_gate(data)
                hits = touches & ~record.touches_gate & flies & ~record.success
                penalty_sum = record.penalty_sum + self.penalty * (1.0 * skips + hits)
                data = self.write(data, penalty_sum=penalty_sum, touches_gate=touches)
                passed = passed + 2 * skips
            return self.judge(self.write(data, passed=passed, last_pos=data.states.pos), passed >= n_all, fails)

        numbers: dict[str, Any] = {
            "gates_visited": np.zeros(course.n_gates),
            "obstacles_visited": np.zeros(course.n_obstacles),
        }
        if self.level >= 2:
            numbers["nominal_pos"] = np.zeros((course.n_gates + course.n_obstacles, 3))
            numbers["nominal_quat"] = np.zeros((course.n_gates, 4))
        if self.penalty is not None:
            numbers |= dict.fromkeys(("penalty_sum", "penalty_before", "touches_gate"), np.zeros(()))
        placements = [*collision_placements(sim), StagePlacement(judge, before="increment_steps")]
        fixed = {"gates": gates, "obstacles": obstacles, "openings": openings, "n_laps": self.laps}
        self.add_states(sim, placements, **fixed, **numbers)

    def spawn(self, data: SimData, key: Array) -> SimData:
        course, n_drones, dtype = self.course, data.core.n_drones, data.states.pos.dtype
        # Random numbers that this level needs, from one draw.
        sizes: dict[str, int | tuple[int, ...]] = {"start": (n_drones, 6)}
        if self.level >= 1:
            sizes["inertia"] = (n_drones, 4)
        if self.level >= 2:
            sizes |= {"gates": (course.n_gates, 6), "obstacles": (course.n_obstacles, 3)}
        if self.level == 3:
            sizes["course"] = count_random_numbers(course)
        if self.practice:
            sizes |= {"passed": 1, "behind": (n_drones, 2)}
        if self.shuffles:
            sizes["places"] = n_drones
        x = draw(key, **sizes)
        # Displaced objects and start, and other moments of inertia.
        start = np.asarray(course.start, float).astype(dtype)
        if self.level >= 2:
            data, start = self._displace_objects(data, x)
        if self.level >= 1:
            data = data.replace(params=_randomize_inertia(data.params, 2 * x["inertia"] - 1))
        places: Any = ranks(x["places"], n_drones) if self.shuffles else np.arange(n_drones, dtype=np.int32)
        offsets = pick_entry(start_offsets(n_drones).astype(dtype), jnp.asarray(places))
        pos, rpy = self.place_start(start + offsets, x["start"])
        vel = jnp.zeros((), dtype)
        # Practice starts behind any gate.
        if self.practice:
            passed = (x["passed"] * course.n_gates).astype(jnp.int32)
            first = int(n_drones < course.n_gates)  # else one of the drones begins at the start
            passed_gates = first + (passed - first + places) % max(course.n_gates - first, 1)
            passed = jnp.where(passed > 0, passed_gates, 0)
            pos_behind, vel = _pos_behind_gate(data, passed, x["behind"])
            pos = jnp.where(passed[..., None] > 0, pos_behind, pos)
            data = self.write(data, passed=passed)
        data = flying(data, pos, rotation.from_rpy(rpy), vel)
        return self.write(data, last_pos=data.states.pos)

    def place_start(self, start: Array | np.ndarray, x: Array) -> tuple[Array, Array]:
        """Return positions, m, and roll, pitch and yaw, rad, of starts from random numbers. (n_drones, 3) each

        Args:
            start: Nominal starts, m. (n_drones, 3)
            x: Random numbers in [0, 1). (n_drones, 6)
        """
        offset = (2 * x - 1) * np.array(START_JITTER, x.dtype)
        return jnp.asarray(start) + offset[..., :3], offset[..., 3:]

    def touch_fn(self, sim: Sim, objects: Sequence[Handle], floor: bool) -> Callable[[SimData], Array]:
        """Return ``touches(data)``: whether a drone touches gates or obstacles, or the floor if it counts."""
        contacts = sim.scene.contact_fn(objects, floor=floor, drones=False)
        return lambda data: contacts(data).any

    def leaves_arena(self, data: SimData) -> Array:
        """Whether a drone is outside of the limits of the arena. (..., n_drones)"""
        pos = data.states.pos
        low, high = (np.asarray(limit, float).astype(pos.dtype) for limit in (self.course.low, self.course.high))
        return jnp.any((pos < low) | (pos > high), axis=-1)

    def before_step(self, data: SimData) -> SimData:
        visited_gates, visited_obstacles = visited_objects(data, self.sensor_range)
        if self.penalty is not None:
            data = self.write(data, penalty_before=race_of(data).penalty_sum)
        return self.write(
            super().before_step(data),
            gates_visited=visited_gates,
            obstacles_visited=visited_obstacles,
            passed_before=race_of(data).passed,
        )

    def remaining_way(self, data: SimData) -> Array:
        return rules.remaining_way(data)

    def observe(self, data: SimData) -> dict[str, Array]:
        return observe(data, self.sensor_range)

    def rewards(self, data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
        return self.reward(data, action, last_action)

    def error(self, data: SimData) -> Array:
        return rules.next_gate_distance(data)

    def info(self, data: SimData) -> dict[str, Array]:
        penalty = {} if self.penalty is None else {"penalty": race_of(data).penalty_sum}
        return super().info(data) | {"gates_passed": race_of(data).passed} | penalty

    def target(self, data: SimData) -> Array:
        return rules.next_gate(data)[0]

    @property
    def course(self) -> Track:
        """The track, loaded."""
        return self.track  # type: ignore[return-value]

    def gate_colors(self) -> Sequence[Sequence[float]]:
        """Return the colour of each gate, RGBA. (n_gates, 4)"""
        return [GATE_COLOR] * self.course.n_gates

    def _add_gates(self, sim: Sim) -> Handle:
        course, colors = self.course, self.gate_colors()
        poses: dict[str, Any] = {"pos": course.gates_pos, "quat": self._gates_quat()}
        if course.openings is not None:
            gates = gates_of_track(course)
            require(
                not any(gate.length for gate in gates),
                "expected gates without length for the task race, got tunnels. Use length: 0.0.",
            )
            bodies = [gate_body(gate, rgba=rgba) for gate, rgba in zip(gates, colors, strict=True)]
            return sim.scene.add(bodies, "gate", count=course.n_gates, **poses)
        # Posts of all gates have the same length, so that they are computed as one batch; most extend below the floor.
        stand = float(np.max(np.asarray(course.gates_pos)[:, 2])) + GATE_JITTER[2]
        size: dict[str, Any] = {"stand": stand, "width": OPENING, "height": OPENING}
        return sim.scene.add("gate", count=course.n_gates, **poses, **size, rgba=colors)

    def _gates_quat(self) -> np.ndarray:
        with jax.ensure_compile_time_eval():  # returns an array even while a step is traced
            return np.asarray(jax.jit(rotation.from_rpy)(host_array(self.course.gates_rpy, self.course.n_gates, 3)))

    def _displace_objects(self, data: SimData, x: dict[str, Array]) -> tuple[SimData, Array]:
        course, dtype = self.course, data.states.pos.dtype
        start, pos, quat, poles = course.start, course.gates_pos, self._gates_quat(), course.obstacles_pos
        if self.level == 3:
            start, pos, quat, poles = random_course(course, x["course"])
        start, pos, quat, poles = (jnp.asarray(v, dtype) for v in (start, pos, quat, poles))
        gate_shift = (2 * x["gates"] - 1) * np.array(GATE_JITTER, dtype)
        pole_shift = (2 * x["obstacles"] - 1) * np.array(OBSTACLE_JITTER, dtype)
        gates_quat = rotation.multiply(quat, rotation.from_rpy(gate_shift[..., 3:]))
        data = race_of(data).gates.set_pose(data, pos + gate_shift[..., :3], gates_quat)
        if race_of(data).obstacles is not None:
            data = race_of(data).obstacles.set_pose(data, poles + pole_shift - FOOT_TO_TOP.astype(dtype))
        return self.write(data, nominal_pos=jnp.concatenate([pos, poles]), nominal_quat=quat), start


def _repeat_per_drone(sim: Sim, names: Mapping[str, int]) -> None:
    def repeat_params(data: SimData) -> SimData:
        params, shape, per_drone = data.params, data.states.pos.shape[:2], {}
        for name, ndim in names.items():  # a parameter may already have one value per drone
            value = getattr(params, name)
            per_drone[name] = device_array(np.broadcast_to(value, (*shape, *value.shape[-ndim:])), value.dtype)
        return data.replace(params=params.replace(**per_drone))

    sim.data, sim.default_data = repeat_params(sim.data), repeat_params(sim.default_data)


def _randomize_inertia(params: SimParams, x: Array) -> SimParams:
    mass = params.mass * (1 + MASS_DEVIATION * x[..., :1])
    root = jnp.sqrt(1 + INERTIA_DEVIATION * x[..., 1:])
    scale = root[..., :, None] * root[..., None, :]
    return params.replace(mass=mass, J=params.J * scale, J_inv=params.J_inv / scale)


def _pos_behind_gate(data: SimData, passed: Array, x: Array) -> tuple[Array, Array]:
    pos, quat = (pick_entry(v, jnp.maximum(passed - 1, 0)) for v in gates_of(data))
    gate_axis = rotation.rotate(quat, jnp.asarray([1.0, 0.0, 0.0], pos.dtype))
    return pos + (0.15 + 0.15 * x[..., :1]) * gate_axis, jnp.where(passed[..., None] > 0, x[..., 1:], 0) * gate_axis
