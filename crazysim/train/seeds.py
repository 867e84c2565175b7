"""Several seeds in one program: ``jax.vmap`` around code of one seed, and one rollout of the worlds of all seeds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, PartitionSpec

from crazysim.engine.pytree import PyTree, float_dtype, static
from crazysim.engine.sharding import WORLD_AXIS
from crazysim.envs.env import Env
from crazysim.envs.rollout import Transition, rollout
from crazysim.envs.state import EnvState, Obs, terms_of
from crazysim.envs.task import sum_terms
from crazysim.train.hyperparameters import SWEEPABLE

T = TypeVar("T")


class SeedConfig(PyTree):
    """Hyperparameters of one seed, read like those of its ``Config``, or of all seeds."""

    values: dict[str, Any]
    """The ``SWEEPABLE`` ones, and factors of rewards, by name: () each, or (n_seeds,) each."""
    common: Any = static()
    """``Config`` with the others, which are the same for all seeds."""

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            fields = self.__dict__
            return fields["values"][name] if name in fields["values"] else getattr(fields["common"], name)


def stack_configs(configs: Sequence[T]) -> T:
    """Stack the hyperparameters of all seeds, as the ``SeedConfig`` that ``for_each_seed`` divides.

    The values are host arrays, so that those of a single seed are scalar constants of the compiled program.
    """
    names = [name for name in SWEEPABLE if hasattr(configs[0], name)]
    values: dict[str, Any] = {
        name: np.array([getattr(config, name) for config in configs], float_dtype()) for name in names
    }
    if factors := [dict(config.rewards) for config in configs if getattr(config, "rewards", ())]:
        values["rewards"] = {name: np.array([x[name] for x in factors], float_dtype()) for name in factors[0]}
    return cast(T, SeedConfig(values, configs[0]))


def split_blocks(tree: T, n_seeds: int) -> T:
    """Divide arrays of all worlds into blocks. (n_worlds, ...) -> (n_seeds, n_worlds / n_seeds, ...) each"""
    return jax.tree.map(lambda x: x.reshape(n_seeds, -1, *x.shape[1:]), tree)


def join_blocks(tree: T) -> T:
    """Join arrays of blocks of worlds. (n_seeds, n_worlds / n_seeds, ...) -> (n_worlds, ...) each"""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), tree)


def are_seeds_divided(n_seeds: int, mesh: Mesh) -> bool:
    """Whether each device of a mesh trains its own seeds."""
    return n_seeds % mesh.size == 0


def for_each_seed(fn: Callable[..., Any], *args: Any, axes: tuple[int, ...] | int = 0, mesh: Mesh | None = None) -> Any:
    """Apply a function of one seed to all seeds, and stack the results along their first axis.

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


def split_keys(keys: Array, n: int) -> Array:
    """Split the random key of every seed into ``n``. (n_seeds,) -> (n, n_seeds)"""
    return jnp.moveaxis(for_each_seed(partial(jax.random.split, num=n), keys), 1, 0)


def take_seed(tree: T, i: int) -> T:
    """Take the arrays of one seed. (n_seeds, ...) -> (...) each"""
    return jax.tree.map(lambda x: x[i], tree)


class Step(PyTree):
    """Results of an environment step in the worlds of one seed."""

    reward: Array
    """Rewards. (n_worlds, n_drones)"""
    terminated: Array
    """Whether the episode ended by success or failure. (n_worlds,)"""
    truncated: Array
    """Whether the episode reached its time limit. (n_worlds,)"""
    error: Array
    """Errors of the task. (n_worlds, n_drones)"""
    terms: dict[str, Array]
    """Terms of the reward by name, if the environment has ``RewardTerms``. (n_worlds, n_drones) each"""
    final_obs: Obs
    """Observations at the end of the step, before a new episode begins. (n_worlds, n_drones, k) each"""

    @property
    def done(self) -> Array:
        """Whether the episode is over. (n_worlds,)"""
        return self.terminated | self.truncated

    def scaled_reward(self, factors: Any) -> Array:
        """Sum the terms of the reward, multiplied by the factors that some have. (n_worlds, n_drones)"""
        scaled = {name: x * factors[name] if name in factors else x for name, x in self.terms.items()}
        return sum_terms(scaled) if factors else self.reward


def rollout_seeds(
    env: Env,
    state: EnvState,
    act: Callable[..., tuple[Array, Any, Any]],
    record: Callable[..., Any],
    seeds: tuple[Any, ...],
    keys: Array,
    n_steps: int,
    initial_memory: Any = (),
    memory: Any = None,
) -> tuple[EnvState, Any, Any]:
    """Fly the worlds of all seeds as one batch, with functions of one seed.

    ``jax.vmap`` of a whole rollout gives the same kernel calls, but moves the packed state of every seed in each step:
    a rollout of four seeds takes a fifth longer on a CPU.

    Args:
        env: Environment with a block of worlds for each seed.
        act: ``act(*seed, obs, memory, key) -> (action, memory, extras)``.
        record: ``record(*seed, step, extras)``: what to store of a ``Step``.
        seeds: First arguments of both, pytrees of all seeds. (n_seeds, ...) each
        keys: Random keys. (n_seeds,)
        initial_memory: Memory of the policies at the start of an episode. (n_worlds, ...) each
        memory: Memory before the first step; None for ``initial_memory``. (n_worlds, ...) each

    Returns:
        State and memory of all worlds after the last step, and the records. (n_steps, n_seeds, ...) each
    """
    split, each = partial(split_blocks, n_seeds=keys.shape[0]), partial(for_each_seed, mesh=env.sim.mesh)

    def policy(obs: Obs, memory: Any, keys: Array) -> tuple[Array, Any, Any]:
        action, memory, extras = each(act, *seeds, *split((obs, memory)), keys)
        return join_blocks(action), join_blocks(memory), extras

    def keep(x: Transition) -> Any:
        info = x.state.info
        step = Step(x.reward, x.terminated, x.truncated, info["error"], terms_of(info), x.final_obs)
        return each(record, *seeds, split(step), x.extras)

    return rollout(env, state, policy, keys, n_steps, keep, initial_memory, memory)
