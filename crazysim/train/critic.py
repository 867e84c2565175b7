"""Value functions: their inputs, which may be more than the policy observes, their targets, and their scale."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.envs.state import PRIVILEGED, EnvState, Obs, flatten, terms_of
from crazysim.envs.statistics import EPSILON, RunningStats
from crazysim.errors import expect, require
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


def check_factors(config: Any, state: EnvState) -> None:
    """Check that the reward of an environment has the terms of which ``rewards`` of a ``Config`` has factors."""
    terms, names = terms_of(state.info), dict(config.rewards)
    expect(names.keys() <= terms.keys(), f"rewards of terms among {', '.join(terms)}", list(names))


def estimate_advantages(sequence: tuple[Array, Array, Array], last_value: Array, config: Any) -> tuple[Array, Array]:
    """Estimate advantages and value targets, backwards in time. (n_steps, n_worlds, n_drones)

    Args:
        sequence: Rewards, estimates of the values before the steps, and whether episodes end with the steps.
        last_value: Estimate of the value after the last step.
        config: ``Config`` with discount and ``gae_lambda``.
    """

    def accumulate(carry: tuple[Array, Array], sample: tuple[Array, Array, Array]) -> tuple[Any, Array]:
        advantage, next_value = carry
        reward, value, done = sample
        discount = config.discount * ~done
        advantage = reward + discount * next_value - value + discount * config.gae_lambda * advantage
        return (advantage, value), advantage

    _, advantages = jax.lax.scan(accumulate, (jnp.zeros_like(last_value), last_value), sequence, reverse=True)
    return advantages, advantages + sequence[1]


def return_std(returns: RunningStats) -> Array:
    """Standard deviation of returns. (1,)"""
    return jnp.sqrt(returns.var + EPSILON)


def rescale_value(weights: Weights, old_stats: RunningStats, new_stats: RunningStats) -> Weights:
    """Rescale the last layer of the value network, so that values are the same with new statistics of returns."""
    *hidden, (weight, bias) = weights.layers
    ratio = return_std(old_stats) / return_std(new_stats)
    bias = bias * ratio + (old_stats.mean - new_stats.mean) / return_std(new_stats)
    return weights.replace(layers=[*hidden, (weight * ratio, bias)])
