"""Change places, or form a formation, without coming too close or into each other's downwash."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.plugin import state
from crazysim.core.settings import setting
from crazysim.engine.pair_reductions import reduce_over_others
from crazysim.envs import terms
from crazysim.envs.random import draw
from crazysim.envs.spawn import flying
from crazysim.envs.task import Task
from crazysim.envs.tasks.goals import nearest_drones, on_floor, state_of
from crazysim.errors import ConfigError, require
from crazysim.sim.sim import Sim

SEPARATION = (0.24, 0.24, 0.6)
"""Half axes of the ellipsoid around a drone that the centre of another drone may not enter, m. They are twice the radii
that Preiss, Hoenig, Ayanian and Sukhatme (Downwash-aware trajectory planning for large quadrotor teams, 2017) give for
a Crazyflie: 0.12 m across the thrust and 0.3 m along it."""
CROWDING_SEPARATION = 2.5
"""Separation below which another drone costs reward, in half axes of the ellipsoid. With 1.5, drones that cross the
middle evade too late: a third of the episodes end in a crash."""
MIN_START_SPACING = 0.9
"""Smallest distance between neighbours on the circle of the starts, and smallest radius of the circle, m."""
HEIGHT = 1.2
"""Height of the circle, m."""
ARENA_MARGIN = 1.5
"""Distance of the arena's limits from the circle and the formation, m."""
START_JITTER = 0.1
"""Largest component of the offset of a start from its place on the circle, m."""


class Swarm(Task):
    """Change places on a circle, or form a formation, at a distance from each other.

    The drones start on a circle that is turned at random. Without a formation, the goal of each drone is the start of
    another drone, the same random number of places further along the circle. Two drones are too close if one of them is
    in the ellipsoid around the other, with half axes of 0.24 m horizontally and, because of the downwash, 0.6 m
    vertically. This is checked at every physics step. An episode ends when two drones are too close (if ``strict``), or
    when a drone touches the floor or leaves the arena, which extends 1.5 m beyond the circle and the formation.
    """

    name = "swarm"
    n_drones = 4

    formation: Sequence[Sequence[float]] | None = None
    """Goals of the drones, in their order, m; None to change places. (n_drones, 3)"""
    n_seen: int = setting(default=3, low=1)
    """Largest number of nearest other drones that a drone observes."""
    strict: bool = True
    """Whether to end an episode when two drones are too close. Being too close costs reward in any case."""
    seconds: float = 8.0
    """Length of an episode, s."""
    tolerance: float = 0.1
    """Distance below which a drone is at its goal, m."""
    goal: Array = state((3,))
    """Position that the drone should take, m."""
    closest: Array = state(())
    """Smallest separation from another drone so far; 1 at the edge of the ellipsoid."""

    def install(self, sim: Sim) -> None:
        require(
            sim.n_drones >= 2, f"expected at least two drones in a swarm, got {sim.n_drones}. Use n_drones=2 or more."
        )
        if self.formation is not None:
            as_formation(self.formation, sim.n_drones)

        self.add_states(sim, closest=np.inf)

    def after_substep(self, data: SimData) -> SimData:
        scaled_pos = data.states.pos / np.array(SEPARATION, data.states.pos.dtype)

        def square_separation(other_pos: Array, is_self: Array) -> Array:
            return jnp.where(is_self, jnp.inf, jnp.sum((scaled_pos - other_pos) ** 2))

        nearest = rotation.safe_sqrt(reduce_over_others(square_separation, scaled_pos, "min"))
        return self.write(data, closest=jnp.minimum(self.read(data).closest, nearest))

    def spawn(self, data: SimData, key: Array) -> SimData:
        n, dtype = data.core.n_drones, data.states.pos.dtype
        x = draw(key, turn=1, places=1, drones=(n, 9))
        offset, rpy, vel = jnp.split(2 * x["drones"] - 1, 3, axis=-1)
        start_angle = 2 * jnp.pi * (x["turn"] + np.arange(n, dtype=dtype) / n)
        # All drones move by the same number of places, from 1 to n - 1.
        places = 1 + jnp.floor((n - 1) * x["places"])
        goal_angle = start_angle + 2 * jnp.pi * places / n
        goal = (
            circle_points(goal_angle, n)
            if self.formation is None
            else jnp.asarray(np.asarray(self.formation, float), dtype)
        )
        data = flying(
            data, circle_points(start_angle, n) + START_JITTER * offset, rotation.from_rpy(0.1 * rpy), 0.1 * vel
        )
        return self.write(data, goal=goal, closest=separation(data.states.pos))

    def observe(self, data: SimData) -> dict[str, Array]:
        relative_pos, relative_vel = (x.reshape(x.shape[0], -1) for x in nearest_drones(data, self.n_seen))
        return state_of(data) | {
            "difference_to_goal": self.read(data).goal - data.states.pos,
            "drones_near": relative_pos,
            "drones_near_vel": relative_vel,
        }

    def rewards(self, data: SimData, action: Array, last_action: Array) -> dict[str, Array]:
        nearest_separation = separation(data.states.pos)
        return {
            "proximity": terms.proximity(self.error(data)),
            "crowding": -(jnp.maximum(CROWDING_SEPARATION - nearest_separation, 0) + 2.0 * (nearest_separation < 1)),
            "spin": -0.002 * terms.spin(data),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "lost": -10.0 * self.is_lost(data),
        }

    def is_lost(self, data: SimData) -> Array:
        """Whether a drone is on the floor, outside of the arena, or, if ``strict``, was too close to another.

        Returns:
            (n_drones,)
        """
        pos = data.states.pos
        is_outside = jnp.any(jnp.abs(pos) > self.limits(data.core.n_drones).astype(pos.dtype), axis=-1)
        return on_floor(data) | is_outside | (self.strict & (self.read(data).closest < 1))

    def limits(self, n_drones: int) -> np.ndarray:
        """Return the largest absolute coordinates within the arena, m. (3,)"""
        radius = circle_radius(n_drones)
        if self.formation is None:
            return np.array([radius, radius, HEIGHT]) + ARENA_MARGIN
        return np.maximum(radius, np.abs(np.asarray(self.formation, float)).max(axis=0)) + ARENA_MARGIN

    def terminated(self, data: SimData) -> Array:
        return jnp.any(self.is_lost(data))

    def error(self, data: SimData) -> Array:
        return rotation.safe_norm(self.read(data).goal - data.states.pos)[..., 0]

    def info(self, data: SimData) -> dict[str, Array]:
        return {"separation": self.read(data).closest}

    def camera(self, n_drones: int) -> Mapping[str, Any]:
        return {"lookat": (0, 0, 1.0), "distance": 4.0 + 2 * circle_radius(n_drones), "elevation": -35}

    def set_goal(self, data: SimData, pos: Array) -> SimData:
        return self.write(data, goal=pos)


