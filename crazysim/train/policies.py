"""Policies of any kind as one: trained ones, plain functions, and several for the drones of an environment."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from crazysim.engine.pytree import PyTree, static
from crazysim.envs.env import Env
from crazysim.envs.state import Obs
from crazysim.envs.statistics import RunningStats
from crazysim.errors import expect, require
from crazysim.train.interface import Interface, describe_env, sizes_of
from crazysim.train.networks import Policies, Policy, Weights


class _FunctionPolicy(PyTree):
    """Policy that is a plain function, which JAX treats as static."""

    fn: Callable[[Obs], Array] = static()
    """Function from observations to actions."""

    def __call__(self, obs: Obs) -> Array:
        return self.fn(obs)


def load_start(folder: str, env: Env, obs: Obs) -> tuple[Policy, np.ndarray] | None:
    """Return the policy of a run from which a training with these observations starts; None without a run.

    Returns:
        The policy, and the indices of its observations among those of the training. (n_obs,)
    """
    from crazysim.train.training import load_policy

    if not folder:
        return None
    require(
        Path(folder).is_dir(),
        f"expected the run of start={folder}, got no such folder. Use the folder of a run, also to resume.",
    )
    (policy, *_), sizes = load_policy(folder), sizes_of(obs)
    known, interface = policy.interface.sizes, Interface.read(describe_env(env, sizes))
    shared = tuple([x for x in interface.observations if x[0] in known])
    changes = {"observations": shared, "freq": None, "task": None, "task_code": None}
    policy.interface.require(dataclasses.replace(interface, **changes), f"a training with start={folder}")
    is_known = np.concatenate([np.full(size, name in known) for name, size in interface.observations])
    return policy, np.flatnonzero(is_known)


def start_from(
    start: tuple[Policy, np.ndarray] | None, weights: Weights, stats: RunningStats, n_obs: int
) -> tuple[Weights, RunningStats]:
    """Return weights and statistics with which a training starts.

    Observations that are new have no effect at first. The normalisation of the others stays as it was.

    Args:
        start: From ``load_start``.
        weights: Untrained weights.
        n_obs: Number of observations of the policy that is trained.
        stats: Statistics at the start of the training; the policy's observations come first.
    """
    if start is None:
        return weights, stats
    (policy, index), ((weight, bias), *others) = start, start[0].layers
    if not jax.tree.leaves(policy.body):
        weight = jnp.zeros((n_obs, weight.shape[1]), weight.dtype).at[index].set(weight)
    started = Weights([(weight, bias), *others], policy.body)
    expected, got = ([x.shape for x in jax.tree.leaves(tree)] for tree in (started, weights))
    require(
        expected == got,
        f"expected a training with the network of start, whose arrays have shapes {expected}, got {got}. Give hidden, "
        f"memory, shape and convolution with --config; only a dense network without memory may have more observations.",
    )
    mean, var = stats.mean.at[index].set(policy.stats.mean), stats.var.at[index].set(policy.stats.var)
    return started, stats.replace(mean=mean, var=var, fixed=tuple(index.tolist()))


class MultiPolicy(PyTree):
    """Several policies in one environment, as one policy for rollouts, evaluations and films.

    ``MultiPolicy.of([league, solo])`` flies the first drone of each world by ``league`` and the others by ``solo``. A
    trained policy gets the observations of its training by name; the environment may have others besides. A function
    gets the observations of all drones. Each policy computes the actions of all drones, and each drone takes its own.
    """

    members: tuple[Any, ...]
    """The policies."""
    who: Array
    """Index of the policy of each drone; the last one also flies the drones that are left. (n,) or (n_worlds, n)"""

    @staticmethod
    def of(policies: Sequence[Callable[[Obs], Array]], who: ArrayLike | None = None) -> MultiPolicy:
        """Join trained policies, or functions from observations to actions.

        Args:
            who: Index of the policy of each drone, or of each drone in each world, so that opponents can differ between
                worlds; None for the policies in their order. Drones beyond the last one have the policy of the last
                one. (n,) or (n_worlds, n)
        """
        expect(len(policies) > 0 and all(map(callable, policies)), "a list of policies", policies, "Use [policy].")
        index = np.arange(len(policies)) if who is None else np.asarray(who)
        require(
            index.ndim in (1, 2) and index.dtype.kind in "iu" and {*index.flat} <= {*range(len(policies))},
            f"expected who as indices of {len(policies)} policies, (n_drones,) or (n_worlds, n_drones), got {who!r}. "
            f"Use for example {[0] * (len(policies) > 1) + [len(policies) - 1]}.",
        )
        return MultiPolicy(tuple(map(as_tree, policies)), jnp.asarray(index, jnp.int32))

    def of_drones(self, n_worlds: int, n_drones: int) -> Array:
        """Return the index of the policy of each drone. (n_worlds, n_drones)"""
        require(
            self.who.shape[-1] <= n_drones and self.who.shape[:-1] in ((), (n_worlds,)),
            f"expected policies for {n_drones} drones in {n_worlds} worlds, got who of shape {self.who.shape}. Use one "
            f"row for all worlds or for each, of at most {n_drones}.",
        )
        drones = np.minimum(np.arange(n_drones), self.who.shape[-1] - 1)
        return jnp.broadcast_to(self.who[..., drones], (n_worlds, n_drones))

    def __call__(self, obs: Obs) -> Array:
        return self.act(obs, ((),) * len(self.members))[0]

    def act(self, obs: Obs, memory: Any) -> tuple[Array, Any]:
        """Return the actions of all drones, (n_worlds, n_drones, k), and the memories after the step."""
        results = [act(x, known_obs(x, obs), m) for x, m in zip(self.members, memory, strict=True)]
        actions, memory = zip(*results, strict=True)
        who = self.of_drones(*actions[0].shape[:2])[..., None]
        return jnp.select([who == i for i in range(len(actions))], actions), memory

    def initial_memory(self, *batch: int) -> Any:
        """Return the memories of all policies at the start of an episode, for a batch (n_worlds, n_drones)."""
        return tuple([_memory_of(x, *batch) for x in self.members])


def as_tree(policy: Callable[[Obs], Array]) -> Any:
    """Return a policy as a pytree, which compiled functions can take as an argument."""
    return policy if isinstance(policy, PyTree) else _FunctionPolicy(policy)


def act(policy: Callable[[Obs], Array], obs: Obs, memory: Any) -> tuple[Array, Any]:
    """Return the actions of a policy with or without memory, and its memory after the step.

    Args:
        policy: Trained policy, or any function from observations to actions.
        obs: Observations by name. (n_worlds, n_drones, k) each
        memory: Memory before the step; at the start of an episode the result of ``initial_memory``.
    """
    return policy.act(obs, memory) if isinstance(policy, Policy | Policies | MultiPolicy) else (policy(obs), memory)


def initial_memory(policy: Callable[[Obs], Array], env: Env) -> Any:
    """Return the memory of a policy at the start of an episode; ``()`` for none. (n_worlds, n_drones, ...) each"""
    return _memory_of(policy, env.sim.n_worlds, env.sim.n_drones)


def _memory_of(policy: Any, *batch: int) -> Any:
    return policy.initial_memory(*batch) if isinstance(policy, Policy | Policies | MultiPolicy) else ()


def known_obs(policy: Any, obs: Obs) -> Obs:
    """Return the observations of a policy's training, by name, or all for a function."""
    interface = getattr(policy, "interface", None)
    if not isinstance(interface, Interface):
        return obs
    return {name: x for name, x in obs.items() if name in interface.sizes}
