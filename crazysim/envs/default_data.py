"""Resets to the default data, in which what is alike in all worlds and drones is stored once."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.population import populations
from crazysim.pytree import has_members, map_batched, scopes

_AXES = {"drone": (0, 1), "world": (0,)}
"""Axes of worlds and drones by scope; members of other populations are stored one by one."""


def compact(data: SimData) -> SimData:
    """Return the data with one world and drone in place of all where they are alike, as arrays of the host."""

    def one(scope: str, x: Array) -> Array | np.ndarray:
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            return x
        host = np.asarray(x)
        for axis in _AXES.get(scope, (0,) if has_members(scope) else ()):
            first = host.take([0], axis)
            if np.array_equal(host, np.broadcast_to(first, host.shape)):
                host = first
        return host

    return jax.tree.map(one, scopes(data), data)


def spread(data: SimData, n_worlds: int, n_drones: int) -> SimData:
    """Return compacted data with all worlds and drones."""
    shapes = {"drone": (n_worlds, n_drones), "world": (n_worlds, 1)}

    def all_of(scope: str, x: Array) -> Array:
        shape = shapes.get(scope, (n_worlds,) if has_members(scope) else ())
        return jnp.broadcast_to(x, (*shape, *x.shape[len(shape) :])) if shape else x

    return jax.tree.map(all_of, scopes(data), data)


def with_own(default: SimData, data: SimData) -> SimData:
    """Return the default data with the seed, numbers and flags of the data."""
    own = {name: getattr(data.core, name) for name in ("rng_key", "world_id", "drone_id", "n_worlds")}
    members = {
        name: default.plugins[name].replace(member_id=record.member_id)
        for name, record in populations(data).items()
        if name in default.plugins
    }
    return default.replace(core=default.core.replace(**own), plugins=default.plugins | members)


def reset_world(data: SimData, default: SimData) -> SimData:
    """Return the data of one world reset to its default; what worlds share stays. See ``core.stages.reset``."""
    plugins = {name: default.plugins.get(name, plugin) for name, plugin in data.plugins.items()}
    new = map_batched(lambda x, value: jnp.broadcast_to(value, x.shape), data, default.replace(plugins=plugins))
    return new.replace(core=new.core.replace(episode=data.core.episode + 1))
