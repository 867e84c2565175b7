"""Small networks as plain arrays: a list of layers, each a weight matrix and a bias."""

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
"""Options of compilation: on a GPU, trying out ways to multiply takes longer than networks of this size ever save."""

Layers = list[tuple[Array, Array]]
"""Weights (n_in, n_out) and biases (n_out,), first layer first."""


def init_mlp(key: Array, sizes: Sequence[int], last_scale: float) -> Layers:
    """Return layers with orthogonal weights and zero biases.

    Args:
        key: Random key.
        sizes: Numbers of inputs, of neurons in each hidden layer, of outputs.
        last_scale: Scale of the last layer's weights; small for a policy, so that it begins near its zero action.
    """
    keys = jax.random.split(key, len(sizes) - 1)
    scales = [np.sqrt(2.0)] * (len(sizes) - 2) + [last_scale]
    pairs = zip(keys, itertools.pairwise(sizes), scales, strict=True)
    return [(jax.nn.initializers.orthogonal(scale)(k, pair), jnp.zeros(pair[1])) for k, pair, scale in pairs]


def mlp(layers: Layers, x: Array) -> Array:
    """Return the outputs, tanh between layers, computed in the type of the weights. (..., n_in) -> (..., n_out)"""
    dtype = x.dtype
    x = x.astype(layers[0][0].dtype)
    for weight, bias in layers[:-1]:
        x = jnp.tanh(x @ weight + bias)
    weight, bias = layers[-1]
    return (x @ weight + bias).astype(dtype)


class Policy(PyTree):
    """A policy as it is flown, evaluated and exported: statistics of its inputs, and layers."""

    stats: RunningStats
    """What its inputs are normalised with."""
    layers: Any
    """``Layers`` from observations to actions."""

    def __call__(self, obs: dict[str, Array]) -> Array:
        """Return the action for observations, without noise. (..., n_obs) -> (..., n_actions)"""
        return jnp.tanh(mlp(self.layers, self.stats.normalize(flatten(obs))))
