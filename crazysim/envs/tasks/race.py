"""Race through gates, in their order, and hit nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import FunctionPlugin, Placement, Simulation
from crazysim.core.stage import stage
from crazysim.envs.env import Task
from crazysim.envs.random import uniform
from crazysim.envs.spawn import flying
from crazysim.envs.tasks.core import NAME, check_collisions, nearest, others_near, pick
from crazysim.envs.tracks import Track, checked, n_random, random_course, start_offsets
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree, leaf, static

OPENING = 0.45
"""Width and height of a gate's opening, m."""
SENSOR_RANGE = 0.7
"""Distance in the plane below which a drone sees where a gate or obstacle really is, m."""
POLE_HEIGHT = 1.7
"""Height of an obstacle, m; what is too long for its place is below the floor."""
START_JITTER = (0.1, 0.1, 0.05, 0.1, 0.1, 0.1)
"""Most of each component of a start's distance from its place, m, and of its roll, pitch and yaw, rad."""
MASS, INERTIA = 0.115, 0.04
"""Most that mass and inertia differ from the airframe's at level 1, 1: 5 g and 1e-6 kg m^2 of a cf21B_500, as there."""
GATE_JITTER = (0.15, 0.15, 0.1, 0.05, 0.1, 0.2)
"""Most that a gate is moved, m, and turned, rad, at level 2."""
OBSTACLE_JITTER = (0.15, 0.15, 0.05)
"""Most that an obstacle is moved at level 2, m."""
AROUND = 0.45
"""Distance from the middle of a gate at which a way around it passes, m."""
FUNNEL = 0.15
"""Distance from the axis of a gate, m, that is no detour at the gate itself; it grows by a metre for each before it."""
CORNERS = OPENING / 2 * np.array([[0, 1, 1], [0, 1, -1], [0, -1, -1], [0, -1, 1]])
"""Corners of the opening in the gate's frame, m. (4, 3)"""

Reward = Callable[[SimData, Array, Array], Array]
"""``reward(data, action, last_action)``. (n_worlds, n_drones)"""


class Race(PyTree):
    """How far each drone has come, and what it has seen."""

    passed: Array = leaf("drone", 0)
    """Gates passed, which is the number of the next. (n_worlds, n_drones)"""
    disabled: Array = leaf("drone", 0)
    """Whether it is out of the race: it touched something, or left the arena. (n_worlds, n_drones)"""
    last_pos: Array = leaf("drone", 1)
    """Where it was a step ago, m. (n_worlds, n_drones, 3)"""
    gates_visited: Array = leaf("drone", 1)
    """Which gates it had been near to before this environment step. (n_worlds, n_drones, n_gates)"""
    obstacles_visited: Array = leaf("drone", 1)
    """Which obstacles. (n_worlds, n_drones, n_obstacles)"""
    passed_before: Array = leaf("drone", 0)
    """Gates passed before this environment step. (n_worlds, n_drones)"""
    out_before: Array = leaf("drone", 0)
    """Whether it was finished or disabled before this environment step. (n_worlds, n_drones)"""
    to_go_before: Array = leaf("drone", 0)
    """Way to go before this environment step, m. (n_worlds, n_drones)"""
    nominal_pos: Array | None = leaf("world", 2)
    """Where gates, then obstacles are said to be, m; None if they are there. (n_worlds, 1, n, 3)"""
    nominal_quat: Array | None = leaf("world", 2)
    """Attitudes that gates are said to have, xyzw; None if they have. (n_worlds, 1, n_gates, 4)"""
    places: tuple[int, int, int, int] = static()
    """First gate, last gate and one, first obstacle, last obstacle and one, in ``data.objects``."""

    @property
    def finished(self) -> Array:
        """Whether a drone has passed all gates. (n_worlds, n_drones)"""
        return self.passed >= self.gates_visited.shape[-1]

    @property
    def out(self) -> Array:
        """Whether a drone is finished or disabled. (n_worlds, n_drones)"""
        return self.finished | self.disabled


