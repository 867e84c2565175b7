"""Fly to a goal through a field of poles and boxes."""

from __future__ import annotations

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
from crazysim.envs.tasks.core import NAME, check_collisions, nearest, others_near, state_of
from crazysim.envs.tracks import ranks
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree, leaf

CELL, IN_CELL = 0.8, 0.15
"""Width of the cells that obstacles stand in, one at most in each, and most of each component of the distance from a
cell's middle, m: a drone fits between a pole and whatever is next to it."""
LENGTH = 4
"""Cells from the starts to the goals."""
GAP = 0.6
"""Distance of starts and goals from the field, m."""
POLE_RADIUS, BOX = 0.05, 0.3
"""Radius of a pole, and width of a box, m."""
HEIGHT = 2.0
"""Height of poles and ceiling, m."""
JITTER = 0.15
"""Most of each component of the distance of starts and goals from their places, m."""
SPACING = 0.6
"""Distance of starts, and of goals, of several drones, m."""


class Flight(PyTree):
    """Where each drone is to go, and how that ended."""

    goal: Array = leaf("drone", 1)
    """Where it is to go, m. (n_worlds, n_drones, 3)"""
    reached: Array = leaf("drone", 0)
    """Whether it was there. (n_worlds, n_drones)"""
    disabled: Array = leaf("drone", 0)
    """Whether it has touched something, or left the arena. (n_worlds, n_drones)"""
    out_before: Array = leaf("drone", 0)
    """Whether it had arrived or was disabled before this environment step. (n_worlds, n_drones)"""
    to_go_before: Array = leaf("drone", 0)
    """Distance from the goal before this environment step, m. (n_worlds, n_drones)"""

    @property
    def out(self) -> Array:
        """Whether it has arrived or is disabled. (n_worlds, n_drones)"""
        return self.reached | self.disabled


