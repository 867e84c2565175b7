"""Proximal policy optimisation (Schulman et al. 2017), with generalised advantages (Schulman et al. 2016)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

from crazysim.envs.env import Env
from crazysim.envs.state import EnvState, bare, flatten
from crazysim.envs.statistics import RunningStats
from crazysim.pytree import PyTree
from crazysim.train.networks import QUICK, Layers, Policy, init_mlp, mlp


@dataclass(frozen=True)
class Config:
    """Settings of the algorithm."""

    iterations: int = 200
    """Rounds of flying and learning."""
    n_steps: int = 32
    """Environment steps of a world in one round."""
    epochs: int = 4
    """How often a round's samples are learnt from."""
    minibatches: int = 8
    """Updates an epoch."""
    hidden: tuple[int, ...] = (64, 64)
    """Neurons of policy and value function."""
    learning_rate: float = 1e-3
    """Of Adam, falling to zero linearly."""
    discount: float = 0.98
    """Weight of a reward one step later."""
    trace: float = 0.95
    """Decay of the advantage's trace, lambda."""
    clip: float = 0.2
    """How far an update may change a probability."""
    entropy: float = 0.0
    """Weight of the policy's entropy."""
    value_weight: float = 0.5
    """Weight of the value function's error."""
    max_grad_norm: float = 0.5
    """Gradients are scaled down to this length."""
    init_std: float = 0.5
    """Standard deviation of the first actions."""


class Learner(PyTree):
    """Everything that training changes; saved as it is, it goes on as if it had not stopped."""

    policy: Layers
    """From observations to the mean action, before tanh."""
    log_std: Array
    """Logarithm of the actions' standard deviation. (n_actions,)"""
    value: Layers
    """From observations to the return to come."""
    optimizer: Any
    """State of the optimiser."""
    stats: RunningStats
    """What observations are normalised with."""
    key: Array
    """Random key."""
    env: EnvState
    """Where the worlds are, without reward and info."""
    iteration: Array
    """Rounds done. ()"""

    def as_policy(self) -> Policy:
        """Return the policy without noise."""
        return Policy(self.stats, self.policy)


class Sample(PyTree):
    """What one step of all worlds has given; leading axes (n_steps, n_worlds, n_drones)."""

    obs: Array
    """Normalised observations."""
    action: Array
    """Before it was clipped."""
    log_prob: Array
    """Of the action."""
    value: Array
    """Expected return before the step."""
    reward: Array
    """With what a world that ran out of time would still have given."""
    over: Array
    """Whether the episode ended with the step."""


def init(env: Env, config: Config, key: Array) -> Learner:
    """Return a learner that has learnt nothing; ``env`` begins new episodes within the step that ends one."""
    k_policy, k_value, k_env, key = jax.random.split(key, 4)
    state = env.reset(k_env)
    n_obs, n_actions = flatten(state.obs).shape[-1], env.actions.size
    policy = init_mlp(k_policy, (n_obs, *config.hidden, n_actions), 0.01)
    value = init_mlp(k_value, (n_obs, *config.hidden, 1), 1.0)
    log_std = jnp.full(n_actions, jnp.log(config.init_std), policy[0][0].dtype)
    optimizer = _optimizer(config).init((policy, log_std, value))
    stats = RunningStats.create(n_obs).update(flatten(state.obs))
    return Learner(policy, log_std, value, optimizer, stats, key, bare(state), jnp.int32(0))


@partial(jax.jit, static_argnames=("env", "config"), compiler_options=QUICK)
def iterate(learner: Learner, env: Env, config: Config) -> tuple[Learner, dict[str, Array]]:
    """Fly a round and learn from it; return the learner, and figures of the round."""
    key, k_fly, k_learn = jax.random.split(learner.key, 3)
    state, samples, raw, figures = _fly(learner, env, config, k_fly)
    advantages, returns = _advantages(samples, _value(learner.value, learner.stats, state.obs), config)
    parameters = (learner.policy, learner.log_std, learner.value)
    parameters, optimizer, losses = _learn(parameters, learner.optimizer, samples, advantages, returns, config, k_learn)
    policy, log_std, value = parameters
    learner = Learner(policy, log_std, value, optimizer, learner.stats.update(raw), key, state, learner.iteration + 1)
    return learner, figures | losses | {"std": jnp.exp(log_std).mean()}


