"""Functions from time to position and velocity. Deprecated: use the records of ``crazysim.trajectories``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from crazysim import trajectories
from crazysim.deprecation import warn_renamed

Trajectory = Callable[[Array], tuple[Array, Array]]
"""Time, s, (...) to position, m, and velocity, m/s, (..., 3) each."""


def figure_eight(period: float = 5.0, width: float = 2.0, depth: float = 1.0, height: float = 1.0) -> Trajectory:
    """Return a lying figure eight as a function. Deprecated: use ``crazysim.trajectories.figure_eight``."""
    warn_renamed("crazysim.envs.trajectories.figure_eight", "crazysim.trajectories.figure_eight")
    return _function(trajectories.figure_eight(width, depth, period, height=height))


def polynomial(coefficients: Any, durations: Any) -> Trajectory:
    """Return a piecewise polynomial that repeats. Deprecated: use ``crazysim.trajectories.Trajectory.of_pieces``.

    Args:
        coefficients: Coefficients of each piece and axis, constant term first, of the time since its start, s.
            (n_pieces, 3, degree + 1)
        durations: Length of each piece, s. (n_pieces,)

    Raises:
        ConfigError: If the shapes do not fit, or a duration is not positive.
    """
    warn_renamed("crazysim.envs.trajectories.polynomial", "crazysim.trajectories.Trajectory.of_pieces")
    return _function(trajectories.Trajectory.of_pieces(durations, coefficients, repeats=True))


def _function(trajectory: trajectories.Trajectory) -> Trajectory:
    def at(t: Array) -> tuple[Array, Array]:
        evaluate: Any = trajectory.evaluate
        for _ in range(jnp.ndim(t)):
            evaluate = jax.vmap(evaluate)
        setpoint = evaluate(t)
        return setpoint.pos, setpoint.vel

    return at
