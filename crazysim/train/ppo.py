"""Proximal policy optimisation (Schulman et al. 2017) with generalised advantage estimation (Schulman et al. 2016)."""

from __future__ import annotations

import math
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
from crazysim.envs.statistics import EPSILON, RunningStats
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree
from crazysim.train.hyperparameters import check_hyperparameters
from crazysim.train.networks import Layers, Policy, all_finite, init_mlp, mlp


@dataclass(frozen=True)
class Config:
    """Hyperparameters of PPO."""

    iterations: int = 200
    """Number of iterations, each a rollout and the updates on its samples."""
    n_steps: int = 32
    """Environment steps per world in one rollout."""
    epochs: int = 4
    """Passes over the samples of a rollout."""
    minibatches: int = 8
    """Minibatches, and hence updates, per epoch; each contains all samples of a subset of the worlds."""
    hidden: tuple[int, ...] = (64, 64)
    """Sizes of the hidden layers of policy and value function."""
    learning_rate: float = 1e-3
    """Initial learning rate of Adam, annealed linearly to zero."""
    discount: float = 0.98
    """Discount factor per environment step."""
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation."""
    clip: float = 0.2
    """Clipping range of the probability ratio."""
    entropy: float = 0.0
    """Coefficient of the entropy bonus."""
    value_weight: float = 0.5
    """Coefficient of the value loss."""
    max_grad_norm: float = 0.5
    """Largest global norm of a gradient; larger ones are scaled down to it."""
    init_std: float = 0.5
    """Initial standard deviation of the actions."""

    def __post_init__(self) -> None:
        """Check the values."""
        check_hyperparameters(self)


class Learner(PyTree):
    """Complete state of a training run; saving and loading it resumes the run bit for bit."""

    policy: Layers
    """Network from normalised observations to the mean action before tanh."""
    log_std: Array
    """Logarithm of the standard deviation of the actions. (n_actions,)"""
    value: Layers
    """Network from normalised observations to the normalised expected return."""
    optimizer: optax.OptState
    """State of the optimiser."""
    stats: RunningStats
    """Mean and variance with which observations are normalised."""
    returns: RunningStats
    """Mean and variance of returns, with which the outputs of the value network are scaled. (1,) each"""
    key: Array
    """Random key."""
    env: EnvState
    """State of the environments."""
    iteration: Array
    """Number of completed iterations. ()"""

    def as_policy(self) -> Policy:
        """Return the deterministic policy."""
        return Policy(self.stats, self.policy)


class Sample(PyTree):
    """Transitions of a rollout; leading axes (n_steps, n_worlds, n_drones)."""

    obs: Array
    """Normalised observations."""
    action: Array
    """Actions before clipping."""
    log_prob: Array
    """Log probability of the action."""
    value: Array
    """Value estimate before the step."""
    reward: Array
    """Reward, plus the discounted value of the final state where the episode was truncated."""
    done: Array
    """True where the episode ended with the step."""


def init(env: Env, config: Config, key: Array) -> Learner:
    """Return an untrained learner; ``env`` resets automatically within the step that ends an episode."""
    if env.sim.n_worlds % config.minibatches:
        raise ConfigError(
            f"expected minibatches that divide the {env.sim.n_worlds} worlds, got {config.minibatches}. Use for "
            f"example {math.gcd(env.sim.n_worlds, 8)}."
        )
    k_policy, k_value, k_env, key = jax.random.split(key, 4)
    state = env.reset(k_env)
    n_obs, n_actions = flatten(state.obs).shape[-1], env.actions.size
    policy = init_mlp(k_policy, (n_obs, *config.hidden, n_actions), 0.01)
    value = init_mlp(k_value, (n_obs, *config.hidden, 1), 1.0)
    log_std = jnp.full(n_actions, jnp.log(config.init_std), policy[0][0].dtype)
    optimizer = _optimizer(config).init((policy, log_std, value))
    stats = RunningStats.create(n_obs).update(flatten(state.obs))
    return Learner(policy, log_std, value, optimizer, stats, RunningStats.create(1), key, state, jnp.int32(0))


@partial(jax.jit, static_argnames=("env", "config"))
def iterate(learner: Learner, env: Env, config: Config) -> tuple[Learner, dict[str, Array]]:
    """Return the learner after one rollout and its updates, and the metrics of the iteration.

    The metric ``finite`` is True if weights, optimiser state, statistics and losses are finite.
    """
    key, k_fly, k_learn = jax.random.split(learner.key, 3)
    state, samples, raw, metrics = _collect(learner, env, config, k_fly)
    advantages, targets = _advantages(samples, _value(learner, learner.stats.normalize(flatten(state.obs))), config)
    returns = learner.returns.update(targets[..., None])
    targets = (targets - returns.mean) / _scale(returns)
    parameters = (learner.policy, learner.log_std, _rescale_value(learner.value, learner.returns, returns))
    parameters, optimizer, losses = _learn(parameters, learner.optimizer, samples, advantages, targets, config, k_learn)
    policy, log_std, value = parameters
    stats = learner.stats.update(raw)
    finite = all_finite((parameters, optimizer, stats, returns, losses))
    learner = Learner(policy, log_std, value, optimizer, stats, returns, key, state, learner.iteration + 1)
    return learner, metrics | losses | {"std": jnp.exp(log_std).mean(), "finite": finite}


def _collect(
    learner: Learner, env: Env, config: Config, key: Array
) -> tuple[EnvState, Sample, Array, dict[str, Array]]:
    """Return the state after a rollout, its samples, its observations before normalisation, and metrics."""

    def policy(obs: Obs, memory: Any, key: Array) -> tuple[Array, Any, Any]:
        raw = flatten(obs)
        seen = learner.stats.normalize(raw)
        mean, value = jnp.tanh(mlp(learner.policy, seen)), _value(learner, seen)
        action = mean + jnp.exp(learner.log_std) * jax.random.normal(key, mean.shape, mean.dtype)
        return action, memory, (raw, seen, value, _log_prob(mean, learner.log_std, action))

    def keep(transition: Transition) -> tuple[Sample, Array, Any]:
        raw, seen, value, log_prob = transition.extras
        truncated = (transition.truncated & ~transition.terminated)[:, None]
        final_value = _value(learner, learner.stats.normalize(flatten(transition.final_obs)))
        reward = transition.reward + config.discount * jnp.where(truncated, final_value, 0.0)
        over = jnp.broadcast_to(transition.done[:, None], reward.shape)
        sample = Sample(seen, transition.action, log_prob, value, reward, over)
        error = transition.state.info["error"].mean()
        return sample, raw, (transition.reward.mean(), transition.terminated, error)

    state, _, (samples, raw, (reward, crashed, error)) = rollout(env, learner.env, policy, key, config.n_steps, keep)
    over = samples.done.any(axis=-1)
    metrics = {
        "reward": reward.mean(),
        "crashed": crashed.sum() / jnp.maximum(over.sum(), 1),
        "error": error.mean(),
    }
    return state, samples, raw, metrics


def _advantages(samples: Sample, last: Array, config: Config) -> tuple[Array, Array]:
    """Return generalised advantage estimates and value targets. (n_steps, n_worlds, n_drones)"""

    def back(carry: tuple[Array, Array], sample: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], Array]:
        advantage, value_after = carry
        reward, value, over = sample
        discount = config.discount * ~over
        advantage = reward + discount * value_after - value + discount * config.gae_lambda * advantage
        return (advantage, value), advantage

    sequence = (samples.reward, samples.value, samples.done)
    _, advantages = jax.lax.scan(back, (jnp.zeros_like(last), last), sequence, reverse=True)
    return advantages, advantages + samples.value


def _learn(
    parameters: Any, optimizer: Any, samples: Sample, advantages: Array, targets: Array, config: Config, key: Array
) -> tuple[Any, Any, dict[str, Array]]:
    """Return parameters, optimiser state and mean losses after the updates on a rollout."""
    data = (samples.obs, samples.action, samples.log_prob, advantages, targets)

    def of_worlds(numbers: Array) -> Any:
        """Return the samples of some worlds. (n_samples, ...)"""
        return jax.tree.map(lambda x: x[:, numbers].reshape(-1, *x.shape[3:]), data)

    def loss(parameters: Any, batch: Any) -> tuple[Array, dict[str, Array]]:
        policy, log_std, value = parameters
        obs, action, log_prob, advantage, target = batch
        mean = jnp.tanh(mlp(policy, obs))
        ratio = jnp.exp(_log_prob(mean, log_std, action) - log_prob)
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
        gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - config.clip, 1 + config.clip) * advantage).mean()
        error = 0.5 * jnp.square(mlp(value, obs)[..., 0] - target).mean()
        total = -gain + config.value_weight * error - config.entropy * log_std.sum()
        return total, {"value_error": error, "ratio_off": jnp.abs(ratio - 1).mean()}

    def update(carry: Any, batch: Any) -> tuple[Any, dict[str, Array]]:
        parameters, optimizer = carry
        grads, losses = jax.grad(loss, has_aux=True)(parameters, batch)
        updates, optimizer = _optimizer(config).update(grads, optimizer, parameters)
        return (optax.apply_updates(parameters, updates), optimizer), losses

    def epoch(carry: Any, key: Array) -> tuple[Any, dict[str, Array]]:
        order = jax.random.permutation(key, targets.shape[1]).reshape(config.minibatches, -1)
        return jax.lax.scan(lambda c, numbers: update(c, of_worlds(numbers)), carry, order)

    carry, losses = jax.lax.scan(epoch, (parameters, optimizer), jax.random.split(key, config.epochs))
    return *carry, jax.tree.map(jnp.mean, losses)


def _optimizer(config: Config) -> optax.GradientTransformation:
    n_updates = config.iterations * config.epochs * config.minibatches
    schedule = optax.linear_schedule(config.learning_rate, 0.0, n_updates)
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(schedule))


def _value(learner: Learner, obs: Array) -> Array:
    """Return the expected return for normalised observations. (..., n_obs) -> (...)"""
    return mlp(learner.value, obs)[..., 0] * _scale(learner.returns) + learner.returns.mean


def _scale(returns: RunningStats) -> Array:
    """Return the standard deviation of returns. (1,)"""
    return jnp.sqrt(returns.var + EPSILON)


def _rescale_value(layers: Layers, old: RunningStats, new: RunningStats) -> Layers:
    """Return the value network with outputs that, scaled by the new statistics, equal those scaled by the old ones."""
    *hidden, (weight, bias) = layers
    ratio = _scale(old) / _scale(new)
    return [*hidden, (weight * ratio, bias * ratio + (old.mean - new.mean) / _scale(new))]


def _log_prob(mean: Array, log_std: Array, action: Array) -> Array:
    """Return the log density of a normal distribution up to a constant. (...)"""
    return -jnp.sum(0.5 * jnp.square((action - mean) / jnp.exp(log_std)) + log_std, axis=-1)
