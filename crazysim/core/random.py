"""Random numbers that depend on the seed, the world, the drone, the episode, the step and the stage's name.

They are independent of the number of worlds, of the devices that worlds are spread over, and of other worlds' resets.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable

import jax
from jax import Array

from crazysim.core.data import SimData, as_key


def seed_sim(data: SimData, seed: int | Array) -> SimData:
    """Return the data with another seed, or key, for all later random numbers."""
    return data.replace(core=data.core.replace(rng_key=as_key(seed)))


def world_key(data: SimData, name: str) -> Array:
    """Return a random key for one world, in a stage declared for one drone or one world.

    Args:
        data: The data of one drone or world; seed, world, episode and step are taken from it.
        name: Name of the stage that draws; different names give independent numbers.

    Returns:
        Typed key. ()
    """
    core = data.core
    key = jax.random.fold_in(core.rng_key, zlib.crc32(name.encode()))
    return jax.random.fold_in(jax.random.fold_in(jax.random.fold_in(key, core.world_id), core.episode), core.steps)


def drone_key(data: SimData, name: str) -> Array:
    """Return a random key for one drone, in a stage declared for one drone; see ``world_key``. ()"""
    return jax.random.fold_in(world_key(data, name), data.core.drone_id)


def world_keys(data: SimData, name: str) -> Array:
    """Return a random key for every world; the same as that of ``world_key`` for each of them.

    Args:
        data: The simulation; seed, episodes and steps are taken from it.
        name: Name of the stage that draws; different names give independent numbers.

    Returns:
        Typed keys. (n_worlds,)
    """
    return _over_worlds(data, lambda one: world_key(one, name))


def drone_keys(data: SimData, name: str) -> Array:
    """Return a random key for every drone of every world; the same as that of ``drone_key`` for each of them.

    Args:
        data: The simulation; seed, episodes and steps are taken from it.
        name: Name of the stage that draws; different names give independent numbers.

    Returns:
        Typed keys; draw with ``jax.vmap(jax.vmap(draw))(keys)``. (n_worlds, n_drones)
    """

    def of_world(one: SimData) -> Array:
        return jax.vmap(lambda drone: jax.random.fold_in(world_key(one, name), drone))(one.core.drone_id)

    return _over_worlds(data, of_world)


def _over_worlds(data: SimData, fn: Callable[[SimData], Array]) -> Array:
    core = data.core

    def of_world(world_id: Array, drone_id: Array, episode: Array, steps: Array) -> Array:
        one = core.replace(world_id=world_id, drone_id=drone_id, episode=episode, steps=steps)
        return fn(data.replace(core=one))

    return jax.vmap(of_world)(core.world_id[:, 0], core.drone_id, core.episode[:, 0], core.steps[:, 0])
