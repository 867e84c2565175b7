"""Random keys that depend on seed, world, drone, episode, step and the name of the stage.

They do not depend on the number of worlds, on the distribution of worlds over devices, or on which other worlds are
reset at the same time.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable

import jax
from jax import Array

from crazysim.core.data import SimData, as_key


def seed_sim(data: SimData, seed: int | Array, device: jax.Device | None = None) -> SimData:
    """Return the data with another seed or key for all random numbers drawn from now on.

    Args:
        data: Data of the simulation.
        seed: Seed or key.
        device: Device of the key; None for the default device.
    """
    key = as_key(seed)
    return data.replace(core=data.core.replace(rng_key=key if device is None else jax.device_put(key, device)))


def world_key(data: SimData, name: str) -> Array:
    """Return the random key of one world, for stages declared for one drone or one world.

    Args:
        data: Data of one drone or world, which provides seed, world, episode and step.
        name: Name of the stage; different names give different numbers.

    Returns:
        Typed key. ()
    """
    core = data.core
    key = jax.random.fold_in(core.rng_key, zlib.crc32(name.encode()))
    return jax.random.fold_in(jax.random.fold_in(jax.random.fold_in(key, core.world_id), core.episode), core.steps)


def drone_key(data: SimData, name: str) -> Array:
    """Return the random key of one drone, for stages declared for one drone; see ``world_key``. ()"""
    return jax.random.fold_in(world_key(data, name), data.core.drone_id)


def member_key(data: SimData, population: str, name: str) -> Array:
    """Return the random key of one member of a population, for stages declared for one member; see ``world_key``. ()"""
    return jax.random.fold_in(world_key(data, f"{population} {name}"), data.plugins[population].member_id)


def world_keys(data: SimData, name: str) -> Array:
    """Return the random keys of all worlds, equal to ``world_key`` of each.

    Args:
        data: Data of the simulation, which provides seed, episodes and steps.
        name: Name of the stage; different names give different numbers.

    Returns:
        Typed keys. (n_worlds,)
    """
    return _over_worlds(data, lambda one: world_key(one, name))


def drone_keys(data: SimData, name: str) -> Array:
    """Return the random keys of all drones of all worlds, equal to ``drone_key`` of each.

    Args:
        data: Data of the simulation, which provides seed, episodes and steps.
        name: Name of the stage; different names give different numbers.

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
