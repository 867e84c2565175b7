"""Value functions: their inputs, which may be more than the policy observes, and the scale of their outputs."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim.envs.state import PRIVILEGED, Obs, flatten
from crazysim.envs.statistics import EPSILON, RunningStats
from crazysim.errors import require
from crazysim.train.networks import Weights

PRIVILEGED_CRITICS = ("privileged", "all_drones_privileged")
"""Critics that receive the observation of ``PrivilegedObservation``."""


def policy_obs(obs: Obs, critic: str) -> Obs:
    """Take the observations of the policy: all but those of a privileged critic."""
    return {name: x for name, x in obs.items() if name != PRIVILEGED or critic not in PRIVILEGED_CRITICS}


def critic_obs(obs: Obs, critic: str) -> Array:
    """Join the observations of the policy and, after them, those that only the critic may use. (..., k)"""
    if critic not in PRIVILEGED_CRITICS:
        return flatten(obs)
    require(
        PRIVILEGED in obs,
        f"expected the observation {PRIVILEGED!r} for critic={critic!r}, got {', '.join(obs)}. Use "
        f"AutoReset(PrivilegedObservation(env)).",
    )
    return jnp.concatenate([flatten(policy_obs(obs, critic)), obs[PRIVILEGED]], axis=-1)


def critic_input(obs: Array, critic: str) -> Array:
    """Join, for each drone, its observations and, for a critic of all drones, those of the others.

    Args:
        obs: Result of ``critic_obs``, normalised or not. (..., n_drones, k)
        critic: Setting ``critic`` of PPO.
    """
    if not critic.startswith("all_drones"):
        return obs
    return jnp.concatenate([jnp.roll(obs, -i, axis=-2) for i in range(obs.shape[-2])], axis=-1)


def return_std(returns: RunningStats) -> Array:
    """Standard deviation of returns. (1,)"""
    return jnp.sqrt(returns.var + EPSILON)


def rescale_value(weights: Weights, old_stats: RunningStats, new_stats: RunningStats) -> Weights:
    """Rescale the last layer of the value network, so that values are the same with new statistics of returns."""
    *hidden, (weight, bias) = weights.layers
    ratio = return_std(old_stats) / return_std(new_stats)
    bias = bias * ratio + (old_stats.mean - new_stats.mean) / return_std(new_stats)
    return weights.replace(layers=[*hidden, (weight * ratio, bias)])
