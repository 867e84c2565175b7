"""Random numbers of episodes: as repeatable as those of ``crazysim.core.random``, at a twentieth of the arithmetic.

A million worlds that draw twenty numbers each, in every step, for the few of them that begin anew, must cost less than
the physics. JAX's generator is a cipher of twenty rounds; here two rounds of an integer hash with avalanche (Wellons
2018, "Prospecting for hash functions", with the later constants 21f0aaad, d35a2d97) mix seed, world and episode.
"""

from __future__ import annotations

import zlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData

STRIDE = np.uint32(0x9E3779B9)
"""2^32 over the golden ratio: multiples of it are spread evenly."""


def episode_keys(data: SimData, name: str) -> Array:
    """Return a random key for every world, another in each of its episodes.

    Args:
        data: The simulation; seed, worlds and episodes are taken from it.
        name: What draws; another name, other numbers.

    Returns:
        Typed keys, for ``uniform`` or ``jax.random``. (n_worlds,)
    """
    core = data.core
    seed = jax.random.key_data(core.rng_key).astype(jnp.uint32)
    world, episode = (x[:, 0].astype(jnp.uint32) for x in (core.world_id, core.episode))
    first = _mix(seed[0] ^ np.uint32(zlib.crc32(name.encode())))
    second = _mix(seed[1] + first)
    own = _mix(_mix(first + world * STRIDE) ^ (second + episode * STRIDE))
    return jax.random.wrap_key_data(jnp.stack([own, _mix(own ^ second)], axis=-1), impl="threefry2x32")


def uniform(keys: Array, *shape: int, low: Any = 0.0, high: Any = 1.0) -> Array:
    """Return random numbers for every world, evenly from a range, in steps of 2^-24 of it.

    Other than with ``jax.random`` the first numbers of a longer draw are those of a shorter one with the same keys.

    Args:
        keys: One random key per world. (n_worlds,)
        shape: Shape of one world's numbers.
        low: Lower ends; anything that broadcasts to the shape.
        high: Upper ends.

    Returns:
        (n_worlds, *shape)
    """
    words = jax.random.key_data(keys).astype(jnp.uint32).reshape(-1, 2, *(1 for _ in shape))
    count = np.arange(int(np.prod(shape)), dtype=np.uint32).reshape(shape)
    with np.errstate(over="ignore"):
        bits = _mix(_mix(words[:, 0] + count * STRIDE) ^ words[:, 1])
    x = (bits >> 8).astype(jnp.zeros(()).dtype) * 2.0**-24
    return low + x * (jnp.asarray(high, x.dtype) - jnp.asarray(low, x.dtype))


def _mix(x: Array) -> Array:
    """Return a number of 32 bits, each bit of which depends on each of those that came."""
    x = (x ^ (x >> 16)) * np.uint32(0x21F0AAAD)
    x = (x ^ (x >> 15)) * np.uint32(0xD35A2D97)
    return x ^ (x >> 15)
