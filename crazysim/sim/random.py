"""Random numbers that depend on the seed, the world, the drone, the episode, the step and the stage's name.

They do not depend on how many worlds there are, on how worlds are spread over devices, or on which other worlds are
reset along.
"""

from __future__ import annotations

import zlib

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.sim.data import SimData


def world_keys(data: SimData, name: str) -> Array:
    """Return a random key for every world.

    Args:
        data: The simulation; seed, episodes and steps are taken from it.
        name: The stage that draws; another name, other numbers.

    Returns:
        Typed keys. (n_worlds,)
    """
    root = jax.random.fold_in(data.core.rng_key, zlib.crc32(name.encode()))

    def of_world(world: Array, episode: Array, step: Array) -> Array:
        return jax.random.fold_in(jax.random.fold_in(jax.random.fold_in(root, world), episode), step)

    return jax.vmap(of_world)(jnp.arange(data.core.n_worlds), data.core.episode[:, 0], data.core.steps[:, 0])


def drone_keys(data: SimData, name: str) -> Array:
    """Return a random key for every drone of every world.

    Args:
        data: The simulation; seed, episodes and steps are taken from it.
        name: The stage that draws; another name, other numbers.

    Returns:
        Typed keys; draw with ``jax.vmap(jax.vmap(draw))(keys)``. (n_worlds, n_drones)
    """
    drones = jnp.arange(data.core.n_drones)
    return jax.vmap(lambda key: jax.vmap(lambda drone: jax.random.fold_in(key, drone))(drones))(world_keys(data, name))
