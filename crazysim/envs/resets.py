"""Resets of data at the start of an episode. Default values that are equal in all worlds are stored once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.population import populations
from crazysim.core.stage import Axes, Stage, world_function
from crazysim.core.stages import reset
from crazysim.pytree import has_members, leaf_indices, map_batched, n_batch_axes, n_world_axes, scopes
from crazysim.sim.sim import Sim


class Resets:
    """Resets of data at the start of an episode, by the default data and the pipeline that a simulation has now."""

    def __init__(self, sim: Sim):
        """Take the default data and the reset pipeline of a simulation."""
        self._default = default = compact(sim.default_data)
        first, *others = sim.reset_pipeline.items()
        names = [name for name, fn in others if not isinstance(fn, Stage)]
        names += [] if first[1] is reset else [first[0]]
        self.foreign = "batched" in jax.tree.leaves(scopes(sim.default_data))
        """True if a record in ``data.plugins`` is of another library, which is not divided among worlds."""
        self.batched_pipeline = bool(names) or self.foreign
        """True if ``data`` takes all worlds at once."""
        self.batched: str | None = None
        """Reason why new episodes are computed in all worlds and then selected; None where each world begins alone."""
        rows = zip(*map(jax.tree.leaves, (scopes(default), default, leaf_indices(default))), strict=True)
        world_id = leaf_indices(default).core.world_id
        if names:
            self.batched = f"{', '.join(map(repr, names))} of the reset pipeline takes all worlds at once"
        elif any(n_batch_axes(kind) == 2 and x.shape[0] > 1 and i != world_id for kind, x, i in rows):
            self.batched = "episodes begin from different data in different worlds"
        self.data = _reset_all(sim) if self.batched_pipeline else _reset_world([fn for _, fn in others])
        """``data(data, default)``: data of one world after a reset, or of all worlds if ``batched_pipeline``."""

    def default_of(self, data: SimData) -> SimData:
        """Return the data of all worlds that an episode begins from; seed and numbers are those of the data given."""
        n_worlds, n_drones = data.states.pos.shape[:2]
        return with_own(self.default_data(n_worlds, n_drones), data)

    def default_of_world(self, data: SimData) -> SimData:
        """Return the data of one world that an episode begins from, where worlds do not differ in that."""

        def one(scope: str, x: Array) -> Array:
            return x[(0,) * n_world_axes(scope)] if n_batch_axes(scope) == 2 else x

        return with_own(jax.tree.map(one, scopes(self._default), self._default), data)

    def default_data(self, n_worlds: int, n_drones: int) -> SimData:
        """Return the default data with all worlds and drones."""
        shapes = {"drone": (n_worlds, n_drones), "world": (n_worlds, 1)}

        def repeat(scope: str, x: Array) -> Array:
            shape = shapes.get(scope, (n_worlds,) if has_members(scope) else ())
            return jnp.broadcast_to(x, (*shape, *x.shape[len(shape) :])) if shape else x

        return jax.tree.map(repeat, scopes(self._default), self._default)


def _reset_all(sim: Sim) -> Callable[[SimData, SimData], SimData]:
    reset_all, worlds = sim.build_reset_fn().plain, np.ones(sim.n_worlds, bool)
    return lambda data, default: reset_all(data, default, worlds)


def _reset_world(stages: Sequence[Any]) -> Callable[[SimData, SimData], SimData]:
    """Return a function that resets one world and applies stages of the reset pipeline to it."""

    def reset_one(data: SimData, default: SimData) -> SimData:
        data = reset_world(data, default)
        axes = Axes(data)  # a wrapper may have made parameters one per drone
        for stage in stages:
            data = world_function(stage, axes)(data)
        return data

    return reset_one


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
            if np.array_equal(host, np.broadcast_to(first, host.shape), equal_nan=host.dtype.kind == "f"):
                host = first
        return host

    return jax.tree.map(one, scopes(data), data)


def with_own(default: SimData, data: SimData) -> SimData:
    """Return the default data with the seed, numbers of worlds, drones and members of the data."""
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
