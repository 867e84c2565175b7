"""Analytic policy gradients: the return of a short horizon is differentiated through the simulator."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

from crazysim.envs.env import Env
from crazysim.envs.rollout import Transition, rollout
from crazysim.envs.state import EnvState, Obs, flatten
from crazysim.envs.statistics import RunningStats
from crazysim.pytree import PyTree
from crazysim.train.hyperparameters import check_hyperparameters
from crazysim.train.networks import Layers, Policy, all_finite, init_mlp

STATS_ITERATIONS = 20
"""Iterations during which the observation statistics are updated."""


@dataclass(frozen=True)
class Config:
    """Hyperparameters of analytic policy gradients."""

    iterations: int = 400
    """Number of iterations, each a short rollout and one update."""
    n_steps: int = 40
    """Horizon: environment steps per iteration through which the gradient is propagated."""
    hidden: tuple[int, ...] = (64, 64)
    """Sizes of the hidden layers of the policy."""
    learning_rate: float = 3e-3
    """Initial learning rate of Adam, annealed linearly to zero."""
    discount: float = 0.99
    """Discount factor per environment step."""
    max_grad_norm: float = 1.0
    """Largest global norm of a gradient; larger ones are scaled down to it."""

    def __post_init__(self) -> None:
        """Check the values."""
        check_hyperparameters(self)


class Learner(PyTree):
    """Complete state of a training run; saving and loading it resumes the run bit for bit."""

    policy: Layers
    """Network from normalised observations to the action before tanh."""
    optimizer: optax.OptState
    """State of the optimiser."""
    stats: RunningStats
    """Mean and variance with which observations are normalised."""
    key: Array
    """Random key."""
    env: EnvState
    """State of the environments at the end of the last iteration."""
    iteration: Array
    """Number of completed iterations. ()"""

    def as_policy(self) -> Policy:
        """Return the policy with its observation statistics."""
        return Policy(self.stats, self.policy)


def init(env: Env, config: Config, key: Array) -> Learner:
    """Return an untrained learner; ``env`` has no automatic resets."""
    k_policy, k_env, key = jax.random.split(key, 3)
    state = env.reset(k_env)
    n_obs = flatten(state.obs).shape[-1]
    policy = init_mlp(k_policy, (n_obs, *config.hidden, env.actions.size), 0.01)
    stats = RunningStats.create(n_obs).update(flatten(state.obs))
    return Learner(policy, _optimizer(config).init(policy), stats, key, state, jnp.int32(0))


@partial(jax.jit, static_argnames=("env", "config"))
def iterate(learner: Learner, env: Env, config: Config) -> tuple[Learner, dict[str, Array]]:
    """Return the learner after one rollout and one update, and the metrics of the iteration.

    The metric ``finite`` is True if weights and loss are finite. The rollout starts where the previous one ended;
    worlds whose episode is over start a new one. A non-finite gradient is skipped. The scan stores its intermediates
    instead of recomputing them under ``jax.checkpoint``: tens of steps fit in memory.
    """
    start = env.restart(learner.env, learner.env.done)

    def loss(policy: Layers) -> tuple[Array, Any]:
        actor = Policy(learner.stats, policy)

        def act(obs: Obs, memory: Any, key: Array) -> tuple[Array, Any, Any]:
            del key
            return actor(obs), memory, ()

        def keep(transition: Transition) -> Any:
            return transition.reward.mean(), flatten(transition.obs), transition.terminated.mean()

        state, _, (rewards, raw, crashed) = rollout(env, start, act, learner.key, config.n_steps, keep)
        discounts = config.discount ** jnp.arange(config.n_steps, dtype=rewards.dtype)
        metrics = {"reward": rewards.mean(), "crashed": crashed.mean(), "error": jnp.nanmean(state.info["error"])}
        return -(discounts * rewards).mean(), (state, raw, metrics)

    (cost, (state, raw, metrics)), grads = jax.value_and_grad(loss, has_aux=True)(learner.policy)
    norm = jnp.sqrt(sum(jnp.sum(jnp.square(x)) for x in jax.tree.leaves(grads)))
    updates, optimizer = _optimizer(config).update(grads, learner.optimizer, learner.policy)
    new = (optax.apply_updates(learner.policy, updates), optimizer)
    policy, optimizer = jax.tree.map(
        lambda x, old: jnp.where(jnp.isfinite(norm), x, old), new, (learner.policy, learner.optimizer)
    )
    # Normalisation that keeps shifting would degrade a policy that is already good, so it is frozen early.
    updated = learner.stats.update(raw)
    stats = jax.tree.map(lambda x, old: jnp.where(learner.iteration < STATS_ITERATIONS, x, old), updated, learner.stats)
    learner = Learner(policy, optimizer, stats, learner.key, state, learner.iteration + 1)
    return learner, metrics | {"gradient": norm, "finite": all_finite((policy, optimizer, stats, cost))}


def _optimizer(config: Config) -> optax.GradientTransformation:
    schedule = optax.linear_schedule(config.learning_rate, 0.0, config.iterations)
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(schedule))
