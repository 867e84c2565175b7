"""A range finder: a few rays from every drone, measured in the step itself."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim import rotation
from crazysim.core.data import SimData
from crazysim.core.stage import Stage
from crazysim.effects.core import install
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree, leaf
from crazysim.scene.contact_log import SimulationWithScene
from crazysim.scene.rays import cast

RANGER = {
    "front": (1, 0, 0),
    "back": (-1, 0, 0),
    "left": (0, 1, 0),
    "right": (0, -1, 0),
    "up": (0, 0, 1),
    "down": (0, 0, -1),
}
"""Directions of a multi-ranger deck, body frame."""
NAME = "range_finder"


class Ranges(PyTree):
    """What range finders measure."""

    distance: Array = leaf("drone", 1)
    """Distance along each ray, m; ``max_range`` where nothing is nearer. (n_worlds, n_drones, n_rays)"""
    direction: Array = leaf("shared", 2)
    """Unit directions of the rays, body frame. (n_rays, 3)"""
    max_range: Array = leaf("shared", 0)
    """How far they reach, m. ()"""


def add_range_finder(
    sim: SimulationWithScene,
    directions: Any = None,
    max_range: float = 4.0,
    freq: int | None = None,
    drones: bool = False,
) -> None:
    """Give every drone rays that measure distances, each in the step itself: ``data.plugins["range_finder"]``.

    They start at the centre of mass and do not see their own drone; others they see as the shapes that drones touch by.

    Args:
        sim: The simulation.
        directions: Body frame, of any length; None for ``RANGER``: front, back, left, right, up, down. (n_rays, 3)
        max_range: How far they reach, m.
        freq: Measurements per second, Hz, a divisor of ``sim.freq``; None for every step.
        drones: Whether they see other drones, which makes it a stage of one world.

    Raises:
        ConfigError: If there is a range finder already, or a number cannot be.
    """
    way = np.asarray(list(RANGER.values()) if directions is None else directions, np.float64)
    if way.ndim != 2 or way.shape[1] != 3 or not np.isfinite(way).all() or not way.any(axis=-1).all():
        raise ConfigError(f"directions {way.tolist()}; needed are vectors (n_rays, 3), none of them zero")
    if not max_range > 0:
        raise ConfigError(f"max_range is {max_range}; it must be positive, in m")
    steps = sim.data.core.freq
    period = 1 if freq is None else steps // freq if type(freq) is int and freq > 0 and steps % freq == 0 else 0
    if not period:
        raise ConfigError(f"a range finder at {freq} Hz does not fit steps at {steps} Hz; take a divisor")
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    # The few rays of a range finder need no more of a drone than its outline.
    model = dataclasses.replace(sim.scene.visual_model, drone_geoms=sim.scene.collision_model.drone_geoms)

    def measure(data: SimData) -> SimData:
        mine, states = data.plugins[NAME], data.states
        pos, quat = (states.pos, states.quat) if drones else (states.pos[None], states.quat[None])
        direction = rotation.rotate(quat[:, None], mine.direction)
        n_rays = direction.shape[1]
        origin = jnp.broadcast_to(pos[:, None], direction.shape)
        own = np.repeat(np.arange(direction.shape[0]), n_rays) if drones else None
        hits = cast(model, data, origin.reshape(-1, 3), direction.reshape(-1, 3), own, drones)
        far = jnp.minimum(hits.distance, mine.max_range).reshape(direction.shape[:2])
        new = mine.replace(distance=far if drones else far[0])
        return data.replace(plugins=data.plugins | {NAME: new})

    shape = (sim.n_worlds, sim.n_drones, len(way))
    record = Ranges(jnp.full(shape, float(max_range)), jnp.asarray(way, float), jnp.asarray(float(max_range)))
    when = None if period == 1 else lambda data: data.core.steps % period == 0
    install(sim, NAME, record, Stage(measure, "world" if drones else "drone", when), before="increment_steps")
