"""Running mean and variance of observations."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.engine.pytree import PyTree, leaf, static

CLIP, EPSILON = 10.0, 1e-6
"""Largest magnitude of a normalised observation, and the number that is added to a variance before its square root."""


class RunningStats(PyTree):
    """Mean and variance of all observations so far (Chan, Golub, LeVeque 1979)."""

    mean: Array = leaf("shared", 1)
    """Mean. (k,)"""
    var: Array = leaf("shared", 1)
    """Variance. (k,)"""
    count: Array = leaf("shared", 0)
    """Number of observations. ()"""
    unscaled: tuple[range, ...] = static(default=())
    """Ranges of indices into k that are not normalised, such as the pixels of images."""
    fixed: tuple[int, ...] = static(default=())
    """Indices into k whose mean and variance stay as they are."""

    @staticmethod
    def create(size: int, unscaled: tuple[range, ...] = ()) -> RunningStats:
        """Return the statistics before any observation: mean zero, variance one."""
        return RunningStats(jnp.zeros(size), jnp.ones(size), jnp.full((), 1e-4, jnp.result_type(float)), unscaled)

    def is_scaled(self) -> np.ndarray:
        """Return a mask that is True for observations that are normalised. (k,)"""
        mask = np.ones(self.mean.shape[-1], bool)
        for indices in self.unscaled:
            mask[indices.start : indices.stop] = False
        return mask

    def update(self, x: Array) -> RunningStats:
        """Return the statistics updated with a batch of observations. (..., k)"""
        axes = tuple(range(x.ndim - 1))  # not flattened, so that worlds on several devices stay on their devices
        n, mean, var = x.size // x.shape[-1], x.mean(axis=axes), x.var(axis=axes)
        total_count = self.count + n
        delta = mean - self.mean
        sum_of_squares = self.var * self.count + var * n + delta * delta * self.count * n / total_count
        mean, var = self.mean + delta * n / total_count, sum_of_squares / total_count
        if self.unscaled or self.fixed:
            changes = self.is_scaled() & ~np.isin(np.arange(len(mean)), self.fixed)
            mean, var = (jnp.where(changes, x, y) for x, y in ((mean, self.mean), (var, self.var)))
        return self.replace(mean=mean, var=var, count=total_count)

    def normalize(self, x: Array) -> Array:
        """Return observations normalised and clipped to [-10, 10], except for ``unscaled`` indices. (..., k)"""
        scaled = jnp.clip((x - self.mean) / jnp.sqrt(self.var + EPSILON), -CLIP, CLIP)
        return jnp.where(self.is_scaled(), scaled, x) if self.unscaled else scaled
