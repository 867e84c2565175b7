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

QUICK = {"xla_gpu_autotune_level": 0}
"""Compiler options: autotuning matrix products on a GPU takes longer than it saves for networks of this size."""

Layers = list[tuple[Array, Array]]
"""Weights (n_in, n_out) and biases (n_out,), first layer first."""


def init_mlp(key: Array, sizes: Sequence[int], last_scale: float) -> Layers:
    """Return layers with orthogonal weights and zero biases.

    Args:
        key: Random key.
        sizes: Number of inputs, sizes of the hidden layers, number of outputs.
        last_scale: Scale of the weights of the last layer; small for a policy, so that it starts near the zero action.
    """
    keys = jax.random.split(key, len(sizes) - 1)
    scales = [np.sqrt(2.0)] * (len(sizes) - 2) + [last_scale]
    pairs = zip(keys, itertools.pairwise(sizes), scales, strict=True)
    return [(jax.nn.initializers.orthogonal(scale)(k, pair), jnp.zeros(pair[1])) for k, pair, scale in pairs]


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
