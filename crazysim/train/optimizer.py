"""Gradient steps on the samples of a rollout: optimiser, minibatches and epochs of all algorithms."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

from crazysim.errors import require

MAX_GROUPS = 64
"""Largest number of groups of neighbouring worlds. A minibatch takes the same number of worlds from every group. A
device holds whole groups, so it needs no samples of other devices, and minibatches do not depend on the number of
devices."""


def build_optimizer(learning_rate: Any, max_grad_norm: Any, n_updates: int) -> optax.GradientTransformation:
    """Build Adam on gradients that are clipped by their global norm.

    Args:
        learning_rate: Initial learning rate, annealed linearly to zero. ()
        max_grad_norm: Largest norm of a gradient. ()
        n_updates: Number of updates of the whole training.
    """
    schedule = optax.linear_schedule(learning_rate, 0.0, n_updates)
    return optax.chain(optax.clip_by_global_norm(max_grad_norm), optax.adam(schedule))


def check_minibatches(minibatches: int, n_worlds: int) -> None:
    require(
        n_worlds % minibatches == 0,
        f"expected a number of worlds that {minibatches} minibatches divide, got {n_worlds}. Use for example "
        f"{-(-n_worlds // minibatches) * minibatches} worlds, or minibatches={math.gcd(n_worlds, 8)}.",
    )


def run_epochs(
    loss: Callable[[Any, Any], tuple[Array, Any]],
    parameters: Any,
    optimizer: optax.OptState,
    samples: Any,
    config: Any,
    key: Array,
) -> tuple[Any, optax.OptState, Any]:
    """Minimise a loss by some passes over the samples, each in minibatches of worlds that are drawn anew.

    Args:
        loss: ``loss(parameters, samples) -> (loss, metrics)`` of a minibatch. (n_steps, n_groups, k, ...) each
        optimizer: State of ``build_optimizer``.
        samples: Samples of the rollout. (n_steps, n_worlds, ...) each
        config: Hyperparameters ``epochs``, ``minibatches`` and those of the optimiser.

    Returns:
        Parameters and state of the optimiser after the last update, and the means of the metrics.
    """
    transform = build_optimizer(config.learning_rate, config.max_grad_norm, config.n_updates)
    n_worlds = jax.tree.leaves(samples)[0].shape[1]
    n_groups = math.gcd(n_worlds // config.minibatches, MAX_GROUPS)
    take_from_groups = jax.vmap(lambda x, worlds: x[:, worlds], (1, 0), 1)

    def update(carry: Any, worlds: Array) -> tuple[Any, Any]:
        parameters, optimizer = carry
        grouped = jax.tree.map(lambda x: x.reshape(x.shape[0], n_groups, -1, *x.shape[2:]), samples)
        minibatch = jax.tree.map(lambda x: take_from_groups(x, worlds), grouped)
        grads, metrics = jax.grad(loss, has_aux=True)(parameters, minibatch)
        updates, optimizer = transform.update(grads, optimizer, parameters)
        return (optax.apply_updates(parameters, updates), optimizer), metrics

    def run_epoch(carry: Any, key: Array) -> tuple[Any, Any]:
        draw_order = jax.vmap(lambda key: jax.random.permutation(key, n_worlds // n_groups))
        worlds = draw_order(jax.random.split(key, n_groups)).reshape(n_groups, config.minibatches, -1)
        return jax.lax.scan(update, carry, jnp.moveaxis(worlds, 1, 0))

    carry, metrics = jax.lax.scan(run_epoch, (parameters, optimizer), jax.random.split(key, config.epochs))
    return *carry, jax.tree.map(jnp.mean, metrics)


def all_finite(tree: Any) -> Array:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(tree)]))
