"""Proximal policy optimisation (Schulman et al. 2017) with generalised advantage estimation (Schulman et al. 2016)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

from crazysim.envs.env import Env
from crazysim.envs.rollout import Transition, rollout
from crazysim.envs.state import PRIVILEGED, EnvState, Obs, flatten
from crazysim.envs.statistics import EPSILON, RunningStats
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree, static
from crazysim.train.convolution import Image, find_images
from crazysim.train.hyperparameters import check_hyperparameters
from crazysim.train.mlp_kernel import choose_mlp
from crazysim.train.networks import (
    ApplyLayers,
    Network,
    Policy,
    Weights,
    all_finite,
    choose_network,
    forward,
    init_weights,
    mlp,
    unroll,
)
from crazysim.train.optimizer import build_optimizer
from crazysim.train.seeds import SweptValues, for_each_seed, join_blocks, split_blocks, stack_swept_values

PRIVILEGED_CRITICS = ("privileged", "all_drones_privileged")
"""Critics that receive the observation of ``PrivilegedObservation``."""
MAX_GROUPS = 64
"""Largest number of groups of neighbouring worlds. A minibatch takes the same number of worlds from every group. A
device holds whole groups, so it needs no samples of other devices, and minibatches do not depend on the number of
devices."""


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
    """Sizes of the hidden layers of policy and value function; not used with a custom network."""
    memory: int = 0
    """Size of the memory of policy and value function, a gated recurrent unit before the hidden layers; 0 for none."""
    convolution: tuple[int, ...] = ()
    """Channels of the layers of a convolution over each image, with patches of 3 x 3 pixels and stride 2, before the
    memory and the hidden layers; empty to use the pixels without convolution."""
    critic: str = "observations"
    """Inputs of the value function: ``observations``, the observations of the policy; ``privileged``, also the true
    state and parameters of the drone; ``all_drones``, the observations of all drones of the world;
    ``all_drones_privileged``, also the true states and parameters of all drones of the world."""
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

    @property
    def n_updates(self) -> int:
        """Number of updates of the whole training."""
        return self.iterations * self.epochs * self.minibatches


class Agent(PyTree):
    """Networks, optimiser and statistics of one seed; in a ``Learner``, the arrays of all seeds are stacked."""

    policy: Weights
    """Weights from normalised observations to the mean action before tanh."""
    log_std: Array
    """Logarithm of the standard deviation of the actions. (n_actions,)"""
    value: Weights
    """Weights from the normalised inputs of the critic to the normalised expected return."""
    optimizer: optax.OptState
    """State of the optimiser."""
    stats: RunningStats
    """Mean and variance with which observations are normalised; the policy's observations come first."""
    returns: RunningStats
    """Mean and variance of returns, to scale the outputs of the value network. (1,) each"""
    key: Array
    """Random key. ()"""
    n_obs: int = static()
    """Number of observations of the policy."""
    network: Network = static()
    """Network of policy and value function."""
    apply_layers: ApplyLayers = static(default=mlp)
    """Function that computes the layers after the network."""

    def as_policy(self) -> Policy:
        """Return the deterministic policy."""
        stats = self.stats
        if stats.mean.shape[-1] > self.n_obs:
            stats = stats.replace(mean=stats.mean[..., : self.n_obs], var=stats.var[..., : self.n_obs])
        return Policy(stats, self.policy.layers, self.policy.body, self.network)


class Learner(PyTree):
    """Complete state of a training run; saving and loading it resumes the run bit for bit."""

    agents: Agent
    """The agents of all seeds. (n_seeds, ...) each"""
    env: EnvState
    """State of the environments: a block of worlds for each seed, of equal size."""
    memory: tuple[Any, Any]
    """Memories of policy and value function; ``()`` each without memory. (n_worlds, n_drones, ...) each"""
    iteration: Array
    """Number of completed iterations. ()"""

    def as_policy(self) -> Policy:
        """Return the deterministic policies of all seeds. (n_seeds, ...) each"""
        return self.agents.as_policy()


class Sample(PyTree):
    """Transitions of a rollout; leading axes (n_steps, n_worlds, n_drones)."""

    obs: Array
    """Normalised observations; the policy's observations come first."""
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


