"""The optimizer of all algorithms."""

from __future__ import annotations

from typing import Any

import optax


def build_optimizer(learning_rate: Any, max_grad_norm: Any, n_updates: int) -> optax.GradientTransformation:
    """Return Adam on gradients that are clipped by their global norm.

    Args:
        learning_rate: Initial learning rate, annealed linearly to zero. ()
        max_grad_norm: Largest norm of a gradient. ()
        n_updates: Number of updates of the whole training.
    """
    schedule = optax.linear_schedule(learning_rate, 0.0, n_updates)
    return optax.chain(optax.clip_by_global_norm(max_grad_norm), optax.adam(schedule))