def race(
    sim: Simulation,
    level: int = 0,
    track: Track | None = None,
    sensor_range: float = SENSOR_RANGE,
    seconds: float = 12.0,
    reward: Reward | None = None,
    practice: bool = False,
) -> Task:
    """Return the task of racing through gates among obstacles, by the rules of lsy_drone_racing.

    A gate is passed when its plane is crossed along its x axis within the opening. A drone is disabled when it touches
    a gate, an obstacle, the floor or another drone, or leaves the arena; contacts are checked at every physics step.
    The others race on as if it were not there. An episode ends when every drone is disabled or has passed all gates.

    | Level | Drawn for every episode |
    | --- | --- |
    | 0 | where drones start, within 0.1 m, as at all levels |
    | 1 | besides, mass and inertia of each drone |
    | 2 | besides, how far gates and obstacles are from where they are said to be |
    | 3 | besides, where they are said to be |

    Args:
        sim: The simulation, which is given gates, obstacles, and, from level 1 on, masses and inertias per drone.
        level: What is drawn, 0 to 3.
        track: The course; None for that of lsy_drone_racing. Level 3 takes numbers, heights and limits from it.
        sensor_range: Distance in the plane below which a drone sees where a gate or an obstacle really is, m.
        seconds: Length of an episode, s.
        reward: What is rewarded; None for ``dense``, ``sparse`` is another.
        practice: Whether an episode begins anywhere on the course, for learning: as often as at the start, a drone is
            behind a gate that counts as passed.

    Raises:
        ConfigError: If there is no such level, the track cannot be flown from its starts, or several drones practise.
    """
    if level not in (0, 1, 2, 3):
        raise ConfigError(f"level is {level!r}; a race has level 0, 1, 2 or 3")
    if practice and sim.n_drones > 1:
        raise ConfigError(f"practice is for a single drone; behind a gate there is no room for {sim.n_drones}")
    jitter = np.linalg.norm(START_JITTER[:2]) + (np.linalg.norm(GATE_JITTER[:2]) if level == 2 else 0)
    course = checked(Track() if track is None else track, sim.n_drones, float(jitter), level == 3)
    n_gates, n_obstacles, n_drones = course.n_gates, course.n_obstacles, sim.n_drones
    gates_rpy = np.asarray(course.gates_rpy, float)
    gates_quat = np.asarray(rotation.from_rpy(jnp.asarray(gates_rpy)))
    foot = np.array([0.0, 0.0, POLE_HEIGHT])
    tallest = float(np.max(np.asarray(course.gates_pos)[:, 2])) + GATE_JITTER[2]
    # One post for all, so that they are computed side by side: what is too long for a gate is below the floor.
    gates = sim.scene.add("gate", count=n_gates, pos=course.gates_pos, quat=gates_quat, stand=tallest,
                          width=OPENING, height=OPENING)  # fmt: skip
    obstacles = sim.scene.add(
        "pole", "obstacle", count=n_obstacles, pos=np.asarray(course.obstacles_pos, float) - foot, height=POLE_HEIGHT
    )
    params = sim.data.params
    nominal = {name: getattr(params, name) for name in ("mass", "J", "J_inv")}
    if level >= 1:
        # They may be one per drone already.
        each = {k: jnp.broadcast_to(x, (sim.n_worlds, n_drones, *x.shape[-(1 if k == "mass" else 2):]))
                for k, x in nominal.items()}  # fmt: skip
        sim.data = sim.data.replace(params=params.replace(**each))
        sim.build_default_data()
    _install(sim, gates, obstacles, course, level >= 2)

    def spawn(data: SimData, keys: Array) -> SimData:
        sizes = [6 * n_drones, 4 * n_drones * (level >= 1), (6 * n_gates + 3 * n_obstacles) * (level >= 2)]
        sizes.append(n_random(course) if level == 3 else 0)
        x = uniform(keys, sum(sizes) + 3 * practice)
        start_x, inertial_x, moved_x, course_x, practice_x = jnp.split(x, np.cumsum(sizes), axis=-1)
        record = data.plugins[NAME]
        start = np.asarray(course.start, float).astype(x.dtype)
        if level >= 2:
            pos, quat = np.asarray(course.gates_pos, float), gates_quat
            poles = np.asarray(course.obstacles_pos, float)
            if level == 3:
                start, pos, quat, poles = random_course(course, course_x)
            gate_x, pole_x = jnp.split(2 * moved_x - 1, [6 * n_gates], axis=-1)
            gate_x = gate_x.reshape(-1, n_gates, 6) * np.array(GATE_JITTER, x.dtype)
            pole_x = pole_x.reshape(-1, n_obstacles, 3) * np.array(OBSTACLE_JITTER, x.dtype)
            pos, quat, poles = (jnp.asarray(v, x.dtype) for v in (pos, quat, poles))
            record = record.replace(
                nominal_pos=_of_worlds(jnp.concatenate([pos, poles], axis=-2), record.nominal_pos),
                nominal_quat=_of_worlds(quat, record.nominal_quat),
            )
            turned = rotation.multiply(quat, rotation.from_rpy(gate_x[..., 3:]))
            data = gates.set_pose(data, pos + gate_x[..., :3], turned)
            data = obstacles.set_pose(data, poles + pole_x - foot.astype(x.dtype))
            start = start[..., None, :]
        if level >= 1:
            shares = 2 * inertial_x.reshape(-1, n_drones, 4) - 1
            data = data.replace(params=_drawn(data.params, nominal, shares))
        off = (2 * start_x.reshape(-1, n_drones, 6) - 1) * np.array(START_JITTER, x.dtype)
        at = start + start_offsets(n_drones).astype(x.dtype) + off[..., :3]
        vel: Any = 0.0
        if practice:
            passed = (practice_x[:, :1] * n_gates).astype(jnp.int32)
            behind, vel = _behind(data, passed, practice_x[:, None, 1:])
            at = jnp.where(passed[..., None] > 0, behind, at)
            record = record.replace(passed=passed)
        data = flying(data, at, rotation.from_rpy(off[..., 3:]), vel)
        return data.replace(plugins=data.plugins | {NAME: record.replace(last_pos=data.states.pos)})

    def mark(data: SimData) -> SimData:
        record = race_of(data)
        seen_gates, seen_obstacles = visited(data, sensor_range)
        new = record.replace(
            gates_visited=seen_gates,
            obstacles_visited=seen_obstacles,
            passed_before=record.passed,
            out_before=record.out,
            to_go_before=to_go(data),
        )
        return data.replace(plugins=data.plugins | {NAME: new})

    def terminated(data: SimData) -> Array:
        return jnp.all(race_of(data).out, axis=-1)

    def info(data: SimData) -> dict[str, Array]:
        record = race_of(data)
        return {"gates_passed": record.passed, "finished": record.finished, "disabled": record.disabled}

    return Task(
        "race",
        spawn,
        observe=lambda data: observe(data, sensor_range),
        reward=dense if reward is None else reward,
        terminated=terminated,
        error=to_next_gate,
        info=info,
        mark=mark,
        target=lambda data: _next_gate(data)[0],
        succeeded=lambda data: race_of(data).finished,
        seconds=seconds,
        camera={"lookat": (0, 0, 0.7), "distance": 6.0, "elevation": -40},
        settings={
            "level": level,
            "sensor_range": sensor_range,
            "seconds": seconds,
            "track": course.settings(),
            "practice": practice,
        },
    )