def init(env: Env, configs: Sequence[Config], keys: Array, network: Network | None = None) -> Learner:
    """Return an untrained learner of one or more seeds.

    Args:
        env: Environment that resets automatically within the step that ends an episode, with a block of worlds for
            each seed. A privileged critic also needs the wrapper ``PrivilegedObservation``. The worlds of all seeds
            share the statistics of a ``Normalize`` wrapper.
        configs: Hyperparameters of each seed; only ``SWEEPABLE`` ones may differ between seeds.
        keys: Random keys of the seeds. (n_seeds,)
        network: Custom network of policy and value function; None for the built-in one.
    """
    config, n_worlds = configs[0], env.sim.n_worlds // len(configs)
    if n_worlds % config.minibatches:
        raise ConfigError(
            f"expected minibatches that divide the {n_worlds} worlds, got {config.minibatches}. Use for "
            f"example {math.gcd(n_worlds, 8)}."
        )
    k_policy, k_value, k_env, k_agent = jnp.moveaxis(for_each_seed(lambda key: jax.random.split(key, 4), keys), 1, 0)
    hidden_sizes = config.hidden if network is None else ()
    state = env.reset(k_env)
    policy_obs = _policy_obs(state.obs, config)
    network = choose_network(config.memory, network, config.convolution, _find_images(env, policy_obs, config))
    apply_layers = choose_mlp(network, env.sim.device, env.sim.mesh, len(configs))
    n_obs = flatten(policy_obs).shape[-1]

    def init_agent(k_policy: Array, k_value: Array, key: Array, obs: Array) -> Agent:
        n_actions = env.actions.size
        policy = init_weights(network, k_policy, n_obs, (*hidden_sizes, n_actions), 0.01)
        value = init_weights(network, k_value, _critic_input(obs, config).shape[-1], (*hidden_sizes, 1), 1.0)
        log_std = jnp.full(n_actions, jnp.log(config.init_std), policy.layers[0][0].dtype)
        parameters: Any = (policy, log_std, value)
        optimizer = build_optimizer(config.learning_rate, config.max_grad_norm, config.n_updates).init(parameters)
        stats = RunningStats.create(obs.shape[-1], network.pixels).update(obs)
        returns = RunningStats.create(1)
        return Agent(policy, log_std, value, optimizer, stats, returns, key, n_obs, network, apply_layers)

    obs = split_blocks(_critic_obs(state.obs, config), len(configs))
    agents = for_each_seed(init_agent, k_policy, k_value, k_agent, obs)
    return Learner(agents, state, _initial_memories(network, state), jnp.int32(0))


@partial(jax.jit, static_argnames=("env", "configs"))
def iterate(learner: Learner, env: Env, configs: tuple[Config, ...]) -> tuple[Learner, dict[str, Array]]:
    """Return the learner after one rollout and its updates, and the metrics of the iteration. (n_seeds,) each

    The metric ``finite`` is True if weights, optimiser state, statistics and losses are finite; ``ratio_off`` is the
    mean distance of the probability ratio from 1; ``value_error`` is the mean value loss.
    """
    key, k_fly, k_learn = jnp.moveaxis(for_each_seed(lambda key: jax.random.split(key, 3), learner.agents.key), 1, 0)
    agents, swept_values = learner.agents.replace(key=key), stack_swept_values(configs)
    state, memory, samples, raw_obs, metrics = _collect_samples(agents, learner, env, configs[0], swept_values, k_fly)
    final_critic_inputs = (_critic_obs(state.obs, configs[0]), memory[1])
    blocks = split_blocks((learner.memory, final_critic_inputs), len(configs))
    update_agent = partial(_update_agent, config=configs[0])
    axes = (0, 1, 1, 0, 0, 0, 0)
    agents, losses = for_each_seed(
        update_agent, agents, samples, raw_obs, *blocks, swept_values, k_learn, axes=axes, mesh=env.sim.mesh
    )
    return Learner(agents, state, memory, learner.iteration + 1), metrics | losses


