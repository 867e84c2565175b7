"""Analytic policy gradients: the return of a short horizon is differentiated through the simulator.

With ``critic_epochs`` a value function estimates the return after the horizon, as in SHAC (Xu et al. 2022, "Accelerated
policy learning with parallel differentiable simulation").
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jax.sharding import NamedSharding, PartitionSpec

from crazysim.engine.pytree import PyTree, select_worlds, static
from crazysim.engine.sharding import WORLD_AXIS
from crazysim.envs.env import Env
from crazysim.envs.state import EnvState, Obs, flatten
from crazysim.envs.statistics import RunningStats
from crazysim.errors import require
from crazysim.train.convolution import images_of
from crazysim.train.critic import (
    check_factors,
    critic_input,
    critic_obs,
    estimate_advantages,
    policy_obs,
    rescale_value,
    return_std,
)
from crazysim.train.hyperparameters import check_hyperparameters
from crazysim.train.networks import (
    MEMORYLESS_NETWORK,
    Network,
    Policy,
    Weights,
    choose_network,
    forward,
    init_weights,
)
from crazysim.train.optimizer import all_finite, build_optimizer, check_minibatches, run_epochs
from crazysim.train.policies import load_start, start_from
from crazysim.train.seeds import (
    Step,
    are_seeds_divided,
    for_each_seed,
    rollout_seeds,
    split_blocks,
    split_keys,
    stack_configs,
)

T = TypeVar("T")
STATS_ITERATIONS = 20
"""Number of iterations at the start during which the observation statistics are updated, and values do not count."""


@dataclass(frozen=True)
class Config:
    """Hyperparameters of analytic policy gradients."""

    iterations: int = 400
    """Number of iterations, each a short rollout and one update."""
    n_steps: int = 40
    """Horizon: environment steps per iteration through which the gradient is propagated."""
    hidden: tuple[int, ...] = (64, 64)
    """Sizes of the hidden layers of the policy; not used with ``shape="raptor"``."""
    memory: int = 0
    """Size of the memory of the policy, as in PPO; 0 for none."""
    shape: str = "default"
    """Shape of the policy, as in PPO."""
    convolution: tuple[int, ...] = ()
    """Channels of the layers of a convolution over each image, as in PPO."""
    image_gradients: bool = True
    """Whether the gradient passes through images, as it does through other observations, or takes them as constants."""
    start: str = ""
    """Folder of a run, of any algorithm, from whose policy the training starts; empty for a new policy. It must have
    the same network; a dense one without memory may have fewer observations."""
    critic_epochs: int = 0
    """Passes over the samples of a rollout by which a value function learns the return after the horizon; 0 for none.
    The policy then also learns from ends of episodes, which have no gradient themselves."""
    minibatches: int = 4
    """Minibatches of worlds, and hence updates of the value function, in each of these passes."""
    critic: str = "observations"
    """Inputs of the value function, as in PPO."""
    learning_rate: float = 3e-3
    """Initial learning rate of Adam, annealed linearly to zero."""
    discount: float = 0.99
    """Discount factor per environment step."""
    gae_lambda: float = 0.95
    """Lambda of the returns that the value function learns."""
    max_grad_norm: float = 1.0
    """Largest global norm of a gradient; larger ones are scaled down to it."""
    rewards: Mapping[str, float] | tuple[tuple[str, float], ...] = ()
    """Factors of terms of the reward in training, as in PPO."""

    def __post_init__(self) -> None:
        check_hyperparameters(self)

    @property
    def epochs(self) -> int:
        return self.critic_epochs

    @property
    def n_updates(self) -> int:
        """Updates of the value function."""
        return self.iterations * self.critic_epochs * self.minibatches


class Agent(PyTree):
    """Network, optimiser and statistics of one seed; in a ``Learner``, the arrays of all seeds are stacked."""

    policy: Any
    """``Weights`` from normalised observations to the action before tanh."""
    optimizer: optax.OptState
    """State of the optimiser."""
    stats: RunningStats
    """Mean and variance with which observations are normalised; the policy's observations come first."""
    returns: RunningStats
    """Mean and variance of returns, to scale the outputs of the value network. (1,) each"""
    key: Array
    """Random key. ()"""
    value: Any = ()
    """``Weights`` from the normalised inputs of the critic to the normalised expected return; ``()`` without one."""
    value_optimizer: Any = ()
    """State of its optimiser."""
    n_obs: int = static(default=0)
    """Number of observations of the policy."""
    network: Network = static(default=MEMORYLESS_NETWORK)
    """Network of the policy."""
    critic_network: Network = static(default=MEMORYLESS_NETWORK)
    """Network of the value function."""

    def estimate_value(self, raw_obs: Array, config: Config) -> Array:
        """Estimate the returns after observations. (...)"""
        x = critic_input(self.stats.normalize(raw_obs), config.critic)
        output, _ = forward(self.critic_network, self.value, x, ())
        return output[..., 0] * return_std(self.returns) + self.returns.mean

    def as_policy(self, weights: Weights) -> Policy:
        stats = self.stats.replace(mean=self.stats.mean[..., : self.n_obs], var=self.stats.var[..., : self.n_obs])
        return Policy(stats, weights.layers, weights.body, self.network)