# The rules, in the step ---------------------------------------------------------------------------------------------


def _install(sim: Simulation, gates: Any, obstacles: Any, course: Track, moved: bool) -> None:
    """Put the record and the rules into the simulation."""
    shape, n_gates, n_obstacles = (sim.n_worlds, sim.n_drones), len(gates), len(obstacles)
    pos = sim.data.states.pos
    zero, none = jnp.zeros(shape, jnp.int32), jnp.zeros(shape, bool)
    record = Race(
        passed=zero,
        disabled=none,
        last_pos=jnp.zeros_like(pos),
        gates_visited=jnp.zeros((*shape, n_gates), bool),
        obstacles_visited=jnp.zeros((*shape, n_obstacles), bool),
        passed_before=zero,
        out_before=none,
        to_go_before=jnp.zeros(shape, pos.dtype),
        nominal_pos=jnp.zeros((sim.n_worlds, 1, n_gates + n_obstacles, 3), pos.dtype) if moved else None,
        nominal_quat=jnp.zeros((sim.n_worlds, 1, n_gates, 4), pos.dtype) if moved else None,
        places=(gates.places[0], gates.places[-1] + 1, obstacles.places[0], obstacles.places[-1] + 1),
    )
    low, high = (np.asarray(x, float).astype(pos.dtype) for x in (course.low, course.high))
    contacts = sim.scene.contact_fn([gates, obstacles], drones=False)

    @stage("drone")
    def advance(data: SimData) -> SimData:
        """Disable a drone that touches something or leaves the arena; else count the gate that it passes."""
        record, pos = race_of(data), data.states.pos
        left = jnp.any((pos < low) | (pos > high), axis=-1)
        disabled = record.disabled | (~record.finished & (left | contacts(data).any))
        passed = record.passed + (passes(data) & ~disabled)
        new = record.replace(passed=passed, disabled=disabled, last_pos=pos)
        return data.replace(plugins=data.plugins | {NAME: new})

    sim.add(FunctionPlugin(NAME, record, [Placement(advance, before="increment_steps")]))
    check_collisions(sim)