def as_formation(formation: Sequence[Sequence[float]], n_drones: int) -> np.ndarray:
    """Return a validated formation as an array. (n_drones, 3)"""
    try:
        goals = np.asarray(formation, float)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"expected a formation of shape ({n_drones}, 3), got {formation!r}") from error
    require(
        goals.shape == (n_drones, 3) and np.all(np.isfinite(goals)),
        f"expected a formation of finite numbers ({n_drones}, 3), m, got shape {goals.shape}",
    )
    require(goals[:, 2].min() >= 0.2, f"expected a formation at least 0.2 m above the floor, got {goals[:, 2].min()} m")
    separations = np.asarray(separation(jnp.asarray(goals)))
    if separations.min() < 1.2:
        pair = sorted(np.argsort(separations)[:2].tolist())
        raise ConfigError(
            f"expected places of the formation at least 1.2 times the smallest separation apart, {SEPARATION[0]} m "
            f"horizontally and {SEPARATION[2]} m vertically, got {separations.min():.2f} between places {pair}"
        )
    return goals


def circle_radius(n_drones: int) -> float:
    """Return the radius of the circle of the starts, m."""
    return max(MIN_START_SPACING, MIN_START_SPACING / (2 * np.sin(np.pi / n_drones)))


def circle_points(angle: Array, n_drones: int) -> Array:
    """Return points of the circle of the starts, m. (..., 3)"""
    radius, height = circle_radius(n_drones), jnp.full_like(angle, HEIGHT)
    return jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle), height], axis=-1)


def separation(pos: Array) -> Array:
    """Return the distance to the nearest other drone in half axes of the ellipsoid; a value below 1 is too close.

    Args:
        pos: Positions of a world's drones, m. (..., n_drones, 3)

    Returns:
        (..., n_drones)
    """
    scaled_offset = (pos[..., :, None, :] - pos[..., None, :, :]) / np.array(SEPARATION, pos.dtype)
    square_distance = jnp.sum(scaled_offset * scaled_offset, axis=-1)
    is_other = ~np.eye(pos.shape[-2], dtype=bool)
    return rotation.safe_sqrt(jnp.min(jnp.where(is_other, square_distance, jnp.inf), axis=-1))
