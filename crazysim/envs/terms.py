"""Terms of rewards that several tasks use, unweighted. Each is computed for every drone of a world."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
from jax import Array

from crazysim.core.data import SimData


def proximity(distance: Array, coarse: float = 2.0, fine: float = 20.0) -> Array:
    """Return ``exp(-coarse d) + exp(-fine d) / 2``, with ``d`` the distance: 1.5 at the goal, zero far away. (...)

    Args:
        distance: Distance from the goal, m. (...)
        coarse: Decay of the term that guides drones from afar, 1/m.
        fine: Decay of the term that rewards precision near the goal, 1/m.
    """
    return jnp.exp(-coarse * distance) + 0.5 * jnp.exp(-fine * distance)


def spin(data: SimData) -> Array:
    """Return the square of the angular velocity, rad^2/s^2. (..., n_drones)"""
    return jnp.sum(jnp.square(data.states.ang_vel), axis=-1)


def action_rate(action: Array, last_action: Array) -> Array:
    """Return the square of the change of the action. (..., n_drones)"""
    return jnp.sum(jnp.square(action - last_action), axis=-1)


def only_where(active: Array, terms: Mapping[str, Array]) -> dict[str, Array]:
    """Return terms that are zero where a drone is no longer active. (..., n_drones) each"""
    return {name: jnp.where(active, x, 0) for name, x in terms.items()}