def passes(data: SimData) -> Array:
    """Return whether the last step led forwards through the opening of the next gate. (...)"""
    record = race_of(data)
    pos, quat = _next_gate(data)
    before, now = (rotation.rotate_inverse(quat, x - pos) for x in (record.last_pos, data.states.pos))
    crossed = (before[..., 0] < 0) & (now[..., 0] >= 0)
    share = before[..., :1] / jnp.where(crossed[..., None], before[..., :1] - now[..., :1], 1)
    there = before + share * (now - before)
    return crossed & jnp.all(jnp.abs(there[..., 1:]) < OPENING / 2, axis=-1) & ~record.finished


def race_of(data: SimData) -> Race:
    """Return the race's record."""
    return data.plugins[NAME]


def gates_of(data: SimData) -> tuple[Array, Array]:
    """Return where the gates are, m (..., n_gates, 3), and their attitudes, xyzw (..., n_gates, 4)."""
    first, last, *_ = race_of(data).places
    return data.objects.pos[..., first:last, :], data.objects.quat[..., first:last, :]  # type: ignore[union-attr]


def obstacles_of(data: SimData) -> Array:
    """Return the upper ends of the obstacles, m. (..., n_obstacles, 3)"""
    *_, first, last = race_of(data).places
    pos = data.objects.pos[..., first:last, :]  # type: ignore[union-attr]
    return pos + np.array([0.0, 0.0, POLE_HEIGHT], pos.dtype)


def _next_gate(data: SimData) -> tuple[Array, Array]:
    """Return position and attitude of each drone's next gate, the last where it has finished. (..., 3), (..., 4)"""
    pos, quat = gates_of(data)
    number = jnp.minimum(race_of(data).passed, pos.shape[-2] - 1)
    return pick(pos, number), pick(quat, number)


# What is seen and rewarded, of all worlds -----------------------------------------------------------------------------


def visited(data: SimData, sensor_range: float) -> tuple[Array, Array]:
    """Return which gates and obstacles each drone is or has been near to. (n_worlds, n_drones, n) each"""
    record = race_of(data)

    def near(pos: Array) -> Array:
        flat = (pos - data.states.pos[..., None, :])[..., :2]
        return jnp.sum(flat * flat, axis=-1) < sensor_range**2

    return record.gates_visited | near(gates_of(data)[0]), record.obstacles_visited | near(obstacles_of(data))