def _collect_samples(
    agents: Agent, learner: Learner, env: Env, config: Config, swept_values: SweptValues, keys: Array
) -> tuple[EnvState, tuple[Any, Any], Sample, Array, dict[str, Array]]:
    """Return the environment state and memories after a rollout, samples, raw observations, and metrics of all seeds.

    Samples and observations have leading axes (n_steps, n_seeds, n_worlds, n_drones); metrics have (n_seeds,). Raw
    observations are not normalised.
    """
    split_seeds = partial(split_blocks, n_seeds=keys.shape[0])

    def act(agent: Agent, raw_obs: Array, memory: Any, key: Array) -> tuple[Array, Any, Any]:
        normalized_obs = agent.stats.normalize(raw_obs)
        policy_obs = normalized_obs[..., : agent.n_obs]
        output, policy_memory = forward(agent.network, agent.policy, policy_obs, memory[0], agent.apply_layers)
        value, value_memory = _compute_value(agent, normalized_obs, memory[1], config)
        mean = jnp.tanh(output)
        action = mean + jnp.exp(agent.log_std) * jax.random.normal(key, mean.shape, mean.dtype)
        log_prob = _log_prob(mean, agent.log_std, action)
        return action, (policy_memory, value_memory), (raw_obs, normalized_obs, value, log_prob, value_memory)

    def policy(obs: Obs, memory: Any, keys: Array) -> tuple[Array, Any, Any]:
        raw_obs, memory = split_seeds((_critic_obs(obs, config), memory))
        action, memory, extras = for_each_seed(act, agents, raw_obs, memory, keys, mesh=env.sim.mesh)
        return join_blocks(action), join_blocks(memory), (action, *extras)

    def record_transition(transition: Transition) -> tuple[Sample, Array, Any]:
        action, raw_obs, normalized_obs, value, log_prob, memory = transition.extras
        reward, done, truncated, terminated, error = split_seeds(
            (
                transition.reward,
                transition.done[:, None],
                (transition.truncated & ~transition.terminated)[:, None],
                transition.terminated,
                transition.state.info["error"],
            )
        )

        def compute_final_value(agent: Agent, raw_obs: Array, memory: Any) -> Array:
            return _compute_value(agent, agent.stats.normalize(raw_obs), memory, config)[0]

        final_values = for_each_seed(
            compute_final_value,
            agents,
            split_seeds(_critic_obs(transition.final_obs, config)),
            memory,
            mesh=env.sim.mesh,
        )
        discount = swept_values["discount"][:, None, None]
        sample = Sample(
            normalized_obs,
            action,
            log_prob,
            value,
            reward + discount * jnp.where(truncated, final_values, 0.0),
            jnp.broadcast_to(done, reward.shape),
        )
        # Means would make the devices communicate in each step.
        return sample, raw_obs, (reward, terminated, error)

    initial_memory = _initial_memories(agents.network, learner.env)
    state, memory, (samples, raw_obs, (reward, terminated, error)) = rollout(
        env, learner.env, policy, keys, config.n_steps, record_transition, initial_memory, learner.memory
    )
    done = samples.done.any(axis=-1)
    metrics = {
        "reward": reward.mean(axis=(0, 2, 3)),
        "crashed": terminated.sum(axis=(0, 2)) / jnp.maximum(done.sum(axis=(0, 2)), 1),
        "error": error.mean(axis=(0, 2, 3)),
    }
    return state, memory, samples, raw_obs, metrics


def _update_agent(
    agent: Agent,
    samples: Sample,
    raw_obs: Array,
    memory: Any,
    final_critic_inputs: Any,
    swept_values: SweptValues,
    key: Array,
    config: Config,
) -> tuple[Agent, dict[str, Array]]:
    """Return the agent of one seed after the updates on its rollout, and metrics.

    Args:
        agent: The agent before the updates.
        samples: Samples of the rollout. (n_steps, n_worlds, n_drones, ...) each
        raw_obs: Observations before normalisation. (n_steps, n_worlds, n_drones, n_obs)
        memory: Memories of policy and value function before the rollout. (n_worlds, n_drones, ...) each
        final_critic_inputs: Observations (n_worlds, n_drones, n_obs) and memory of the value function after the
            rollout.
        swept_values: Hyperparameters of the seed that may differ between seeds. () each
        key: Random key.
        config: Hyperparameters of the first seed; values in ``swept_values`` take precedence.
    """
    last_obs, last_memory = final_critic_inputs
    last_value, _ = _compute_value(agent, agent.stats.normalize(last_obs), last_memory, config)
    advantages, targets = _estimate_advantages(samples, last_value, swept_values)
    returns = agent.returns.update(targets[..., None])
    targets = (targets - returns.mean) / _return_std(returns)
    parameters = (agent.policy, agent.log_std, _rescale_value(agent.value, agent.returns, returns))
    data = (samples, advantages, targets)
    parameters, optimizer, losses = _run_epochs(agent, parameters, data, memory, swept_values, key, config)
    policy, log_std, value = parameters
    stats = agent.stats.update(raw_obs)
    finite = all_finite((parameters, optimizer, stats, returns, losses))
    agent = agent.replace(
        policy=policy, log_std=log_std, value=value, optimizer=optimizer, stats=stats, returns=returns
    )
    return agent, losses | {"std": jnp.exp(log_std).mean(), "finite": finite}