class Learner(PyTree):
    """Complete state of a training run; saving and loading it resumes the run bit for bit."""

    agents: Agent
    """The agents of all seeds. (n_seeds, ...) each"""
    env: EnvState
    """State of the environments at the end of the last iteration: a block of worlds for each seed, of equal size."""
    memory: Any
    """Memory of the policies; ``()`` without memory. (n_worlds, n_drones, ...) each"""
    iteration: Array
    """Number of completed iterations. ()"""

    def as_policy(self) -> Policy:
        """Return the policies of all seeds. (n_seeds, ...) each"""
        return self.agents.as_policy(self.agents.policy)


def init(env: Env, configs: Sequence[Config], keys: Array) -> Learner:
    """Return an untrained learner.

    Args:
        env: Environment without automatic resets, with a block of worlds for each seed.
        configs: Hyperparameters of each seed; only ``SWEEPABLE`` ones may differ between seeds.
        keys: Random keys of the seeds. (n_seeds,)
    """
    config, formats = configs[0], env.image_formats()
    constant = [name for name, x in formats.items() if not x.get("has_gradient", True)]
    require(
        not (constant and config.image_gradients),
        f"expected images whose gradients are not zero, got {', '.join(constant)}. Use outputs=('depth',) of the "
        f"camera, color_gradients=True for colours, or image_gradients=False.",
    )
    if config.critic_epochs:
        check_minibatches(config.minibatches, env.sim.n_worlds // len(configs))
    k_policy, k_env, k_agent = split_keys(keys, 3)
    state = env.reset(k_env)
    check_factors(config, state)
    obs = policy_obs(state.obs, config.critic)
    images, start = images_of(env, obs) if config.convolution else (), load_start(config.start, env, obs)
    network = choose_network(config.memory, None, config.convolution, images, config.shape)
    critic_network = choose_network(0, None, config.convolution, images)
    hidden = config.hidden if network.is_built_in else ()
    n_obs = flatten(obs).shape[-1]

    def init_agent(k_policy: Array, key: Array, raw_obs: Array) -> Agent:
        policy: Any = init_weights(network, k_policy, n_obs, (*hidden, env.actions.size), 0.01)
        stats, returns = RunningStats.create(raw_obs.shape[-1], network.pixels).update(raw_obs), RunningStats.create(1)
        policy, stats = start_from(start, policy, stats, n_obs)
        optimizer = build_optimizer(config.learning_rate, config.max_grad_norm, config.iterations).init(policy)
        value, value_optimizer = (), ()
        if config.critic_epochs:
            n_inputs = critic_input(raw_obs, config.critic).shape[-1]
            sizes = (*config.hidden, 1)
            value: Any = init_weights(critic_network, jax.random.fold_in(k_policy, 2), n_inputs, sizes, 1.0)
            value_optimizer = build_optimizer(config.learning_rate, config.max_grad_norm, config.n_updates).init(value)
        networks = network, critic_network
        return Agent(policy, optimizer, stats, returns, key, value, value_optimizer, n_obs, *networks)

    raw_obs = split_blocks(critic_obs(state.obs, config.critic), len(configs))
    agents = for_each_seed(init_agent, k_policy, k_agent, raw_obs)
    return Learner(agents, state, network.make_memory(*state.reward.shape), jnp.int32(0))


@partial(jax.jit, static_argnames=("env", "configs"))
def iterate(learner: Learner, env: Env, configs: tuple[Config, ...]) -> tuple[Learner, dict[str, Array]]:
    """Return the learner after one rollout and one update, and the metrics of the iteration. (n_seeds,) each

    The metric ``gradient`` is the norm of the gradient before it is limited; ``finite`` is True if weights, optimiser
    state, statistics and loss are finite. The rollout starts where the previous rollout ended; worlds in which the
    episode is over start a new episode. The scan stores its intermediates instead of recomputing them under
    ``jax.checkpoint``: tens of steps fit in memory.
    """
    initial_state = env.restart(learner.env, learner.env.done)
    agents, config, n_seeds, mesh = learner.agents, stack_configs(configs), len(configs), env.sim.mesh
    iterations = jnp.broadcast_to(learner.iteration, n_seeds)
    initial_memory = agents.network.make_memory(*learner.env.reward.shape)
    restart = partial(select_worlds, learner.env.done)
    initial_memory = jax.tree.map(restart, initial_memory, learner.memory)
    constant = () if configs[0].image_gradients else tuple(env.image_formats())
    act_fn = partial(act, constant=constant)
    # On several devices each has a copy of the policy for its worlds. They sum the gradients of the copies once, after
    # all steps; with a single policy they would sum its gradients in every step.
    n_copies = 1 if mesh is None or are_seeds_divided(n_seeds, mesh) else mesh.size

    def copy(tree: T) -> T:
        if mesh is None or n_copies == 1:
            return tree
        copies = jax.tree.map(lambda x: jnp.repeat(x, n_copies, axis=0), tree)
        return jax.lax.with_sharding_constraint(copies, NamedSharding(mesh, PartitionSpec(WORLD_AXIS)))

    def loss(weights: Weights) -> tuple[Array, Any]:
        seeds = agents.replace(stats=copy(agents.stats)).as_policy(weights), copy(config)
        state, memory, records = rollout_seeds(
            env, initial_state, act_fn, record, seeds, copy(agents.key), configs[0].n_steps, initial_memory
        )
        records = jax.tree.map(lambda x: x.reshape(x.shape[0], n_seeds, -1, *x.shape[3:]), records)
        last_obs = critic_obs(hold(state.obs, constant), configs[0].critic)
        errors, last_obs = split_blocks((state.info["error"], last_obs), n_seeds)
        args = agents, config, records, errors, last_obs, iterations
        losses, metrics = for_each_seed(compute_loss, *args, axes=(0, 0, 1, 0, 0, 0))
        return losses.sum(), (losses, metrics, state, memory, records, last_obs)

    (_, (losses, metrics, state, memory, *samples)), grads = jax.value_and_grad(loss, has_aux=True)(copy(agents.policy))
    grads = jax.tree.map(lambda x: x.reshape(n_seeds, n_copies, *x.shape[1:]).sum(axis=1), grads)
    agents, update_metrics = for_each_seed(
        learn, agents, config, losses, grads, *samples, iterations, axes=(0, 0, 0, 0, 1, 0, 0)
    )
    return Learner(agents, state, memory, learner.iteration + 1), metrics | update_metrics


def hold(obs: Obs, names: Collection[str]) -> Obs:
    """Return observations of which those with these names have no derivative."""
    return {name: jax.lax.stop_gradient(x) if name in names else x for name, x in obs.items()}


def act(
    policy: Policy, config: Config, obs: Obs, memory: Any, key: Array, constant: Collection[str] = ()
) -> tuple[Array, Any, Array]:
    """Return the action of the policy; the observations are kept for the statistics and the value function."""
    del key
    obs = hold(obs, constant)
    return *policy.act(policy_obs(obs, config.critic), memory), critic_obs(obs, config.critic)


def record(policy: Policy, config: Config, step: Step, raw_obs: Array) -> tuple[Array, Array, Array]:
    """Return what loss, statistics, value function and metrics need of a step."""
    del policy
    return raw_obs, step.scaled_reward(config.rewards), step.terminated


def compute_loss(
    agent: Agent, config: Config, records: Any, error: Array, last_obs: Array, iteration: Array
) -> tuple[Array, dict[str, Array]]:
    """Compute the negative mean of the discounted rewards of a rollout and of the value after it, and its metrics."""
    _, rewards, terminated = records
    rewards = rewards.mean(axis=(1, 2))
    discounts = config.discount ** jnp.arange(len(rewards), dtype=rewards.dtype)
    metrics = {"reward": rewards.mean(), "crashed": terminated.mean(axis=1).mean(), "error": jnp.nanmean(error)}
    loss = -(discounts * rewards).mean()
    if config.critic_epochs:
        value = jnp.where(terminated.any(axis=0)[:, None], 0.0, agent.estimate_value(last_obs, config)).mean()
        value = jnp.where(iteration < STATS_ITERATIONS, 0.0, value)  # which has learnt nothing yet
        loss = loss - config.discount ** len(rewards) * value / len(rewards)
    return loss, metrics


def learn(
    agent: Agent, config: Config, loss: Array, grads: Any, records: Any, last_obs: Array, iteration: Array
) -> tuple[Agent, dict[str, Array]]:
    """Update the agent, or keep the policy and its optimiser's state if its gradient is not finite."""
    grad_norm = jnp.sqrt(sum(jnp.sum(jnp.square(x)) for x in jax.tree.leaves(grads)))
    transform = build_optimizer(config.learning_rate, config.max_grad_norm, config.iterations)
    updates, optimizer = transform.update(grads, agent.optimizer, agent.policy)
    updated = optax.apply_updates(agent.policy, updates), optimizer
    policy, optimizer = _where(jnp.isfinite(grad_norm), updated, (agent.policy, agent.optimizer))
    metrics = {"gradient": grad_norm}
    if config.critic_epochs:
        agent, value_metrics = learn_value(agent, config, records, last_obs, iteration)
        metrics |= value_metrics
    # Normalisation that keeps shifting would degrade a policy that is already good, so it is frozen early.
    stats = _where(iteration < STATS_ITERATIONS, agent.stats.update(records[0]), agent.stats)
    finite = all_finite((policy, optimizer, stats, loss, agent.value))
    return agent.replace(policy=policy, optimizer=optimizer, stats=stats), metrics | {"finite": finite}


def learn_value(
    agent: Agent, config: Config, records: Any, last_obs: Array, iteration: Array
) -> tuple[Agent, dict[str, Array]]:
    """Update the value function by the returns of a rollout until its episodes end; the environment goes on."""
    raw_obs, rewards, terminated = records
    done = jnp.broadcast_to(terminated[..., None], rewards.shape)
    is_flying = jnp.cumsum(done, axis=0) - done == 0
    values, last_value = (agent.estimate_value(x, config) for x in (raw_obs, last_obs))
    _, targets = estimate_advantages((rewards, values, done), last_value, config)
    returns = agent.returns.update(targets[..., None])
    targets = (targets - returns.mean) / return_std(returns)
    value = rescale_value(agent.value, agent.returns, returns)
    inputs = critic_input(agent.stats.normalize(raw_obs), config.critic)

    def value_loss(value: Weights, minibatch: Any) -> tuple[Array, dict[str, Array]]:
        inputs, targets, is_flying = minibatch
        output, _ = forward(agent.critic_network, value, inputs, ())
        loss = 0.5 * (is_flying * jnp.square(output[..., 0] - targets)).mean()
        return loss, {"value_error": loss}

    key, samples = jax.random.fold_in(agent.key, iteration), (inputs, targets, is_flying)
    value, optimizer, metrics = run_epochs(value_loss, value, agent.value_optimizer, samples, config, key)
    return agent.replace(value=value, value_optimizer=optimizer, returns=returns), metrics


def _where(condition: Array, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), new, old)
