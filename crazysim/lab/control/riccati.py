"""Solvers of algebraic Riccati equations by structure-preserving doubling.

They can be jitted and differentiated, and work in float32 and float64.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.errors import require

N_DOUBLINGS = 30
"""Number of doublings. k doublings cover 2^k time steps, so a closed loop with an eigenvalue of 1 - 1e-8 converges."""
N_REFINEMENTS = 2
"""Newton steps after the doubling; each doubles the number of correct digits."""


def solve_discrete(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """Solve the discrete Riccati equation for its stabilising solution P, or NaN where there is none. (n, n)

        P = A^T P A - A^T P B (R + B^T P B)^-1 B^T P A + Q

    The structure-preserving doubling algorithm (Chu, Fan, Lin and Wang 2004): with ``G = B R^-1 B^T``, ``H = Q``,
    ``W = (I + G H)^-1``, each step replaces A by ``A W A``, G by ``G + A W G A^T`` and H by ``H + A^T H W A``. H
    converges quadratically to P, and A to zero if and only if the closed loop is stable; otherwise P is NaN. The
    number of steps is fixed, so the function has forward- and reverse-mode derivatives. Newton's method (Hewer 1971)
    removes the rounding errors.

    Args:
        A: State matrix. (n, n)
        B: Input matrix. (n, m)
        Q: Weights of the states, symmetric and positive semidefinite. (n, n)
        R: Weights of the inputs, symmetric and positive definite. (m, m)
    """
    P = _solve_by_doubling(A, B @ jnp.linalg.solve(R, B.T), Q)
    for _ in range(N_REFINEMENTS):
        K = jnp.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        P = _solve_smith(A - B @ K, Q + K.T @ R @ K)
    return P


def solve_continuous(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """Solve the continuous Riccati equation for its stabilising solution P, or NaN where there is none. (n, n)

        A^T P + P A - P B R^-1 B^T P + Q = 0

    A Cayley transform gives a discrete equation with the same solution (Chu, Fan and Lin 2005), which is solved by
    doubling. Newton's method (Kleinman 1968) removes the rounding errors of the transform.

    Args:
        A: State matrix. (n, n)
        B: Input matrix. (n, m)
        Q: Weights of the states, symmetric and positive semidefinite. (n, n)
        R: Weights of the inputs, symmetric and positive definite. (m, m)
    """
    eye, G = jnp.eye(A.shape[0], dtype=A.dtype), B @ jnp.linalg.solve(R, B.T)
    shift = jnp.sqrt(jnp.sqrt(jnp.linalg.norm(G) * jnp.linalg.norm(Q))) + jnp.linalg.norm(A) / A.shape[0]
    shifted_A = A - shift * eye
    inverse = jnp.linalg.inv(shifted_A)
    W = jnp.linalg.inv(shifted_A.T + Q @ inverse @ G)
    V = jnp.linalg.inv(shifted_A + G @ inverse.T @ Q)
    P = _solve_by_doubling(eye + 2 * shift * V, 2 * shift * inverse @ G @ W, 2 * shift * W @ Q @ inverse)
    for _ in range(N_REFINEMENTS):
        closed_loop = A - G @ P
        P = solve_lyapunov(closed_loop, Q + P @ G @ P)
    return P


def _solve_by_doubling(A: Array, G: Array, H: Array) -> Array:
    eye = jnp.eye(A.shape[0], dtype=A.dtype)

    def double_step(carry: tuple[Array, Array, Array], _: Any) -> tuple[tuple[Array, Array, Array], None]:
        A, G, H = carry
        W = jnp.linalg.solve(eye + G @ H, jnp.concatenate([A, G], axis=1))
        WA, WG = W[:, : A.shape[1]], W[:, A.shape[1] :]
        G, H = G + A @ WG @ A.T, H + A.T @ H @ WA
        return (A @ WA, (G + G.T) / 2, (H + H.T) / 2), None

    (A, G, H), _ = jax.lax.scan(double_step, (A, G, H), length=N_DOUBLINGS)
    has_converged = jnp.all(jnp.isfinite(H)) & (jnp.max(jnp.abs(A)) < 1e-3)
    return jnp.where(has_converged, H, jnp.nan)


def solve_lyapunov(A: Array, Q: Array) -> Array:
    """Return X with ``A^T X + X A + Q = 0`` for a stable A, by Cayley transform and doubling. (n, n)"""
    eye = jnp.eye(A.shape[0], dtype=A.dtype)
    shift = jnp.linalg.norm(A) / jnp.sqrt(A.shape[0])
    inverse = jnp.linalg.inv(A - shift * eye)
    return _solve_smith((A + shift * eye) @ inverse, 2 * shift * inverse.T @ Q @ inverse)


def _solve_smith(A: Array, Q: Array) -> Array:
    def double_step(carry: tuple[Array, Array], _: Any) -> tuple[tuple[Array, Array], None]:
        X, power = carry
        return (X + power.T @ X @ power, power @ power), None

    (X, _), _ = jax.lax.scan(double_step, (Q, A), length=N_DOUBLINGS)
    return (X + X.T) / 2


def gain_discrete(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """Return the gain K of the law ``u = -K x`` that minimises the sum of ``x^T Q x + u^T R u``, or NaN. (m, n)"""
    P = solve_discrete(A, B, Q, R)
    return jnp.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)


def gain_continuous(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """Return the gain K of the law ``u = -K x`` that minimises the integral of ``x^T Q x + u^T R u``, or NaN. (m, n)"""
    return jnp.linalg.solve(R, B.T @ solve_continuous(A, B, Q, R))


def check_gain(K: Any) -> Any:
    """Return a gain after checking on the host that it is finite."""
    require(
        np.all(np.isfinite(K)),
        "expected a Riccati equation with a stabilising solution, got none: an unstable or marginal mode is not "
        "reached by the inputs, or has no weight. Give each position, angle and rate a positive weight in Q, each "
        "input a positive weight in R, and check that mass and inertia are positive.",
    )
    return K
