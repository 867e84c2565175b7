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
from crazysim.core.stages import reset
from crazysim.engine.pytree import has_members, leaf_indices, map_batched, n_batch_axes, n_world_axes, scopes
from crazysim.engine.sharding import fetch_arrays
from crazysim.engine.stage import Axes, Stage, world_function
from crazysim.scene.object_poses import moving_plugins
from crazysim.sim.sim import Sim


class EpisodeReset:
    """Resets of data at the start of an episode, with the default data and reset pipeline of a simulation.

    Later changes of the simulation have no effect.
    """

    def __init__(self, sim: Sim):
        self._default = default = deduplicate(sim.default_data)
        first_stage, *other_stages = sim.reset_pipeline.items()
        batched_stages = [name for name, fn in other_stages if not isinstance(fn, Stage)]
        batched_stages += [] if first_stage[1] is reset else [first_stage[0]]
        self.has_foreign_record = "batch" in jax.tree.leaves(scopes(sim.default_data))
        """Whether a record in ``data.plugins`` is a class of another library. Such records are not split by world."""
        self.takes_all_worlds = bool(batched_stages) or self.has_foreign_record
        """Whether ``reset_data`` takes all worlds at once."""
        self.batched_reason: str | None = None
        """Reason why resets are computed for all worlds and then used where an episode begins; None if only worlds in
        which an episode begins are reset."""
        leaf_rows = zip(*map(jax.tree.leaves, (scopes(default), default, leaf_indices(default))), strict=True)
        world_id = leaf_indices(default).core.world_id
        if batched_stages:
            self.batched_reason = (
                f"{', '.join(map(repr, batched_stages))} of the reset pipeline takes all worlds at once"
            )
        elif any(n_batch_axes(scope) == 2 and x.shape[0] > 1 and i != world_id for scope, x, i in leaf_rows):
            self.batched_reason = "episodes begin from different data in different worlds"
        movable = () if sim.data.objects is None else sim.data.objects.names
        keeps_objects = len(moving_plugins(sim.plugins.values(), movable)) == len(movable)
        stages = [fn for _, fn in other_stages]
        self.reset_data = _make_batched_reset(sim) if self.takes_all_worlds else _make_reset(stages, keeps_objects)
        """``reset_data(data, default)``: data of one world after a reset, or of all worlds if ``takes_all_worlds``."""

    def make_default(self, data: SimData) -> SimData:
        """Return the default data of all worlds, with the seed and the ids of ``data``."""
        n_worlds, n_drones = data.states.pos.shape[:2]
        return copy_seed_and_ids(self.broadcast_default(n_worlds, n_drones), data)

    def make_world_default(self, data: SimData) -> SimData:
        """Return the default data of one world, with the seed and the ids of ``data``.

        The default data must be equal in all worlds.
        """

        def first_world(scope: str, x: Array) -> Array:
            return x[(0,) * n_world_axes(scope)] if n_batch_axes(scope) == 2 else x

        return copy_seed_and_ids(jax.tree.map(first_world, scopes(self._default), self._default), data)

    def broadcast_default(self, n_worlds: int, n_drones: int) -> SimData:
        shapes = {"drone": (n_worlds, n_drones), "world": (n_worlds, 1)}

        def repeat(scope: str, x: Array) -> Array:
            shape = shapes.get(scope, (n_worlds,) if has_members(scope) else ())
            return jnp.broadcast_to(x, (*shape, *x.shape[len(shape) :])) if shape else x

        return jax.tree.map(repeat, scopes(self._default), self._default)


def _make_batched_reset(sim: Sim) -> Callable[[SimData, SimData], SimData]:
    reset_all, mask = sim.build_reset_fn().plain, np.ones(sim.n_worlds, bool)
    return lambda data, default: reset_all(data, default, mask)


def _make_reset(stages: Sequence[Any], keeps_objects: bool) -> Callable[[SimData, SimData], SimData]:
    def reset_and_apply_stages(data: SimData, default: SimData) -> SimData:
        data = reset_world(data, default.replace(objects=data.objects) if keeps_objects else default)
        axes = Axes(data)  # a wrapper may have given each drone its own parameters
        for stage in stages:
            data = world_function(stage, axes)(data)
        return data

    return reset_and_apply_stages


_BATCH_AXES = {"drone": (0, 1), "world": (0,)}
"""Axes of worlds and drones by scope, which ``deduplicate`` may shorten. It never shortens the axis of members."""


def deduplicate(data: SimData) -> SimData:
    """Return the data as host arrays; an axis of worlds or drones has length 1 where all its entries are equal."""

    def deduplicate_leaf(scope: str, x: Array) -> Array | np.ndarray:
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            return x
        host = fetch_arrays(x)
        for axis in _BATCH_AXES.get(scope, (0,) if has_members(scope) else ()):
            first_entry = host.take([0], axis)
            if np.array_equal(host, np.broadcast_to(first_entry, host.shape), equal_nan=host.dtype.kind == "f"):
                host = first_entry
        return host

    return jax.tree.map(deduplicate_leaf, scopes(data), data)


def copy_seed_and_ids(default: SimData, data: SimData) -> SimData:
    """Return the default data with the seed of ``data`` and its ids of worlds, drones and members."""
    core_fields = {name: getattr(data.core, name) for name in ("rng_key", "world_id", "drone_id", "n_worlds")}
    members = {
        name: default.plugins[name].replace(member_id=record.member_id)
        for name, record in populations(data).items()
        if name in default.plugins
    }
    return default.replace(core=default.core.replace(**core_fields), plugins=default.plugins | members)


def reset_world(data: SimData, default: SimData) -> SimData:
    """Return the data of one world reset to its default; shared leaves are unchanged. See ``core.stages.reset``."""
    plugins = {name: default.plugins.get(name, plugin) for name, plugin in data.plugins.items()}
    new_data = map_batched(lambda x, value: jnp.broadcast_to(value, x.shape), data, default.replace(plugins=plugins))
    return new_data.replace(core=new_data.core.replace(episode=data.core.episode + 1))
