"""Change places, or form a formation, without flying into each other or into each other's downwash."""

from __future__ import annotations

from collections.abc import Sequence

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
from crazysim.envs.tasks.core import NAME, on_floor, others_near, state_of
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree, leaf

SEPARATION = (0.24, 0.24, 0.6)
"""Half axes of the ellipsoid around a drone that no other's centre may enter, m: twice the radii of 0.12 m across and
0.3 m along the thrust with which Preiss, Hoenig, Ayanian and Sukhatme (Downwash-aware trajectory planning for large
quadrotor teams, 2017) describe a Crazyflie."""
SPACING = 0.9
"""Least distance of neighbours on the circle that a swarm begins on, m."""
HEIGHT = 1.2
"""Height of the circle, m."""
ROOM = 1.5
"""Distance of the arena's limits from the circle and the formation, m."""
JITTER = 0.1
"""Most of each component of a start's distance from its place on the circle, m."""


class Swarm(PyTree):
    """Where each drone is to be, and how near others have come to it."""

    goal: Array = leaf("drone", 1)
    """Its slot, m. (n_worlds, n_drones, 3)"""
    closest: Array = leaf("drone", 0)
    """Least separation from another drone so far, 1 at the edge of the ellipsoid. (n_worlds, n_drones)"""


def swarm(
    sim: Simulation,
    formation: Sequence[Sequence[float]] | None = None,
    n_seen: int = 3,
    strict: bool = True,
    seconds: float = 8.0,
    tolerance: float = 0.1,
) -> Task:
    """Return the task of changing places on a circle, or of forming a formation, at a distance from each other.

    A swarm begins on a circle that is turned at random. Without a formation each drone is to take the place of another,
    the same number of places on for all. No drone may come into the ellipsoid around another, 0.24 m wide and 0.6 m
    high each way, below which it would also fly in its downwash; that is checked at every physics step. An episode ends
    when one does, if ``strict``, on the floor, and 1.5 m outside of circle and formation.

    Args:
        sim: The simulation, of two drones a world at least; it is given their goals.
        formation: Where the drones are to be, in their order, m; None to change places. (n_drones, 3)
        n_seen: How many of the nearest others a drone sees.
        strict: Whether an episode ends when two come too near; they pay for it in any case.
        seconds: Length of an episode, s.
        tolerance: Distance below which a drone counts as in its slot, m.

    Raises:
        ConfigError: If there is one drone only, or the formation cannot be.
    """
    n = sim.n_drones
    if n < 2:
        raise ConfigError("a swarm has two drones at least: make the simulation with n_drones=2 or more")
    if type(n_seen) is not int or n_seen < 1:
        raise ConfigError(f"n_seen is {n_seen!r}; a drone sees 1 of the others at least")
    slots = None if formation is None else as_formation(formation, n)
    radius = max(SPACING, SPACING / (2 * np.sin(np.pi / n)))
    far = np.array([radius, radius, HEIGHT]) if slots is None else np.maximum(radius, np.abs(slots).max(axis=0))
    limit = far + ROOM
    zero = jnp.zeros_like(sim.data.states.pos)
    record = Swarm(zero, jnp.full(zero.shape[:2], jnp.inf, zero.dtype))

    @stage("world")
    def keep(data: SimData) -> SimData:
        """Note how near others have come."""
        own = record_of(data)
        new = own.replace(closest=jnp.minimum(own.closest, separation(data.states.pos)))
        return data.replace(plugins=data.plugins | {NAME: new})

    sim.add(FunctionPlugin(NAME, record, [Placement(keep, before="increment_steps")]))

    def spawn(data: SimData, keys: Array) -> SimData:
        x = uniform(keys, 2 + 9 * n)
        off, rpy, vel = jnp.split(2 * x[:, 2:].reshape(-1, n, 9) - 1, 3, axis=-1)
        begin = 2 * jnp.pi * (x[:, :1] + np.arange(n, dtype=x.dtype) / n)
        # Everyone moves on by 1 to n - 1 places.
        places = 1 + jnp.floor((n - 1) * x[:, 1:2])
        end = begin + 2 * jnp.pi * places / n
        goal = on_circle(end, radius) if slots is None else jnp.asarray(slots, x.dtype)
        data = flying(data, on_circle(begin, radius) + JITTER * off, rotation.from_rpy(0.1 * rpy), 0.1 * vel)
        new = Swarm(jnp.broadcast_to(goal, data.states.pos.shape), separation(data.states.pos))
        return data.replace(plugins=data.plugins | {NAME: new})

    def away(data: SimData) -> Array:
        return rotation.safe_norm(record_of(data).goal - data.states.pos)[..., 0]

    def observe(data: SimData) -> dict[str, Array]:
        near, passing = (x.reshape(*x.shape[:2], -1) for x in others_near(data, n_seen))
        return state_of(data) | {
            "difference_to_goal": record_of(data).goal - data.states.pos,
            "drones_near": near,
            "drones_near_vel": passing,
        }

    def lost(data: SimData) -> Array:
        beyond = jnp.any(jnp.abs(data.states.pos) > limit.astype(data.states.pos.dtype), axis=-1)
        return on_floor(data) | beyond | (strict & (record_of(data).closest < 1))

    def reward(data: SimData, action: Array, last_action: Array) -> Array:
        """Up to 1.5 in the slot, less near others, for turning and for jerky actions; -10 where the episode ends."""
        d, apart = away(data), separation(data.states.pos)
        spin = jnp.sum(jnp.square(data.states.ang_vel), axis=-1)
        jerk = jnp.sum(jnp.square(action - last_action), axis=-1)
        near = jnp.exp(-2 * d) + 0.5 * jnp.exp(-20 * d)
        crowded = jnp.maximum(1.5 - apart, 0) + 2.0 * (apart < 1)
        return near - crowded - 0.002 * spin - 0.02 * jerk - 10.0 * lost(data)

    return Task(
        "swarm",
        spawn,
        observe,
        reward,
        terminated=lambda data: jnp.any(lost(data), axis=-1),
        error=away,
        info=lambda data: {"separation": record_of(data).closest},
        target=lambda data: record_of(data).goal,
        camera={"lookat": (0, 0, 1.0), "distance": 4.0 + 2 * radius, "elevation": -35},
        seconds=seconds,
        tolerance=tolerance,
        settings={
            "formation": None if slots is None else slots.tolist(),
            "n_seen": n_seen,
            "strict": strict,
            "seconds": seconds,
            "tolerance": tolerance,
        },
    )


