"""Reference trajectories: position and velocity at any time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.errors import ConfigError

Trajectory = Callable[[Array], tuple[Array, Array]]
"""Time, s, (...) to position, m, and velocity, m/s, (..., 3) each."""


def figure_eight(period: float = 5.0, width: float = 2.0, depth: float = 1.0, height: float = 1.0) -> Trajectory:
    """Return a lying figure eight, ``(width/2 sin wt, depth/2 sin 2wt, height)``, a Lissajous curve.

    Args:
        period: Period, s.
        width: Size along x, m.
        depth: Size along y, m.
        height: Height, m.
    """
    w = 2 * np.pi / period

    def at(t: Array) -> tuple[Array, Array]:
        a, b = width / 2, depth / 2
        pos = jnp.stack([a * jnp.sin(w * t), b * jnp.sin(2 * w * t), jnp.full_like(t, height)], axis=-1)
        vel = jnp.stack([a * w * jnp.cos(w * t), 2 * b * w * jnp.cos(2 * w * t), jnp.zeros_like(t)], axis=-1)
        return pos, vel

    return at


def polynomial(coefficients: Any, durations: Any) -> Trajectory:
    """Return a piecewise polynomial, which is repeated after its end.

    Args:
        coefficients: Coefficients of each piece and axis, constant term first, of the time since its start, s.
            (n_pieces, 3, degree + 1)
        durations: Length of each piece, s. (n_pieces,)

    Raises:
        ConfigError: If the shapes do not fit, or a duration is not positive.
    """
    c, lengths = np.asarray(coefficients, float), np.asarray(durations, float)
    if c.ndim != 3 or c.shape[1] != 3 or lengths.shape != c.shape[:1] or not np.all(lengths > 0):
        raise ConfigError(
            f"expected coefficients (n_pieces, 3, degree + 1) and positive durations (n_pieces,), got shapes {c.shape} "
            f"and {lengths.shape}"
        )
    begins = np.concatenate([[0.0], np.cumsum(lengths)])
    rates = c[..., 1:] * np.arange(1, c.shape[-1])

    def at(t: Array) -> tuple[Array, Array]:
        t = jnp.mod(t, begins[-1])
        piece = jnp.sum(t[..., None] >= jnp.asarray(begins[1:-1], t.dtype), axis=-1)
        since = (t - jnp.asarray(begins, t.dtype)[piece])[..., None]
        return _horner(jnp.asarray(c, t.dtype)[piece], since), _horner(jnp.asarray(rates, t.dtype)[piece], since)

    return at


def _horner(coefficients: Array, t: Array) -> Array:
    value = jnp.zeros_like(coefficients[..., 0])
    for k in reversed(range(coefficients.shape[-1])):
        value = value * t + coefficients[..., k]
    return value
