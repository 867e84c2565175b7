"""Multilayer perceptrons as plain arrays: a list of layers, each a weight matrix and a bias."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.envs.state import flatten
from crazysim.envs.statistics import RunningStats
from crazysim.pytree import PyTree
from crazysim.train.seeds import for_each_seed, join_blocks, split_blocks

Layers = list[tuple[Array, Array]]
"""Weights (n_in, n_out) and biases (n_out,), first layer first."""


def init_mlp(key: Array, sizes: Sequence[int], last_scale: float) -> Layers:
    """Return layers with uniformly distributed weights and zero biases.

    The weights have the variance of the entries of scaled orthogonal matrices, scale^2 / max(n_in, n_out). Orthogonal
    matrices themselves would take longer to trace and compile than this one draw of all weights.

    Args:
        key: Random key.
        sizes: Number of inputs, sizes of the hidden layers, number of outputs.
        last_scale: Scale of the weights of the last layer; small for a policy, so that it starts near the zero action.
            The scale of the other layers is the square root of 2.
    """
    pairs = list(itertools.pairwise(sizes))
    ends = np.cumsum([n_in * n_out for n_in, n_out in pairs])
    parts = jnp.split(jax.random.uniform(key, (ends[-1],), minval=-1.0, maxval=1.0), ends[:-1])
    scales = [np.sqrt(2.0)] * (len(pairs) - 1) + [last_scale]
    return [
        (scale * np.sqrt(3.0 / max(n_in, n_out)) * x.reshape(n_in, n_out), jnp.zeros(n_out))
        for x, (n_in, n_out), scale in zip(parts, pairs, scales, strict=True)
    ]


def mlp(layers: Layers, x: Array) -> Array:
    """Return the outputs, with tanh between layers, computed in the dtype of the weights.

    Args:
        layers: Weights and biases.
        x: Inputs. (..., n_in)

    Returns:
        Outputs, in the dtype of the inputs. (..., n_out)
    """
    dtype = x.dtype
    x = x.astype(layers[0][0].dtype)
    for weight, bias in layers[:-1]:
        x = jnp.tanh(x @ weight + bias)
    weight, bias = layers[-1]
    return (x @ weight + bias).astype(dtype)


def all_finite(tree: Any) -> Array:
    """Return True if every number of a pytree is finite. ()"""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(tree)]))


class Policy(PyTree):
    """Deterministic policy: observation statistics and a network."""

    stats: RunningStats
    """Mean and variance with which observations are normalised."""
    layers: Any
    """``Layers`` from normalised observations to actions before tanh."""

    def __call__(self, obs: dict[str, Array]) -> Array:
        """Return the action, between -1 and 1, for observations. (..., n_obs) -> (..., n_actions)"""
        return jnp.tanh(mlp(self.layers, self.stats.normalize(flatten(obs))))


class Policies(PyTree):
    """Policies of several seeds, each of which controls a block of worlds of equal size."""

    policies: Policy
    """The policies, stacked. (n_seeds, ...) each"""

    def __call__(self, obs: dict[str, Array]) -> Array:
        """Return the action, between -1 and 1, for observations. (n_worlds, n_drones, n_obs) -> (..., n_actions)"""
        blocks = split_blocks(obs, self.policies.stats.mean.shape[0])
        return join_blocks(for_each_seed(lambda policy, obs: policy(obs), self.policies, blocks))
