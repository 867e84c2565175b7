"""Trainings of several seeds in one program: blocks of worlds, one for each seed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from crazysim.core.sharding import WORLD_AXIS
from crazysim.pytree import float_dtype
from crazysim.train.hyperparameters import SWEEPABLE

T = TypeVar("T")
SweptValues = dict[str, Any]
"""Values of the ``SWEEPABLE`` hyperparameters by name: of one seed, (), or of all seeds, (n_seeds,)."""


def stack_swept_values(configs: Sequence[Any]) -> SweptValues:
    """Return the hyperparameters that may differ between seeds. (n_seeds,) each

    They are host arrays, so that the values of a single seed are scalar constants of the compiled program.
    """
    names = [name for name in SWEEPABLE if hasattr(configs[0], name)]
    return {name: np.array([getattr(config, name) for config in configs], float_dtype()) for name in names}


def split_blocks(tree: T, n_seeds: int) -> T:
    """Return arrays of all worlds divided into blocks. (n_worlds, ...) -> (n_seeds, n_worlds / n_seeds, ...) each"""
    return jax.tree.map(lambda x: x.reshape(n_seeds, -1, *x.shape[1:]), tree)


def join_blocks(tree: T) -> T:
    """Return arrays of blocks of worlds joined. (n_seeds, n_worlds / n_seeds, ...) -> (n_worlds, ...) each"""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), tree)


def are_seeds_divided(n_seeds: int, mesh: Mesh) -> bool:
    """Return True if each device of a mesh trains its own seeds."""
    return n_seeds % mesh.size == 0


def for_each_seed(fn: Callable[..., Any], *args: Any, axes: tuple[int, ...] | int = 0, mesh: Mesh | None = None) -> Any:
    """Return the results of a function of one seed for all seeds, stacked along their first axis.

    A single seed is computed without ``jax.vmap``, so that it is the same program as the function itself.

    Args:
        fn: Function that takes the arguments of one seed.
        args: Arguments of all seeds: pytrees whose arrays are stacked along an axis of seeds.
        axes: Index of this axis: one for all arguments, or one for each.
        mesh: Devices, each of which computes its own seeds. XLA distributes the computation if it is None, or if the
            number of seeds is not a multiple of the number of devices.
    """
    axes = (axes,) * len(args) if isinstance(axes, int) else axes
    n_seeds = jax.tree.leaves(args[0])[0].shape[axes[0]]
    if mesh is not None and are_seeds_divided(n_seeds, mesh):
        specs = tuple(PartitionSpec(*[None] * axis, WORLD_AXIS) for axis in axes)
        device_fn = partial(for_each_seed, fn, axes=axes)
        out_specs = PartitionSpec(WORLD_AXIS)
        return jax.shard_map(device_fn, mesh=mesh, in_specs=specs, out_specs=out_specs, check_vma=False)(*args)
    if n_seeds > 1:
        return jax.vmap(fn, in_axes=axes)(*args)
    squeezed_args = [
        jax.tree.map(lambda x, axis=axis: x.squeeze(axis), arg) for arg, axis in zip(args, axes, strict=True)
    ]
    return jax.tree.map(lambda x: jnp.expand_dims(x, 0), fn(*squeezed_args))


def take_seed(tree: T, i: int) -> T:
    """Return the arrays of one seed. (n_seeds, ...) -> (...) each"""
    return jax.tree.map(lambda x: x[i], tree)