def observe(data: SimData, sensor_range: float = SENSOR_RANGE) -> dict[str, Array]:
    """Return what a drone knows: the keys of lsy_drone_racing, as numbers in a row, and some more for small networks.

    Those are ``rot`` (9), ``vel_body`` (3), ``gate_corners``, of the next two gates in the drone's frame (24),
    ``obstacles_near``, ways to the axes of the next two poles (6), and with several drones ``drones_near``, the
    nearest two of those still in the race (6); all as far as it knows, in its own frame, m.
    """
    record, s = race_of(data), data.states
    (gates_pos, gates_quat), poles = gates_of(data), obstacles_of(data)
    seen_gates, seen_obstacles = visited(data, sensor_range)
    n_gates, n_obstacles = seen_gates.shape[-1], seen_obstacles.shape[-1]
    said, turned_so = record.nominal_pos, record.nominal_quat
    if said is not None and turned_so is not None:
        gates_pos = jnp.where(seen_gates[..., None], gates_pos, said[..., :n_gates, :])
        gates_quat = jnp.where(seen_gates[..., None], gates_quat, turned_so)
        poles = jnp.where(seen_obstacles[..., None], poles, said[..., n_gates:, :])
    turned = rotation.matrix(s.quat)

    def in_body(world: Array) -> Array:
        return rotation.matvec(jnp.swapaxes(turned, -1, -2)[..., None, :, :], world)

    corners = []
    for k in (0, 1):
        number = jnp.minimum(record.passed + k, n_gates - 1)
        pos, quat = pick(gates_pos, number)[..., None, :], pick(gates_quat, number)[..., None, :]
        around = pos + rotation.rotate(quat, jnp.asarray(CORNERS, pos.dtype))
        corners.append(in_body(around - s.pos[..., None, :]))
    to_poles = (poles - s.pos[..., None, :]) * np.array([1, 1, 0], s.pos.dtype)
    far = jnp.sum(to_poles * to_poles, axis=-1)
    obs = {
        "pos": s.pos,
        "quat": s.quat,
        "vel": s.vel,
        "ang_vel": s.ang_vel,
        "target_gate": jnp.where(record.finished, -1, record.passed)[..., None],
        "gates_pos": gates_pos,
        "gates_quat": gates_quat,
        "gates_visited": seen_gates,
        "obstacles_pos": poles,
        "obstacles_visited": seen_obstacles,
        "rot": turned,
        "vel_body": in_body(s.vel[..., None, :]),
        "gate_corners": jnp.concatenate(corners, axis=-2),
        "obstacles_near": in_body(nearest(far, to_poles, min(2, n_obstacles))),
    }
    if s.pos.shape[1] > 1:
        obs["drones_near"] = in_body(others_near(data, 2, ~record.out)[0])
    shape = s.pos.shape[:2]
    return {
        name: jnp.broadcast_to(x, (*shape, *x.shape[2:])).reshape(*shape, -1).astype(s.pos.dtype)
        for name, x in obs.items()
    }


def to_next_gate(data: SimData) -> Array:
    """Return the distance to the middle of the next gate, m; zero where all are passed. (n_worlds, n_drones)"""
    pos, _ = _next_gate(data)
    return jnp.where(race_of(data).finished, 0, rotation.safe_norm(data.states.pos - pos)[..., 0])


def to_go(data: SimData) -> Array:
    """Return the way to the end of the course through the middle of every gate, m. (n_worlds, n_drones)"""
    record = race_of(data)
    pos, quat = gates_of(data)
    legs = way(rotation.rotate_inverse(quat[..., 1:, :], pos[..., :-1, :] - pos[..., 1:, :]))
    left = jnp.arange(1, pos.shape[-2]) > record.passed[..., None]
    next_pos, next_quat = _next_gate(data)
    first = way(rotation.rotate_inverse(next_quat, data.states.pos - next_pos))
    return jnp.where(record.finished, 0, first + jnp.sum(jnp.where(left, legs, 0), axis=-1))


