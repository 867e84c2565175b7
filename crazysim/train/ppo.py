"""Proximal policy optimisation (Schulman et al. 2017) with generalised advantage estimation (Schulman et al. 2016).

An iteration is a rollout, its advantages, and some epochs of updates. ``act``, ``record`` and ``learn`` are written for
one seed; ``iterate`` applies them to all seeds of a program.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

from crazysim.engine.pytree import PyTree, static
from crazysim.envs.env import Env
from crazysim.envs.state import EnvState, Obs, flatten
from crazysim.envs.statistics import RunningStats
from crazysim.errors import ConfigError, expect, require
from crazysim.train.convolution import images_of
from crazysim.train.critic import (
    PRIVILEGED_CRITICS,
    check_factors,
    critic_input,
    critic_obs,
    estimate_advantages,
    policy_obs,
    rescale_value,
    return_std,
)
from crazysim.train.hyperparameters import check_hyperparameters
from crazysim.train.interface import check_policy
from crazysim.train.mlp_kernel import choose_mlp
from crazysim.train.networks import (
    ApplyLayers,
    Network,
    Policies,
    Policy,
    Weights,
    choose_network,
    forward,
    init_weights,
    unroll,
)
from crazysim.train.optimizer import all_finite, build_optimizer, check_minibatches, run_epochs
from crazysim.train.policies import MultiPolicy, known_obs, load_start, start_from
from crazysim.train.seeds import Step, for_each_seed, rollout_seeds, split_blocks, split_keys, stack_configs

LEAST_STD = 0.1
"""Standard deviation of actions, in [-1, 1], around a demonstration that is learnt exactly."""


@dataclass(frozen=True)
class Config:
    """Hyperparameters of PPO."""

    iterations: int = 300
    """Number of iterations, each a rollout and the updates on its samples."""
    n_steps: int = 64
    """Environment steps per world in one rollout."""
    epochs: int = 4
    """Passes over the samples of a rollout."""
    minibatches: int = 32
    """Minibatches, and hence updates, per epoch; each contains all samples of a subset of the worlds."""
    hidden: tuple[int, ...] = (64, 64)
    """Sizes of the hidden layers of policy and value function; not used with a custom network."""
    memory: int = 0
    """Size of the memory of policy and value function, a gated recurrent unit before the hidden layers; 0 for none. A
    privileged critic has none: it sees what the policy has to remember."""
    shape: str = "default"
    """Shape of the policy. ``raptor``: a dense layer of the size of the memory with ReLU, the memory and a linear layer
    whose outputs are limited to [-1, 1], as flight controllers with RAPTOR's network run; ``hidden`` is then of the
    value function alone."""
    convolution: tuple[int, ...] = ()
    """Channels of the layers of a convolution over each image, with patches of 3 x 3 pixels and stride 2, before the
    memory and the hidden layers; empty to use the pixels without convolution."""
    critic: str = "observations"
    """Inputs of the value function: ``observations``, the observations of the policy; ``privileged``, also the true
    state and parameters of the drone; ``all_drones``, the observations of all drones of the world;
    ``all_drones_privileged``, also the true states and parameters of all drones of the world."""
    learning_rate: float = 1e-3
    """Initial learning rate of Adam, annealed linearly to zero."""
    discount: float = 0.99
    """Discount factor per environment step."""
    gae_lambda: float = 0.98
    """Lambda of generalised advantage estimation."""
    clip: float = 0.2
    """Clipping range of the probability ratio."""
    entropy: float = 0.01
    """Coefficient of the entropy bonus."""
    value_weight: float = 0.5
    """Coefficient of the value loss."""
    max_grad_norm: float = 0.5
    """Largest global norm of a gradient; larger ones are scaled down to it."""
    init_std: float = 0.5
    """Initial standard deviation of the actions."""
    demonstrations: int = 0
    """Iterations at the start in which the policy learns the actions of the task's ``demonstrate`` where it flies
    itself, and the value function its returns."""
    start: str = ""
    """Folder of a run, of any algorithm, from whose policy the training starts; empty for a new policy. It must have
    the same network; a dense one without memory may have fewer observations."""
    value_iterations: int = 0
    """Iterations at the start in which the value function learns, and the policy stays as it is."""
    opponents: int = 0
    """Drones of each world, its last ones, that earlier versions of the policy or ``rivals`` fly; the policy learns
    from the others. Each version and each rival flies in an equal share of the worlds. 0 if it flies all drones."""
    versions: int = 8
    """Number of earlier versions that are kept for ``opponents``, the latest ones. At the start all are the first."""
    version_every: int = 10
    """Iterations from one version to the next."""
    rivals: tuple[str, ...] = ()
    """Folders of runs whose policies, without memory, are opponents from the start and do not change."""
    rewards: Mapping[str, float] | tuple[tuple[str, float], ...] = ()
    """Factors of terms of the reward in training, such as ``{"progress": 3.0}``; other terms stay as they are."""

    def __post_init__(self) -> None:
        check_hyperparameters(self)

    @property
    def n_updates(self) -> int:
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
    """Network of the policy."""
    critic_network: Network = static()
    """Network of the value function."""
    apply_layers: ApplyLayers = static()
    """Function that computes the layers after the network of the policy."""
    apply_critic_layers: ApplyLayers = static()
    """Function that computes the layers after the network of the value function."""
    n_learners: int | None = static(default=None)
    """Number of drones of a world, its first ones, that the policy flies; None for all."""
    versions: Any = ()
    """``Policy`` of all earlier versions, stacked, which fly the other drones; ``()`` without opponents."""
    rivals: tuple[Policy, ...] = ()
    """Other policies that fly them."""

    def observe(self, obs: Obs, config: Config) -> tuple[Array, Array]:
        """Join the observations of policy and critic: as they are, and normalised. (n_worlds, n_drones, k) each"""
        raw_obs = critic_obs(obs, config.critic)
        return raw_obs, self.stats.normalize(raw_obs)

    def estimate_value(self, obs: Array, memory: Any, config: Config) -> tuple[Array, Any]:
        """Estimate the returns of the drones that learn from normalised observations, and advance the memory. (...)"""
        x = critic_input(obs, config.critic)
        x = x[..., : self.n_learners, :]
        output, memory = forward(self.critic_network, self.value, x, memory, self.apply_critic_layers)
        return output[..., 0] * return_std(self.returns) + self.returns.mean, memory

    def as_policy(self) -> Policy:
        stats = self.stats.replace(mean=self.stats.mean[..., : self.n_obs], var=self.stats.var[..., : self.n_obs])
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
    """Whether the episode ended with the step."""
    shown: Array | None = None
    """Actions of the demonstration; None without demonstrations."""


def init(env: Env, configs: Sequence[Config], keys: Array, network: Network | None = None) -> Learner:
    """Make an untrained learner of one or more seeds.

    Args:
        env: Environment that resets automatically within the step that ends an episode, with a block of worlds for
            each seed. A privileged critic also needs the wrapper ``PrivilegedObservation``. The worlds of all seeds
            share the statistics of a ``Normalize`` wrapper.
        configs: Hyperparameters of each seed; only ``SWEEPABLE`` ones may differ between seeds.
        keys: Random keys of the seeds. (n_seeds,)
        network: Custom network of policy and value function; None for the built-in one.
    """
    config = configs[0]
    check_minibatches(config.minibatches, env.sim.n_worlds // len(configs))
    if config.demonstrations:
        check_demonstration(env)
    rivals = load_opponents(env, config, env.sim.n_worlds // len(configs)) if config.opponents else ()
    k_policy, k_value, k_env, k_agent = split_keys(keys, 4)
    state, hidden = env.reset(k_env), config.hidden if network is None else ()
    check_factors(config, state)
    obs = policy_obs(state.obs, config.critic)
    images, start = images_of(env, obs) if config.convolution else (), load_start(config.start, env, obs)
    is_privileged = config.critic in PRIVILEGED_CRITICS and network is None
    critic_network = choose_network(0 if is_privileged else config.memory, network, config.convolution, images)
    network = choose_network(config.memory, network, config.convolution, images, config.shape)
    policy_hidden = hidden if network.is_built_in else ()
    apply_layers, apply_critic_layers = (
        choose_mlp(x, env.sim.device, env.sim.mesh, len(configs)) for x in (network, critic_network)
    )
    n_obs, n_actions = flatten(obs).shape[-1], env.actions.size

    def init_agent(k_policy: Array, k_value: Array, key: Array, raw_obs: Array) -> Agent:
        policy = init_weights(network, k_policy, n_obs, (*policy_hidden, n_actions), 0.01)
        stats, returns = RunningStats.create(raw_obs.shape[-1], network.pixels).update(raw_obs), RunningStats.create(1)
        n_inputs = critic_input(raw_obs, config.critic).shape[-1]
        value = init_weights(critic_network, k_value, n_inputs, (*hidden, 1), 1.0)
        log_std = jnp.full(n_actions, jnp.log(config.init_std), policy.layers[0][0].dtype)
        parameters: Any = (policy, log_std, value)
        optimizer = build_optimizer(config.learning_rate, config.max_grad_norm, config.n_updates).init(parameters)
        policy, stats = start_from(start, policy, stats, n_obs)
        networks = network, critic_network, apply_layers, apply_critic_layers
        agent = Agent(policy, log_std, value, optimizer, stats, returns, key, n_obs, *networks)
        if not config.opponents:
            return agent
        n = config.versions
        versions = jax.tree.map(lambda x: jnp.broadcast_to(x, (n, *x.shape)), agent.as_policy())
        return agent.replace(n_learners=env.sim.n_drones - config.opponents, versions=versions, rivals=rivals)

    raw_obs = split_blocks(critic_obs(state.obs, config.critic), len(configs))
    agents = for_each_seed(init_agent, k_policy, k_value, k_agent, raw_obs)
    return Learner(agents, state, _initial_memory(agents, state), jnp.int32(0))


def _initial_memory(agents: Agent, state: EnvState) -> tuple[Any, Any]:
    batch = state.reward[:, : agents.n_learners].shape
    return agents.network.make_memory(*state.reward.shape), agents.critic_network.make_memory(*batch)


@partial(jax.jit, static_argnames=("env", "configs"))
def iterate(learner: Learner, env: Env, configs: tuple[Config, ...]) -> tuple[Learner, dict[str, Array]]:
    """Return the learner after one rollout and its updates, and the metrics of the iteration. (n_seeds,) each

    The metric ``finite`` is True if weights, optimiser state, statistics and losses are finite; ``ratio_off`` is the
    mean distance of the probability ratio from 1; ``value_error`` is the mean value loss.
    """
    return advance(learner, env, stack_configs(configs))


def advance(learner: Learner, env: Env, config: Config) -> tuple[Learner, dict[str, Array]]:
    """Return the results of ``iterate``, without compiling it, with the hyperparameters of ``stack_configs``."""
    key, k_fly, k_learn = split_keys(learner.agents.key, 3)
    agents, n_seeds = learner.agents.replace(key=key), len(learner.agents.key)
    initial_memory = _initial_memory(agents, learner.env)
    show = env.task.demonstrate if config.demonstrations else None
    # Fly the worlds of all seeds as one batch.
    state, memory, records = rollout_seeds(
        env,
        learner.env,
        partial(act, show=show),
        record,
        (agents, config),
        k_fly,
        config.n_steps,
        initial_memory,
        learner.memory,
    )
    # Update each agent with the worlds of its seed.
    blocks = split_blocks((learner.memory, state.obs, memory[1]), n_seeds)
    axes = (0, 0, 1, 0, 0, 0, 0, 0)
    iterations = jnp.broadcast_to(learner.iteration, n_seeds)
    agents, metrics = for_each_seed(
        learn, agents, config, records, *blocks, k_learn, iterations, axes=axes, mesh=env.sim.mesh
    )
    if config.opponents:
        agents = for_each_seed(partial(keep_version, config, learner.iteration + 1), agents)
    return Learner(agents, state, memory, learner.iteration + 1), metrics


def act(
    agent: Agent,
    config: Config,
    obs: Obs,
    memory: Any,
    key: Array,
    show: Callable[[Obs], Array] | None = None,
) -> tuple[Array, Any, Any]:
    """Draw an action, and return it with the memories of policy and critic after the step; opponents do not explore."""
    n = agent.n_learners
    raw_obs, x = agent.observe(obs, config)
    value, value_memory = agent.estimate_value(x, memory[1], config)
    own_obs, own_memory = x[..., :n, : agent.n_obs], jax.tree.map(lambda m: m[:, :n], memory[0])
    output, policy_memory = forward(agent.network, agent.policy, own_obs, own_memory, agent.apply_layers)
    mean = agent.network.squash(output)
    action = mean + jnp.exp(agent.log_std) * jax.random.normal(key, mean.shape, mean.dtype)
    shown = None if show is None else jnp.clip(show(policy_obs(obs, config.critic)), -1.0, 1.0).astype(mean.dtype)
    # A critic of all drones also learns from the observations of the opponents.
    seen = x if config.critic.startswith("all_drones") else x[..., :n, :]
    shown = None if shown is None else shown[..., :n, :]
    extras = raw_obs[..., :n, :], seen, action, log_prob(mean, agent.log_std, action), value, value_memory, shown
    if n is not None:
        others = jax.tree.map(lambda x: x[:, n:], (policy_obs(obs, config.critic), memory[0]))
        results = (action, policy_memory), fly_opponents(agent, *others)
        action, policy_memory = jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), *results)
    return action, (policy_memory, value_memory), extras


def record(agent: Agent, config: Config, step: Step, extras: Any) -> tuple[Sample, Array, dict[str, Array]]:
    """Return the sample of a step, its observations before normalisation, and what metrics are made of."""
    raw_obs, obs, action, action_log_prob, value, memory, shown = extras
    # An episode that was cut off would have gone on: the critic estimates what it would have got.
    final_value, _ = agent.estimate_value(agent.observe(step.final_obs, config)[1], memory, config)
    is_cut_off = (step.truncated & ~step.terminated)[:, None]
    reward = step.scaled_reward(config.rewards)[..., : agent.n_learners]
    reward = reward + config.discount * jnp.where(is_cut_off, final_value, 0.0)
    done = jnp.broadcast_to(step.done[:, None], reward.shape)
    # Means would make the devices communicate in each step.
    own_reward, error = (x[..., : agent.n_learners] for x in (step.reward, step.error))
    outcome = {"reward": own_reward, "terminated": step.terminated, "error": error}
    return Sample(obs, action, action_log_prob, value, reward, done, shown), raw_obs, outcome


def learn(
    agent: Agent,
    config: Config,
    records: Any,
    memory: Any,
    last_obs: Obs,
    last_memory: Any,
    key: Array,
    iteration: Array,
) -> tuple[Agent, dict[str, Array]]:
    """Update the agent with the records of its rollout, and return it with the metrics of the iteration.

    ``memory`` is of policy and critic before the rollout; ``last_obs`` and the critic's ``last_memory`` are after it.
    """
    samples, raw_obs, outcome = records
    # Advantages, and targets of the critic on the scale of the returns.
    last_value, _ = agent.estimate_value(agent.observe(last_obs, config)[1], last_memory, config)
    sequence = samples.reward, samples.value, samples.done
    advantages, targets = estimate_advantages(sequence, last_value, config)
    returns = agent.returns.update(targets[..., None])
    targets = (targets - returns.mean) / return_std(returns)
    parameters = (agent.policy, agent.log_std, rescale_value(agent.value, agent.returns, returns))
    # Epochs of updates on minibatches.
    own_memory = jax.tree.map(lambda x: x[:, : agent.n_learners], memory)
    data = samples, advantages, targets, jax.tree.map(lambda x: x[None], own_memory)
    loss = partial(compute_loss, agent, config, iteration)
    parameters, optimizer, losses = run_epochs(loss, parameters, agent.optimizer, data, config, key)
    if config.value_iterations:  # at first only the value function and the optimiser's moments change
        stays = partial(jnp.where, iteration < config.value_iterations)
        parameters = (*jax.tree.map(stays, (agent.policy, agent.log_std), parameters[:2]), parameters[2])
    # Statistics of the observations, and metrics.
    stats = agent.stats.update(raw_obs)
    metrics = losses | {
        "reward": outcome["reward"].mean(),
        "crashed": outcome["terminated"].sum() / jnp.maximum(samples.done.any(axis=-1).sum(), 1),
        "error": outcome["error"].mean(),
        "std": jnp.exp(parameters[1]).mean(),
        "finite": all_finite((parameters, optimizer, stats, returns, losses)),
    }
    policy, log_std, value = parameters
    updated = agent.replace(
        policy=policy, log_std=log_std, value=value, optimizer=optimizer, stats=stats, returns=returns
    )
    return updated, metrics


def compute_loss(
    agent: Agent, config: Config, iteration: Array, parameters: Any, minibatch: Any
) -> tuple[Array, dict[str, Array]]:
    """Compute the loss of policy and value function on a minibatch: clipped objective, value error and entropy."""
    policy, log_std, value = parameters
    sample, advantage, target, memory = minibatch
    policy_memory, value_memory = jax.tree.map(lambda x: x[0], memory)
    obs, done = sample.obs[..., : agent.n_learners, : agent.n_obs], sample.done
    value_obs = critic_input(sample.obs, config.critic)[..., : agent.n_learners, :]
    mean = agent.network.squash(unroll(agent.network, policy, obs, policy_memory, done, agent.apply_layers))
    values = unroll(agent.critic_network, value, value_obs, value_memory, done, agent.apply_critic_layers)[..., 0]
    ratio = jnp.exp(log_prob(mean, log_std, sample.action) - sample.log_prob)
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
    objective = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - config.clip, 1 + config.clip) * advantage).mean()
    if sample.shown is not None:
        # Likelihood of the demonstrated actions with some noise, so that exploration does not end.
        square = jnp.square(sample.shown - mean) + LEAST_STD**2
        likelihood = -(0.5 * square / jnp.exp(2 * log_std) + log_std).sum(axis=-1).mean()
        objective = jnp.where(iteration < config.demonstrations, likelihood, objective)
    value_loss = 0.5 * jnp.square(values - target).mean()
    total_loss = -objective + config.value_weight * value_loss - config.entropy * log_std.sum()
    return total_loss, {"value_error": value_loss, "ratio_off": jnp.abs(ratio - 1).mean()}


def keep_version(config: Config, iteration: Array, agent: Agent) -> Agent:
    """Replace the oldest version by the policy if one is due after an iteration."""
    version, rest = jnp.divmod(iteration, config.version_every)
    is_next = (rest == 0) & (jnp.arange(config.versions) == version % config.versions)
    versions = jax.tree.map(
        lambda old, new: jnp.where(is_next.reshape(-1, *[1] * new.ndim), new, old), agent.versions, agent.as_policy()
    )
    return agent.replace(versions=versions)


def fly_opponents(agent: Agent, obs: Obs, memory: Any) -> tuple[Array, Any]:
    """Return the actions of the opponents: the worlds are divided among the versions, and then the rivals."""
    n_versions = len(agent.versions.stats.mean)
    share = len(jax.tree.leaves(obs)[0]) // (n_versions + len(agent.rivals))
    n = share * n_versions
    action, own_memory = Policies(agent.versions).act(*jax.tree.map(lambda x: x[:n], (obs, memory)))
    actions, memory = [action], jax.tree.map(lambda new, old: jnp.concatenate([new, old[n:]]), own_memory, memory)
    for i, rival in enumerate(agent.rivals):
        worlds = slice(n + i * share, n + (i + 1) * share)
        actions.append(rival({name: x[worlds] for name, x in known_obs(rival, obs).items()}))
    return jnp.concatenate(actions), memory


def load_opponents(env: Env, config: Config, n_worlds: int) -> tuple[Policy, ...]:
    """Return the rivals, after checking that a drone is left that learns, and that all opponents get equal shares."""
    from crazysim.train.training import load_policy

    n_drones, n_shares = env.sim.n_drones, config.versions + len(config.rivals)
    require(
        config.opponents < n_drones,
        f"expected fewer opponents than the {n_drones} drones of a world, got {config.opponents}. Use --set n_drones="
        f"{config.opponents + 1}, or opponents=0.",
    )
    require(
        n_worlds % n_shares == 0,
        f"expected a number of worlds that {config.versions} versions and {len(config.rivals)} rivals divide, got "
        f"{n_worlds}. Use --worlds {n_shares * max(n_worlds // n_shares, 1)}.",
    )
    rivals = tuple([load_policy(folder)[0] for folder in config.rivals])
    for rival in rivals:
        check_policy(MultiPolicy.of([rival]), env)
    require(
        not any(rival.has_memory for rival in rivals),
        f"expected rivals without memory, got {', '.join(config.rivals)}. Use policies trained with memory=0.",
    )
    return rivals


def check_demonstration(env: Env) -> None:
    """Check that the task of an environment shows an action for each observation."""
    name, shape = type(env.task).__name__, (env.sim.n_worlds, env.sim.n_drones, env.actions.size)
    require(
        hasattr(env.task, "demonstrate"),
        f"expected a task with demonstrations, got {name}. Define demonstrate(obs), or use demonstrations=0.",
    )
    obs = jax.eval_shape(env.reset, jax.random.key(0)).obs
    try:
        action = jax.eval_shape(env.task.demonstrate, obs)
    except Exception as error:
        remedy = "Make it a @staticmethod, or use demonstrate(self, obs)."
        if isinstance(error, KeyError):
            remedy = f"The observations are {', '.join(obs)}."
        raise ConfigError(
            f"expected {name}.demonstrate(obs) as a function from observations to actions {shape}, got "
            f"{type(error).__name__}: {str(error)[:300]}. {remedy}"
        ) from error
    got = getattr(action, "shape", action)
    expect(
        got == shape, f"{name}.demonstrate(obs) of shape {shape}, in [-1, 1] as {env.sim.control.value} commands", got
    )


def log_prob(mean: Array, log_std: Array, action: Array) -> Array:
    """Log density of a normal distribution up to a constant. (...)"""
    return -jnp.sum(0.5 * jnp.square((action - mean) / jnp.exp(log_std)) + log_std, axis=-1)