def _estimate_advantages(samples: Sample, last_value: Array, swept_values: SweptValues) -> tuple[Array, Array]:
    """Return generalised advantage estimates and value targets. (n_steps, n_worlds, n_drones)"""

    def accumulate_advantage(
        carry: tuple[Array, Array], sample: tuple[Array, Array, Array]
    ) -> tuple[tuple[Array, Array], Array]:
        advantage, next_value = carry
        reward, value, done = sample
        discount = swept_values["discount"] * ~done
        advantage = reward + discount * next_value - value + discount * swept_values["gae_lambda"] * advantage
        return (advantage, value), advantage

    sequence = (samples.reward, samples.value, samples.done)
    _, advantages = jax.lax.scan(accumulate_advantage, (jnp.zeros_like(last_value), last_value), sequence, reverse=True)
    return advantages, advantages + samples.value


def _run_epochs(
    agent: Agent, parameters: Any, data: Any, memory: Any, swept_values: SweptValues, key: Array, config: Config
) -> tuple[Any, Any, dict[str, Array]]:
    """Return parameters, optimiser state and mean losses after all epochs on the samples of one seed.

    ``data`` is samples, advantages and value targets, (n_steps, n_worlds, n_drones, ...) each; ``memory`` is as for
    ``_update_agent``.
    """
    n_worlds, network, n_obs, apply_layers = data[1].shape[1], agent.network, agent.n_obs, agent.apply_layers
    n_groups = math.gcd(n_worlds // config.minibatches, MAX_GROUPS)
    transform = build_optimizer(swept_values["learning_rate"], swept_values["max_grad_norm"], config.n_updates)

    def select_minibatch(worlds: Array) -> Any:
        """Return the samples of the worlds of a minibatch, and their memories before the rollout.

        Args:
            worlds: Indices of the k worlds of each group that are in the minibatch. (n_groups, k)

        Returns:
            Samples (n_steps, n_groups, k, n_drones, ...) and memories (n_groups, k, n_drones, ...).
        """
        index_groups = jax.vmap(lambda x, worlds: x[:, worlds], (1, 0), 1)

        def take_worlds(x: Array) -> Array:
            return index_groups(x.reshape(x.shape[0], n_groups, -1, *x.shape[2:]), worlds)

        return *jax.tree.map(take_worlds, data), jax.tree.map(lambda x: take_worlds(x[None])[0], memory)

    def loss(parameters: Any, batch: Any) -> tuple[Array, dict[str, Array]]:
        policy, log_std, value = parameters
        sample, advantage, target, (policy_memory, value_memory) = batch
        mean = jnp.tanh(unroll(network, policy, sample.obs[..., :n_obs], policy_memory, sample.done, apply_layers))
        critic_input = _critic_input(sample.obs, config)
        values = unroll(network, value, critic_input, value_memory, sample.done, apply_layers)[..., 0]
        ratio = jnp.exp(_log_prob(mean, log_std, sample.action) - sample.log_prob)
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
        clipped_ratio = jnp.clip(ratio, 1 - swept_values["clip"], 1 + swept_values["clip"])
        objective = jnp.minimum(ratio * advantage, clipped_ratio * advantage).mean()
        value_loss = 0.5 * jnp.square(values - target).mean()
        total_loss = -objective + swept_values["value_weight"] * value_loss - swept_values["entropy"] * log_std.sum()
        return total_loss, {"value_error": value_loss, "ratio_off": jnp.abs(ratio - 1).mean()}

    def update(carry: Any, batch: Any) -> tuple[Any, dict[str, Array]]:
        parameters, optimizer = carry
        grads, losses = jax.grad(loss, has_aux=True)(parameters, batch)
        updates, optimizer = transform.update(grads, optimizer, parameters)
        return (optax.apply_updates(parameters, updates), optimizer), losses

    def run_epoch(carry: Any, key: Array) -> tuple[Any, dict[str, Array]]:
        keys = jax.random.split(key, n_groups)
        orders = jax.vmap(lambda key: jax.random.permutation(key, n_worlds // n_groups))(keys)
        minibatches = jnp.moveaxis(orders.reshape(n_groups, config.minibatches, -1), 1, 0)
        return jax.lax.scan(lambda carry, worlds: update(carry, select_minibatch(worlds)), carry, minibatches)

    carry, losses = jax.lax.scan(run_epoch, (parameters, agent.optimizer), jax.random.split(key, config.epochs))
    return *carry, jax.tree.map(jnp.mean, losses)


def _find_images(env: Env, policy_obs: Obs, config: Config) -> tuple[Image, ...]:
    """Return the images that a convolution replaces by features; none without a convolution."""
    if not config.convolution:
        return ()
    if config.critic.startswith("all_drones"):
        raise ConfigError(
            f"expected a critic of one drone with a convolution, got {config.critic!r}. Use critic='privileged'."
        )
    return find_images({name: x.shape[-1] for name, x in policy_obs.items()}, env.image_formats())


def _critic_obs(obs: Obs, config: Config) -> Array:
    """Return the observations of the policy, followed by observations that only the critic may use. (..., k)"""
    if config.critic not in PRIVILEGED_CRITICS:
        return flatten(obs)
    if PRIVILEGED not in obs:
        raise ConfigError(
            f"expected the observation {PRIVILEGED!r} for critic={config.critic!r}, got {', '.join(obs)}. Use "
            f"AutoReset(PrivilegedObservation(env))."
        )
    return jnp.concatenate([flatten(_policy_obs(obs, config)), obs[PRIVILEGED]], axis=-1)


def _policy_obs(obs: Obs, config: Config) -> Obs:
    """Return the observations of the policy: all except the observation of a privileged critic."""
    is_hidden = config.critic in PRIVILEGED_CRITICS
    return {name: x for name, x in obs.items() if not (is_hidden and name == PRIVILEGED)}


def _critic_input(obs: Array, config: Config) -> Array:
    """Return the inputs of the value function for each drone: its observations, or the observations of all drones.

    Args:
        obs: Result of ``_critic_obs``, normalised or not. (..., n_drones, k)
        config: Hyperparameters.
    """
    if config.critic not in ("all_drones", "all_drones_privileged"):
        return obs
    return jnp.concatenate([jnp.roll(obs, -i, axis=-2) for i in range(obs.shape[-2])], axis=-1)


def _initial_memories(network: Network, state: EnvState) -> tuple[Any, Any]:
    """Return the memories of policy and value function at the start of an episode. (n_worlds, n_drones, ...) each"""
    batch = state.reward.shape
    return network.make_memory(*batch), network.make_memory(*batch)


def _compute_value(agent: Agent, obs: Array, memory: Any, config: Config) -> tuple[Array, Any]:
    """Return the expected return for normalised observations, and the memory after the step. (..., k) -> (...)"""
    output, memory = forward(agent.network, agent.value, _critic_input(obs, config), memory, agent.apply_layers)
    return output[..., 0] * _return_std(agent.returns) + agent.returns.mean, memory


def _return_std(returns: RunningStats) -> Array:
    """Return the standard deviation of returns. (1,)"""
    return jnp.sqrt(returns.var + EPSILON)


def _rescale_value(weights: Weights, old_stats: RunningStats, new_stats: RunningStats) -> Weights:
    """Return the value network with its last layer rescaled, so that values are the same with the new statistics."""
    *hidden, (weight, bias) = weights.layers
    ratio = _return_std(old_stats) / _return_std(new_stats)
    return weights.replace(
        layers=[*hidden, (weight * ratio, bias * ratio + (old_stats.mean - new_stats.mean) / _return_std(new_stats))]
    )


def _log_prob(mean: Array, log_std: Array, action: Array) -> Array:
    """Return the log density of a normal distribution up to a constant. (...)"""
    return -jnp.sum(0.5 * jnp.square((action - mean) / jnp.exp(log_std)) + log_std, axis=-1)