def way(pos: Array) -> Array:
    """Return how far it is to the middle of a gate, from beside it by a detour, and from behind it around its frame, m.

    In a straight line the nearest place of all would be one beside the frame, from which the frame is in the way.

    Args:
        pos: Place in the gate's frame, m. (..., 3)

    Returns:
        (...)
    """
    beside = AROUND * np.array([[0, 1, 0], [0, -1, 0], [0, 0, 1]], pos.dtype)
    around = rotation.safe_norm(pos[..., None, :] - beside)[..., 0]
    off = rotation.safe_norm(pos[..., 1:])[..., 0]
    detour = jnp.maximum(off - (FUNNEL - pos[..., 0]), 0)
    behind = 2 * AROUND - FUNNEL + jnp.min(around, axis=-1)
    return jnp.where(pos[..., 0] > 0, behind, rotation.safe_norm(pos)[..., 0] + detour)


def dense(data: SimData, action: Array, last_action: Array) -> Array:
    """Twice the way gained, m, and 2 for each gate, less what is spent on turning and jerky actions; -2 if disabled."""
    record = race_of(data)
    spin = jnp.sum(jnp.square(data.states.ang_vel), axis=-1)
    jerk = jnp.sum(jnp.square(action - last_action), axis=-1)
    gained = record.to_go_before - to_go(data)
    gates = record.passed - record.passed_before
    paid = 2.0 * gained + 2.0 * gates - 0.001 * spin - 0.01 * jerk - 2.0 * record.disabled
    return jnp.where(record.out_before, 0, paid)


def sparse(data: SimData, action: Array, last_action: Array) -> Array:
    """1 for each gate passed, -1 where the drone is disabled, and nothing afterwards."""
    del action, last_action
    record = race_of(data)
    gates = (record.passed - record.passed_before).astype(data.states.pos.dtype)
    return jnp.where(record.out_before, 0, gates - record.disabled)


# What is drawn ------------------------------------------------------------------------------------------------------


def _drawn(params: Any, nominal: dict[str, Array], shares: Array) -> Any:
    """Return parameters with other masses and inertias, from numbers in [-1, 1]. (n_worlds, n_drones, 4)"""
    mass = nominal["mass"] * (1 + MASS * shares[..., :1])
    root = jnp.sqrt(1 + INERTIA * shares[..., 1:])
    scale = root[..., :, None] * root[..., None, :]
    return params.replace(mass=mass, J=nominal["J"] * scale, J_inv=nominal["J_inv"] / scale)


def _behind(data: SimData, passed: Array, x: Array) -> tuple[Array, Array]:
    """Return where a drone may be that has just passed some gates, m, and its velocity, m/s; at rest if it has not.

    Args:
        data: The simulation.
        passed: Gates passed. (n_worlds, 1)
        x: Numbers in [0, 1]. (n_worlds, 1, 2)

    Returns:
        (n_worlds, 1, 3) each
    """
    pos, quat = (pick(v, jnp.maximum(passed - 1, 0)) for v in gates_of(data))
    ahead = rotation.rotate(quat, jnp.asarray([1.0, 0.0, 0.0], pos.dtype))
    return pos + (0.15 + 0.15 * x[..., :1]) * ahead, jnp.where(passed[..., None] > 0, x[..., 1:], 0) * ahead


def _of_worlds(x: Array, like: Array | None) -> Array:
    """Return poses as leaves of worlds. (n_worlds, n, k) or (n, k) to (n_worlds, 1, n, k)"""
    return jnp.broadcast_to(x[..., None, :, :] if x.ndim == 3 else x, like.shape)  # type: ignore[union-attr]
