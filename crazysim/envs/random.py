"""Random numbers of episodes: as reproducible as ``crazysim.core.random``, with a twentieth of the arithmetic.

In every step all worlds draw the numbers of a new episode, although few worlds begin an episode. For a million worlds
with twenty numbers each, this must take less time than the physics. JAX's generator is a cipher of twenty rounds; here
two rounds of an integer hash, ``core.random.mix_bits``, mix seed, world and episode.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.random import GOLDEN_STRIDE, mix_bits, seed_key, uniform_at
from crazysim.errors import ConfigError, expect, short_repr


def as_seed(seed: object) -> int | None:
    """Return the seed of all worlds as an integer after checking it; None for None."""
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or not 0 <= seed < 2**63:
        raise ConfigError(
            f"expected one integer from 0 to 2^63 - 1 as seed of all worlds, each of which draws its own numbers, got "
            f"{short_repr(seed)}. Use for example 0."
        )
    return int(seed)


def read_options(options: object, *names: str) -> dict[str, Any]:
    """Return the options of a reset, which may have only these names."""
    given = {} if options is None else options
    if not isinstance(given, Mapping) or not given.keys() <= {*names}:
        allowed = (
            f"options of reset as a dict with {' and '.join(map(repr, names))}" if names else "no options of reset"
        )
        raise ConfigError(f"expected {allowed}, got {short_repr(options)}. Leave options out.")
    return dict(given)


def check_key(key: object) -> None:
    expect(
        isinstance(key, Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.size,
        "a random key",
        key,
        "Use jax.random.key(0), or jax.random.wrap_key_data(key) for a key of jax.random.PRNGKey.",
    )


def episode_key(data: SimData, name: str) -> Array:
    """Return the random key of a world's episode.

    Args:
        data: The data of one world, which gives the seed, the world and the episode.
        name: Name of the stream; streams of different names are independent.

    Returns:
        Typed key, for ``draw``, ``uniform`` or ``jax.random``. ()
    """
    core = data.core
    seed = jax.random.key_data(seed_key(data)).astype(jnp.uint32)
    world, episode = core.world_id.astype(jnp.uint32), core.episode.astype(jnp.uint32)
    hash_1 = mix_bits(seed[0] ^ np.uint32(zlib.crc32(name.encode())))
    hash_2 = mix_bits(seed[1] + hash_1)
    mixed = mix_bits(mix_bits(hash_1 + world * GOLDEN_STRIDE) ^ (hash_2 + episode * GOLDEN_STRIDE))
    return jax.random.wrap_key_data(jnp.stack([mixed, mix_bits(mixed ^ hash_2)], axis=-1), impl="threefry2x32")


def uniform(key: Array, *shape: int, low: Any = 0.0, high: Any = 1.0) -> Array:
    """Draw uniformly distributed random numbers, in steps of 2^-24 of their range.

    Unlike with ``jax.random``, a longer draw with the same key begins with the numbers of a shorter draw.

    Args:
        low: Lower limits; anything that broadcasts to the shape.
        high: Upper limits, not included.
    """
    words = jax.random.key_data(key).astype(jnp.uint32)
    indices = np.arange(int(np.prod(shape)), dtype=np.uint32).reshape(shape)
    return scale_to(uniform_at(words, indices, jnp.zeros(()).dtype), low, high)


def draw(key: Array, *batch: int, **sizes: int | tuple[int, ...]) -> dict[str, Array]:
    """Draw random numbers in [0, 1) by name, in one draw that is split in the order of the names. (*batch, size) each

    ``draw(key, n_drones, start=3, yaw=1)`` gives ``start`` (n_drones, 3) and ``yaw`` (n_drones, 1). Without
    leading axes, a name appended at the end does not change the numbers of the earlier names; with leading axes it
    does.

    Args:
        batch: Leading axes, usually the number of drones; none for numbers per world.
        sizes: Size of the last axis by name, or the shape of several last axes.
    """
    shapes = {name: (size,) if isinstance(size, int) else tuple(size) for name, size in sizes.items()}
    lengths = [int(np.prod(shape)) for shape in shapes.values()]
    parts = jnp.split(uniform(key, *batch, sum(lengths)), np.cumsum(lengths)[:-1], axis=-1)
    return {name: x.reshape(*batch, *shape) for (name, shape), x in zip(shapes.items(), parts, strict=True)}


def scale_to(x: Array, low: Any, high: Any) -> Array:
    """Return numbers in [0, 1) scaled to a range. (...)"""
    return low + x * (jnp.asarray(high, x.dtype) - jnp.asarray(low, x.dtype))


def scale_symmetric(x: Array, limit: Any) -> Array:
    """Return numbers in [0, 1) scaled to the range from ``-limit`` to ``limit``. (...)"""
    return scale_to(x, -jnp.asarray(limit, x.dtype), limit)
