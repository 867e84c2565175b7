"""Random keys that depend on seed, world, drone, episode, step and the name of the stage.

They do not depend on the number of worlds, on the distribution of worlds over devices, or on which other worlds are
reset at the same time.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData, as_key
from crazysim.engine.jaxcompat import bits_generator, threefry2x32_p, threefry_prng_impl

GOLDEN_STRIDE = np.uint32(0x9E3779B9)
"""2^32 divided by the golden ratio: its multiples modulo 2^32 are evenly distributed."""


def seed_sim(data: SimData, seed: int | Array, device: jax.Device | None = None) -> SimData:
    """Return the data with another seed or key for all random numbers drawn from now on.

    Args:
        device: Device of the key; None for the default device.
    """
    key = as_key(seed)
    return data.replace(core=data.core.replace(rng_key=key if device is None else jax.device_put(key, device)))


def seed_key(data: SimData) -> Array:
    """Return the random key of the seed from data of one drone or one world. ()"""
    key = data.core.rng_key
    return key[0] if key.ndim else key


def world_key(data: SimData, name: str) -> Array:
    """Return the typed random key of one world, for stages declared for one drone or one world. ()

    Args:
        data: Data of one drone or world, which provides seed, world, episode and step.
        name: Name of the stage; different names give different numbers.
    """
    return _key(data, name)


def drone_key(data: SimData, name: str) -> Array:
    """Return the random key of one drone, for stages declared for one drone; see ``world_key``. ()"""
    return _key(data, name, data.core.drone_id)


def member_key(data: SimData, population: str, name: str) -> Array:
    """Return the random key of one member of a population, for stages declared for one member; see ``world_key``. ()"""
    return _key(data, f"{population} {name}", data.plugins[population].member_id)


def world_keys(data: SimData, name: str) -> Array:
    """Return the typed random keys of all worlds, equal to ``world_key`` of each. (n_worlds,)

    Args:
        data: Data of the simulation, which provides seed, episodes and steps.
        name: Name of the stage; different names give different numbers.
    """
    return _vmap_worlds(data, lambda world: world_key(world, name))


def episode_keys(data: SimData, name: str) -> Array:
    """Return typed random keys of all worlds that stay the same for a whole episode; see ``world_keys``. (n_worlds,)"""
    return world_keys(data.replace(core=data.core.replace(steps=jnp.zeros_like(data.core.steps))), name)


def drone_keys(data: SimData, name: str) -> Array:
    """Return the random keys of all drones of all worlds, equal to ``drone_key`` of each.

    Args:
        data: Data of the simulation, which provides seed, episodes and steps.
        name: Name of the stage; different names give different numbers.

    Returns:
        Typed keys; draw with ``jax.vmap(jax.vmap(draw))(keys)``. (n_worlds, n_drones)
    """

    def keys_of_world(world: SimData) -> Array:
        return jax.vmap(lambda drone: _key(world, name, drone))(world.core.drone_id)

    return _vmap_worlds(data, keys_of_world)


def normal(key: Array, shape: Sequence[int], dtype: Any = jnp.float32) -> Array:
    """Return standard normal numbers, (*shape), at half the cost of ``jax.random.normal``, which draws other numbers.

    In float32, every hash of the key gives two numbers.
    """
    fractions = _fractions(key, shape, dtype)
    if fractions is None:
        return jax.random.normal(key, shape, dtype)
    # All odd multiples of 2^-23 between -1 and 1, of 2^-52 in float64.
    return math.sqrt(2) * jax.lax.erf_inv(2 * fractions + (float(jnp.finfo(dtype).eps) - 1))


def uniform(key: Array, shape: Sequence[int], dtype: Any = jnp.float32) -> Array:
    """Return numbers from zero to below one, (*shape), at half the cost of ``jax.random.uniform``; see ``normal``."""
    fractions = _fractions(key, shape, dtype)
    return jax.random.uniform(key, shape, dtype) if fractions is None else fractions


def uniform_at(words: Array, index: Array | np.ndarray, dtype: Any = jnp.float32) -> Array:
    """Return the random numbers at some indices of a stream, multiples of 2^-24 from zero to below one. (...)

    Any number of the stream depends on the key and its index only, for functions that read few numbers of a long
    stream. Each number takes two rounds of an integer hash with good avalanche (Wellons 2018, "Prospecting for hash
    functions", with the later constants 21f0aaad, d35a2d97): a twentieth of the arithmetic of JAX's generator.

    Args:
        words: Two words of a key, uint32. (..., 2)
        index: Indices, integers; they broadcast with the leading axes of ``words``. (...)
    """
    with np.errstate(over="ignore"):
        bits = mix_bits(mix_bits(words[..., 0] + index.astype(np.uint32) * GOLDEN_STRIDE) ^ words[..., 1])
    return (bits >> 8).astype(dtype) * 2.0**-24


def mix_bits(x: Array) -> Array:
    """Return a hashed 32-bit number: every bit depends on every bit of the input; see ``uniform_at``."""
    x = (x ^ (x >> 16)) * np.uint32(0x21F0AAAD)
    x = (x ^ (x >> 15)) * np.uint32(0xD35A2D97)
    return x ^ (x >> 15)


def _fractions(key: Array, shape: Sequence[int], dtype: Any) -> Array | None:
    # None for keys and types for which JAX's own functions are used. In float64, JAX's functions need 64-bit integers,
    # which kernels do not have.
    if dtype not in (jnp.float32, jnp.float64) or bits_generator(key.dtype) != threefry_prng_impl.name:
        return None
    if dtype == jnp.float64:
        upper, lower = jnp.moveaxis(_words(key, (*shape, 2)), -1, 0)
        return upper.astype(dtype) * 2.0**-32 + (lower >> 12).astype(dtype) * 2.0**-52
    # The upper bits of the words are the fractions of floats from one to below two; subtract one.
    return jax.lax.bitcast_convert_type((_words(key, shape) >> 9) | np.uint32(0x3F800000), jnp.float32) - 1


def _words(key: Array, shape: Sequence[int]) -> Array:
    n = math.prod(shape)
    word_0, word_1 = jax.random.key_data(key)
    counters = np.arange(-(-n // 2), dtype=np.uint32)
    zeros = np.zeros_like(counters)
    pairs = threefry2x32_p.bind(word_0 + zeros, word_1 + zeros, zeros, counters)
    return jnp.stack(pairs, axis=-1).reshape(-1)[:n].reshape(shape)


def _key(data: SimData, name: str, *members: Array) -> Array:
    # The step is hashed late, and the name last, so that all names share the earlier hashes.
    core, key = data.core, seed_key(data)
    for number in (core.world_id, core.episode, *members, core.steps, zlib.crc32(name.encode())):
        key = jax.random.fold_in(key, number)
    return key


def _vmap_worlds(data: SimData, fn: Callable[[SimData], Array]) -> Array:
    core = data.core

    def apply_to_world(key: Array, world_id: Array, drone_id: Array, episode: Array, steps: Array) -> Array:
        world_core = core.replace(rng_key=key, world_id=world_id, drone_id=drone_id, episode=episode, steps=steps)
        return fn(data.replace(core=world_core))

    axes = (0 if core.rng_key.ndim else None, 0, 0, 0, 0)
    counters = core.world_id[:, 0], core.drone_id, core.episode[:, 0], core.steps[:, 0]
    return jax.vmap(apply_to_world, in_axes=axes)(core.rng_key, *counters)
