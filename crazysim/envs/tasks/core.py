"""What tasks have in common: a goal that is part of the data, the usual observations, and the edge of the arena."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.pipeline import insert_fn_before
from crazysim.core.plugin import FunctionPlugin, Simulation
from crazysim.core.stage import stage
from crazysim.pytree import PyTree, leaf

NAME = "task"
"""Name of a task's record in ``data.plugins``."""
FLOOR = 0.02
"""Height of the centre below which a drone has crashed, m."""


class Goal(PyTree):
    """Where a drone is to be."""

    pos: Array = leaf("drone", 1)
    """Position, world frame, m. (n_worlds, n_drones, 3)"""
    vel: Array = leaf("drone", 1)
    """Velocity, world frame, m/s. (n_worlds, n_drones, 3)"""


def install_goal(sim: Simulation) -> None:
    """Give every drone a goal, ``data.plugins["task"]``, at the origin and at rest."""
    sim.add(FunctionPlugin(NAME, Goal(jnp.zeros_like(sim.data.states.pos), jnp.zeros_like(sim.data.states.pos))))


def goal_of(data: SimData) -> Goal:
    """Return the goals."""
    return data.plugins[NAME]


def with_goal(data: SimData, pos: ArrayLike, vel: ArrayLike = 0.0) -> SimData:
    """Return the data with other goals, (n_worlds, n_drones, 3) each."""
    pos = jnp.broadcast_to(pos, data.states.pos.shape)
    return data.replace(plugins=data.plugins | {NAME: Goal(pos, jnp.broadcast_to(vel, pos.shape))})


def state_of(data: SimData) -> dict[str, Array]:
    """Return position, m, attitude as the nine entries of its matrix, velocity, m/s, body rates, rad/s."""
    s = data.states
    turned = rotation.matrix(s.quat)
    return {
        "pos": s.pos,
        "rot": turned.reshape(*turned.shape[:-2], 9),
        "vel": s.vel,
        "ang_vel": s.ang_vel,
    }


def away(data: SimData) -> Array:
    """Return the distance from the goal, m. (n_worlds, n_drones)"""
    return rotation.safe_norm(goal_of(data).pos - data.states.pos)[..., 0]


def on_floor(data: SimData) -> Array:
    """Return which drones are on the floor, or below. (n_worlds, n_drones)"""
    return data.states.pos[..., 2] < FLOOR


def out_of_bounds(data: SimData, half_width: float, height: float) -> Array:
    """Return which drones are on the floor, too high, or too far from the z axis. (n_worlds, n_drones)"""
    pos = data.states.pos
    return on_floor(data) | (pos[..., 2] > height) | jnp.any(jnp.abs(pos[..., :2]) > half_width, axis=-1)


def pick(x: Array, number: Array) -> Array:
    """Return the entry of each drone's own number: a choice among all, which costs less than looking one up.

    Args:
        x: Entries. (..., n, k)
        number: Which of the n. (...)

    Returns:
        (..., k)
    """
    chosen = number[..., None, None] == np.arange(x.shape[-2])[:, None]
    return jnp.sum(jnp.where(chosen, x, 0), axis=-2)


def nearest(distance: Array, x: Array, n: int) -> Array:
    """Return the entries of the least distances, nearest first.

    Args:
        distance: Distances, m. (..., m)
        x: What is to be sorted by them. (..., m, k)
        n: How many are wanted, at most m.

    Returns:
        (..., n, k)
    """
    out = []
    for _ in range(n):
        first = jnp.argmin(distance, axis=-1)
        out.append(pick(x, first))
        distance = jnp.where(first[..., None] == np.arange(x.shape[-2]), jnp.inf, distance)
    return jnp.stack(out, axis=-2)


def check_collisions(sim: Simulation) -> None:
    """Have drones that touch each other disabled at every step, in the task's record, before its own stage.

    Of drones that the record has as ``out`` nothing is noticed: they are neither disabled nor do they disable others.
    The record needs leaves ``disabled`` and ``out``, (n_worlds, n_drones) each.
    """
    if sim.n_drones == 1:
        return
    contacts = sim.scene.contact_fn((), floor=False)

    @stage("world")
    def collide(data: SimData) -> SimData:
        record, s = data.plugins[NAME], data.states
        out = record.out
        # Only for the question: each that is out is so far away that it touches nothing, and no other that is out.
        far = 1000.0 * (1 + np.arange(len(out)))[:, None] * np.array([0.0, 0.0, 1.0])
        elsewhere = jnp.where(out[:, None], far.astype(s.pos.dtype), s.pos)
        hit = contacts(data.replace(states=s.replace(pos=elsewhere))).any & ~out
        new = record.replace(disabled=record.disabled | hit)
        return data.replace(plugins=data.plugins | {NAME: new})

    insert_fn_before(sim.step_pipeline, NAME, collide, f"{NAME}_collisions")
    sim.build_step_fn()


def others_near(data: SimData, n: int, counts: Array | None = None) -> tuple[Array, Array]:
    """Return where the nearest other drones are relative to each, m, and their relative velocities, m/s.

    Args:
        data: The simulation.
        n: How many are wanted; less where there are fewer.
        counts: Which drones are to be seen; None for all. What is not there is zero. (n_worlds, n_drones)

    Returns:
        (n_worlds, n_drones, n, 3) each
    """
    s = data.states
    n_drones = s.pos.shape[1]
    seen = ~np.eye(n_drones, dtype=bool) if counts is None else counts[:, None] & ~np.eye(n_drones, dtype=bool)
    apart, passing = (jnp.where(seen[..., None], x[:, None] - x[:, :, None], 0) for x in (s.pos, s.vel))
    far = jnp.where(seen, jnp.sum(apart * apart, axis=-1), jnp.inf)
    found = nearest(far, jnp.concatenate([apart, passing], axis=-1), min(n, n_drones - 1))
    return found[..., :3], found[..., 3:]