def as_formation(formation: Sequence[Sequence[float]], n_drones: int) -> np.ndarray:
    """Return a formation as an array, checked. (n_drones, 3)

    Raises:
        ConfigError: If it has another shape, is too low, or two of its places are too near to each other.
    """
    try:
        slots = np.asarray(formation, float)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"the formation cannot be {formation!r}; needed is an array ({n_drones}, 3)") from error
    if slots.shape != (n_drones, 3) or not np.all(np.isfinite(slots)):
        raise ConfigError(f"the formation has shape {slots.shape}; needed are finite numbers ({n_drones}, 3), m")
    if slots[:, 2].min() < 0.2:
        raise ConfigError(f"the formation reaches down to {slots[:, 2].min()} m; needed are 0.2 m over the floor")
    apart = np.asarray(separation(jnp.asarray(slots)))
    if apart.min() < 1.2:
        pair = sorted(np.argsort(apart)[:2].tolist())
        raise ConfigError(
            f"places {pair} of the formation are too near to each other: {apart.min():.2f} of the least separation, "
            f"which is {SEPARATION[0]} m beside and {SEPARATION[2]} m above each other; needed is 1.2 of it"
        )
    return slots


def on_circle(angle: Array, radius: float) -> Array:
    """Return points of the circle that a swarm begins on, m. (..., 3)"""
    height = jnp.full_like(angle, HEIGHT)
    return jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle), height], axis=-1)


def separation(pos: Array) -> Array:
    """Return how far the nearest other drone is, in half axes of the ellipsoid: below 1 it is too near.

    Args:
        pos: Positions of a world's drones, m. (..., n_drones, 3)

    Returns:
        (..., n_drones)
    """
    apart = (pos[..., :, None, :] - pos[..., None, :, :]) / np.array(SEPARATION, pos.dtype)
    square = jnp.sum(apart * apart, axis=-1)
    other = ~np.eye(pos.shape[-2], dtype=bool)
    return rotation.safe_sqrt(jnp.min(jnp.where(other, square, jnp.inf), axis=-1))


def record_of(data: SimData) -> Swarm:
    """Return the task's record."""
    return data.plugins[NAME]