def avoid(
    sim: Simulation,
    n_poles: int = 8,
    n_boxes: int = 4,
    n_seen: int = 4,
    seconds: float = 8.0,
    tolerance: float = 0.2,
) -> Task:
    """Return the task of flying some 4.5 m through a field of obstacles that stand elsewhere in every episode.

    Poles reach from the floor to the ceiling; boxes hang in the air. A drone is disabled when it touches one, the floor
    or another drone, or leaves the arena; contacts are checked at every physics step. An episode ends when every drone
    is disabled or was at its goal.

    Args:
        sim: The simulation, which is given the obstacles.
        n_poles: Number of poles.
        n_boxes: Number of boxes.
        n_seen: How many of the nearest obstacles a policy sees.
        seconds: Length of an episode, s.
        tolerance: Distance at which a goal counts as reached, m.

    Raises:
        ConfigError: If a number cannot be.
    """
    counts = {"n_poles": n_poles, "n_boxes": n_boxes, "n_seen": n_seen}
    if not all(type(n) is int and n >= 0 for n in counts.values()) or n_poles + n_boxes == 0 or n_seen == 0:
        raise ConfigError(f"{counts}; needed are whole numbers, one obstacle at least, and one seen")
    n, n_drones = n_poles + n_boxes, sim.n_drones
    # At least a third of the cells stays free, and the field is as wide as its drones beside each other.
    width = max(4, -(-3 * n // (2 * LENGTH)), -(-int(10 * SPACING * n_drones) // int(10 * CELL)))
    field = CELL * np.array([LENGTH, width])
    half = np.array([field[0] / 2 + GAP + JITTER + 0.5, field[1] / 2 + 0.5])
    row = SPACING * (np.arange(n_drones) - (n_drones - 1) / 2)
    ends = np.stack([np.full(n_drones, field[0] / 2 + GAP + JITTER), row, np.full(n_drones, HEIGHT / 2)], axis=-1)
    handles = []
    if n_poles:
        handles.append(sim.scene.add("pole", count=n_poles, pos=(0, 0, 0), radius=POLE_RADIUS, height=HEIGHT))
    if n_boxes:
        handles.append(sim.scene.add("box", count=n_boxes, pos=(0, 0, HEIGHT / 2), size=(BOX, BOX, BOX)))
    places = slice(handles[0].places[0], handles[-1].places[-1] + 1)
    # Middle and half size of what is solid, in an object's frame; a pole's radius is taken off the distance.
    middle = np.array([[0, 0, HEIGHT / 2]] * n_poles + [[0, 0, 0]] * n_boxes)
    size = np.array([[0, 0, HEIGHT / 2]] * n_poles + [[BOX / 2] * 3] * n_boxes)
    thick = np.array([POLE_RADIUS] * n_poles + [0.0] * n_boxes)
    contacts = sim.scene.contact_fn(handles, drones=False)
    zero, no = jnp.zeros_like(sim.data.states.pos), jnp.zeros((sim.n_worlds, n_drones), bool)
    record = Flight(zero, no, no, no, zero[..., 0])

    @stage("drone")
    def advance(data: SimData) -> SimData:
        """Disable a drone that touches something or leaves the arena; else tell whether it is at its goal."""
        own, pos = record_of(data), data.states.pos
        left = jnp.any(jnp.abs(pos[:2]) > half.astype(pos.dtype), axis=-1) | (pos[2] > HEIGHT)
        disabled = own.disabled | (~own.reached & (left | contacts(data).any))
        apart = pos - own.goal
        reached = own.reached | (~disabled & (rotation.dot(apart, apart)[0] < tolerance**2))
        new = own.replace(disabled=disabled, reached=reached)
        return data.replace(plugins=data.plugins | {NAME: new})

    sim.add(FunctionPlugin(NAME, record, [Placement(advance, before="increment_steps")]))
    check_collisions(sim)
    n_cells = LENGTH * width

    def spawn(data: SimData, keys: Array) -> SimData:
        x = uniform(keys, n_cells + 4 * n + 12 * n_drones)
        cells, stands, flies = jnp.split(x, [n_cells, n_cells + 4 * n], axis=-1)
        cell = ranks(cells, n)
        stands = 2 * stands.reshape(-1, n, 4) - 1
        corner = jnp.asarray((CELL - field) / 2, x.dtype)
        flat = corner + CELL * jnp.stack([cell % LENGTH, cell // LENGTH], axis=-1) + IN_CELL * stands[..., :2]
        hangs = (np.arange(n) >= n_poles) * jnp.asarray(HEIGHT / 2 + (HEIGHT / 2 - BOX) * stands[..., 2])
        angle = jnp.pi * stands[..., 3:] / 2
        pos = jnp.concatenate([flat, hangs[..., None]], axis=-1)
        quat = jnp.concatenate([0 * angle, 0 * angle, jnp.sin(angle), jnp.cos(angle)], axis=-1)
        first = 0
        for handle in handles:
            some = slice(first, first + len(handle))
            data, first = handle.set_pose(data, pos[:, some], quat[:, some]), some.stop
        off, aim, rpy, vel = jnp.split(2 * flies.reshape(-1, n_drones, 12) - 1, 4, axis=-1)
        at = ends.astype(x.dtype)
        data = flying(data, at * np.array([-1, 1, 1], x.dtype) + JITTER * off, rotation.from_rpy(0.1 * rpy), 0.1 * vel)
        new = record_of(data).replace(goal=at + JITTER * aim)
        return data.replace(plugins=data.plugins | {NAME: new})

    def to_go(data: SimData) -> Array:
        return rotation.safe_norm(record_of(data).goal - data.states.pos)[..., 0]

    def seen(data: SimData) -> Array:
        """Return the ways to the nearest points of the nearest obstacles, m. (n_worlds, n_drones, n_seen, 3)"""
        dtype = data.states.pos.dtype
        pos, quat = (x[..., places, :] for x in (data.objects.pos, data.objects.quat))  # type: ignore[union-attr]
        inside = rotation.rotate_inverse(quat, data.states.pos[..., None, :] - pos) - middle.astype(dtype)
        reach = jnp.asarray(size, dtype)
        ways = rotation.safe_clip(inside, -reach, reach) - inside
        far = rotation.safe_norm(ways)
        gap = far - thick[:, None].astype(dtype)
        ways = rotation.rotate(quat, ways) * (gap / jnp.where(far > 1e-3, far, 1))
        return nearest(gap[..., 0], ways, min(n_seen, n))

    def observe(data: SimData) -> dict[str, Array]:
        ways = seen(data)
        obs = state_of(data) | {
            "difference_to_goal": record_of(data).goal - data.states.pos,
            "obstacles_near": ways.reshape(*ways.shape[:2], -1),
        }
        if n_drones > 1:
            others, _ = others_near(data, 2, ~record_of(data).out)
            obs["drones_near"] = others.reshape(*others.shape[:2], -1)
        return obs

    def mark(data: SimData) -> SimData:
        own = record_of(data)
        new = own.replace(out_before=own.out, to_go_before=to_go(data))
        return data.replace(plugins=data.plugins | {NAME: new})

    def reward(data: SimData, action: Array, last_action: Array) -> Array:
        """Twice the way gained, m; less for being near an obstacle, turning, jerky actions; 10 at the goal, -10 hit."""
        own = record_of(data)
        gap = rotation.safe_norm(seen(data)[..., 0, :])[..., 0]
        spin = jnp.sum(jnp.square(data.states.ang_vel), axis=-1)
        jerk = jnp.sum(jnp.square(action - last_action), axis=-1)
        paid = 2.0 * (own.to_go_before - to_go(data)) - 0.05 * jnp.exp(-10 * gap) - 0.002 * spin - 0.02 * jerk
        return jnp.where(own.out_before, 0, paid + 10.0 * own.reached - 10.0 * own.disabled)

    def info(data: SimData) -> dict[str, Array]:
        return {"reached": record_of(data).reached, "disabled": record_of(data).disabled}

    return Task(
        "avoid",
        spawn,
        observe,
        reward,
        terminated=lambda data: jnp.all(record_of(data).out, axis=-1),
        error=to_go,
        info=info,
        target=lambda data: record_of(data).goal,
        camera={"lookat": (0, 0, 0.5), "distance": 6.5, "elevation": -45},
        mark=mark,
        succeeded=lambda data: record_of(data).reached,
        seconds=seconds,
        tolerance=tolerance,
        settings=counts | {"seconds": seconds, "tolerance": tolerance},
    )


def record_of(data: SimData) -> Flight:
    """Return the task's record."""
    return data.plugins[NAME]
