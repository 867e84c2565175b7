"""Statistics of what has been observed, to normalise with."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim.pytree import PyTree

CLIP, EPSILON = 10.0, 1e-6
"""Largest normalised observation, and what is added to a variance before the root is taken."""


class RunningStats(PyTree):
    """Mean and variance of what has been seen (Chan, Golub, LeVeque 1979)."""

    mean: Array
    """(k,)"""
    var: Array
    """(k,)"""
    count: Array
    """How many were seen. ()"""

    @staticmethod
    def create(size: int) -> RunningStats:
        """Return the statistics of nothing: mean zero, variance one."""
        return RunningStats(jnp.zeros(size), jnp.ones(size), jnp.full((), 1e-4, jnp.result_type(float)))

    def update(self, x: Array) -> RunningStats:
        """Return the statistics with a batch more. (..., k)"""
        x = x.reshape(-1, x.shape[-1])
        n, mean, var = x.shape[0], x.mean(axis=0), x.var(axis=0)
        total = self.count + n
        delta = mean - self.mean
        spread = self.var * self.count + var * n + delta * delta * self.count * n / total
        return RunningStats(self.mean + delta * n / total, spread / total, total)

    def normalize(self, x: Array) -> Array:
        """Return numbers of mean zero and variance one, at most ten. (..., k)"""
        return jnp.clip((x - self.mean) / jnp.sqrt(self.var + EPSILON), -CLIP, CLIP)
