"""Training of a residual through predictions of flights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.errors import optional_import, require
from crazysim.lab.identify.logs import Log
from crazysim.lab.identify.prediction import Model, Windows, attitude_error, cut_windows, predict
from crazysim.lab.plugins.residual import Residual, residual_inputs

ERROR_SCALES = {"pos": 0.02, "attitude": 0.05, "vel": 0.1, "ang_vel": 0.5}
"""Scales of errors: m, rad, m/s, rad/s. Larger errors count linearly (Huber)."""
WINDOW_DURATION = 0.5
"""Duration of the predictions, s."""
WINDOW_STRIDE = 0.05
"""Time between the starts of training windows, s."""
FORCE_SCALE, TORQUE_SCALE = 0.1, 0.03
"""Scales of force and torque, as fractions of the drone's weight, and of its weight times its arm. With these scales
the trained weights are of order one."""


def fit_residual(
    logs: Sequence[Log],
    model: Model,
    *,
    n_hidden: int = 32,
    iterations: int = 1000,
    batch_size: int = 128,
    learning_rate: float = 3e-3,
    decay: float = 1e-4,
    validation: Sequence[Log] = (),
    seed: int = 0,
) -> Model:
    """Train the residual of a model: linear terms and a network that are added to force and torque.

    Adam minimises Huber's loss of open-loop predictions of 0.5 s, by gradients through the dynamics. The parameters of
    the model are not changed. With validation logs, their loss is computed every 100 iterations, and the result is the
    residual with the least loss.

    Args:
        logs: Logs of the same sample time, whose delays were removed with ``aligned``.
        model: Model from ``identify``.
        n_hidden: Number of units of the hidden layer; 0 for linear terms alone.
        iterations: Number of steps of Adam.
        batch_size: Number of windows per step.
        learning_rate: Largest learning rate; it decreases to zero with half a cosine.
        decay: Weight decay.
        validation: Logs that select the result and are not used for training.
        seed: Seed of the initial weights and of the batches.

    Raises:
        ImportError: If optax is not installed.
    """
    with optional_import("networks need", "optax", "train"):
        import optax
    require(
        n_hidden >= 0 and min(iterations, batch_size) >= 1,
        f"expected n_hidden of at least 0, iterations and batch_size of at least 1, got {n_hidden}, {iterations} "
        f"and {batch_size}. Leave them out for the defaults.",
    )
    # Windows, and scales of inputs and outputs.
    windows, dt, params = cut_windows(logs, WINDOW_DURATION, WINDOW_STRIDE), logs[0].dt, model.params
    validation_windows = cut_windows(validation, WINDOW_DURATION, 4 * WINDOW_STRIDE) if validation else None
    inputs = jax.vmap(lambda q, v, w, r: residual_inputs(q, v, w, r, params))(
        windows.quat[:, 0], windows.vel[:, 0], windows.ang_vel[:, 0], windows.rotor_vel[:, 1]
    )
    input_std = jnp.std(inputs, axis=0).at[0].set(1.0)
    weight = float(params.mass[0]) * float(jnp.linalg.norm(params.gravity_vec))
    scale = weight * jnp.repeat(jnp.array([FORCE_SCALE, TORQUE_SCALE * float(params.L[0])]), 3)

    def make_residual(weights: dict[str, Array]) -> Residual:
        linear = model.residual.linear + scale[:, None] * weights["linear"] / input_std
        if not n_hidden:
            return Residual(linear, is_bound=True)
        return Residual(
            linear=linear,
            hidden=weights["hidden"] / input_std,
            output=scale[:, None] * weights["output"],
            is_bound=True,
        )

    def loss(weights: dict[str, Array], batch: Windows) -> Array:
        candidate = Model(params=params, residual=make_residual(weights))
        return jnp.mean(huber(jax.vmap(lambda w: scaled_errors(candidate, w, dt))(batch)))

    optimizer: Any = optax.chain(
        optax.clip_by_global_norm(1.0),
        optax.adamw(optax.cosine_decay_schedule(learning_rate, iterations), weight_decay=decay),
    )

    @jax.jit
    def update(weights: dict[str, Array], state: Any, key: Array) -> tuple[Any, Any]:
        rows = jax.random.choice(key, len(windows.pos), (batch_size,))
        grads = jax.grad(loss)(weights, jax.tree.map(lambda x: x[rows], windows))
        grads = jax.tree.map(lambda g: jnp.where(jnp.isfinite(g), g, 0.0), grads)
        updates, state = optimizer.update(grads, state, weights)
        return optax.apply_updates(weights, updates), state

    # Linear terms and outputs are zero at first.
    key = jax.random.key(seed)
    n_inputs = inputs.shape[-1]
    weights = {
        "linear": jnp.zeros((6, n_inputs)),
        "hidden": jax.random.normal(key, (n_hidden, n_inputs)) / np.sqrt(n_inputs),
        "output": jnp.zeros((6, n_hidden)),
    }
    state, validation_loss_fn = optimizer.init(weights), jax.jit(loss)
    # The weights that predict the validation logs best are kept.
    best_weights, least_loss = weights, np.inf
    for k in range(iterations):
        weights, state = update(weights, state, jax.random.fold_in(key, k))
        if validation_windows is not None and (k % 100 == 99 or k == iterations - 1):
            validation_loss = float(validation_loss_fn(weights, validation_windows))
            if validation_loss < least_loss:
                best_weights, least_loss = weights, validation_loss
    return Model(params=params, residual=make_residual(weights if validation_windows is None else best_weights))


def scaled_errors(model: Model, window: Windows, dt: float) -> Array:
    """Return the errors of the prediction of one window at ten times, divided by ``ERROR_SCALES``. (120,)"""
    pos, quat, vel, ang_vel = predict(model, window, dt)
    n = window.pos.shape[0]
    samples = np.unique(np.linspace(0, n - 1, 11).round().astype(int))[1:]
    parts = [
        (pos - window.pos)[samples] / ERROR_SCALES["pos"],
        attitude_error(quat[samples], window.quat[samples]) / ERROR_SCALES["attitude"],
        (vel - window.vel)[samples] / ERROR_SCALES["vel"],
        (ang_vel - window.ang_vel)[samples] / ERROR_SCALES["ang_vel"],
    ]
    return jnp.concatenate([x.ravel() for x in parts])


def huber(x: Array) -> Array:
    """Return Huber's loss of scaled errors: quadratic below one, linear above."""
    size = jnp.abs(x)
    return jnp.where(size < 1, 0.5 * size * size, size - 0.5)