def _fly(learner: Learner, env: Env, config: Config, key: Array) -> tuple[EnvState, Sample, Array, dict[str, Array]]:
    """Return where the worlds are after a round, its samples, and observations as they came."""

    def step(state: EnvState, key: Array) -> tuple[EnvState, tuple[Sample, Array, Any]]:
        raw = flatten(state.obs)
        obs = learner.stats.normalize(raw)
        mean, value = jnp.tanh(mlp(learner.policy, obs)), mlp(learner.value, obs)[..., 0]
        action = mean + jnp.exp(learner.log_std) * jax.random.normal(key, mean.shape, mean.dtype)
        state = env.step(state, action)
        out_of_time = (state.truncated & ~state.terminated)[:, None]
        to_come = _value(learner.value, learner.stats, state.info["final_obs"])
        reward = state.reward + config.discount * jnp.where(out_of_time, to_come, 0.0)
        over = jnp.broadcast_to(state.done[:, None], reward.shape)
        sample = Sample(obs, action, _log_prob(mean, learner.log_std, action), value, reward, over)
        return bare(state), (sample, raw, (state.reward.mean(), state.terminated, state.info["error"].mean()))

    state, (samples, raw, (reward, crashed, error)) = jax.lax.scan(
        step, learner.env, jax.random.split(key, config.n_steps)
    )
    over = samples.over.any(axis=-1)
    figures = {
        "reward": reward.mean(),
        "crashed": crashed.sum() / jnp.maximum(over.sum(), 1),
        "error": error.mean(),
    }
    return state, samples, raw, figures


def _advantages(samples: Sample, last: Array, config: Config) -> tuple[Array, Array]:
    """Return how much better each action was than expected, and the returns."""

    def back(carry: tuple[Array, Array], sample: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], Array]:
        advantage, value_after = carry
        reward, value, over = sample
        goes_on = config.discount * ~over
        advantage = reward + goes_on * value_after - value + goes_on * config.trace * advantage
        return (advantage, value), advantage

    sequence = (samples.reward, samples.value, samples.over)
    _, advantages = jax.lax.scan(back, (jnp.zeros_like(last), last), sequence, reverse=True)
    return advantages, advantages + samples.value


def _learn(
    parameters: Any, optimizer: Any, samples: Sample, advantages: Array, returns: Array, config: Config, key: Array
) -> tuple[Any, Any, dict[str, Array]]:
    """Return the parameters after a round's updates."""
    data = (samples.obs, samples.action, samples.log_prob, advantages, returns)
    data = jax.tree.map(lambda x: x.reshape(-1, *x.shape[3:]), data)
    n = data[-1].shape[0] // config.minibatches * config.minibatches

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
        grads, figures = jax.grad(loss, has_aux=True)(parameters, batch)
        updates, optimizer = _optimizer(config).update(grads, optimizer, parameters)
        return (optax.apply_updates(parameters, updates), optimizer), figures

    def epoch(carry: Any, key: Array) -> tuple[Any, dict[str, Array]]:
        order = jax.random.permutation(key, data[-1].shape[0])[:n].reshape(config.minibatches, -1)
        return jax.lax.scan(lambda c, i: update(c, jax.tree.map(lambda x: x[i], data)), carry, order)

    carry, figures = jax.lax.scan(epoch, (parameters, optimizer), jax.random.split(key, config.epochs))
    return *carry, jax.tree.map(jnp.mean, figures)


def _optimizer(config: Config) -> optax.GradientTransformation:
    n_updates = config.iterations * config.epochs * config.minibatches
    schedule = optax.linear_schedule(config.learning_rate, 0.0, n_updates)
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(schedule))


def _value(layers: Layers, stats: RunningStats, obs: dict[str, Array]) -> Array:
    return mlp(layers, stats.normalize(flatten(obs)))[..., 0]


def _log_prob(mean: Array, log_std: Array, action: Array) -> Array:
    """Return the log density of a normal distribution, up to a constant. (...)"""
    return -jnp.sum(0.5 * jnp.square((action - mean) / jnp.exp(log_std)) + log_std, axis=-1)
