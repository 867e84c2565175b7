"""Analytic policy gradients: the return of a short horizon is differentiated through the simulator."""

from __future__ import annotations

from collections.abc import Sequence
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
from crazysim.plugins.sensors.image_sensor import OUTPUTS
from crazysim.train.convolution import images_of
from crazysim.train.hyperparameters import check_hyperparameters
from crazysim.train.networks import Network, Policy, Weights, choose_network, init_weights
from crazysim.train.optimizer import all_finite, build_optimizer
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
"""Number of iterations at the start during which the observation statistics are updated."""


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
    """Channels of the layers of a convolution over each image, as in PPO. The gradient passes through the image."""
    learning_rate: float = 3e-3
    """Initial learning rate of Adam, annealed linearly to zero."""
    discount: float = 0.99
    """Discount factor per environment step."""
    max_grad_norm: float = 1.0
    """Largest global norm of a gradient; larger ones are scaled down to it."""

    def __post_init__(self) -> None:
        check_hyperparameters(self)


class Agent(PyTree):
    """Network, optimiser and statistics of one seed; in a ``Learner``, the arrays of all seeds are stacked."""

    policy: Any
    """``Weights`` from normalised observations to the action before tanh."""
    optimizer: optax.OptState
    """State of the optimiser."""
    stats: RunningStats
    """Mean and variance with which observations are normalised."""
    key: Array
    """Random key. ()"""
    network: Network = static()
    """Network of the policy."""


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
        return Policy(self.agents.stats, self.agents.policy.layers, self.agents.policy.body, self.agents.network)


def init(env: Env, configs: Sequence[Config], keys: Array) -> Learner:
    """Return an untrained learner.

    Args:
        env: Environment without automatic resets, with a block of worlds for each seed.
        configs: Hyperparameters of each seed; only ``SWEEPABLE`` ones may differ between seeds.
        keys: Random keys of the seeds. (n_seeds,)
    """
    constant = [name for name, x in env.image_formats().items() if OUTPUTS[x["output"]].dtype is not None]
    require(
        not constant,
        f"expected images whose gradients are not zero, got {', '.join(constant)}. Use outputs=('depth',) of the "
        f"camera, or algorithm='ppo'.",
    )
    config = configs[0]
    k_policy, k_env, k_agent = split_keys(keys, 3)
    state = env.reset(k_env)
    images = images_of(env, state.obs) if config.convolution else ()
    network = choose_network(config.memory, None, config.convolution, images, config.shape)
    hidden = config.hidden if network.is_built_in else ()

    def init_agent(k_policy: Array, key: Array, obs: Array) -> Agent:
        policy: Any = init_weights(network, k_policy, obs.shape[-1], (*hidden, env.actions.size), 0.01)
        optimizer = build_optimizer(config.learning_rate, config.max_grad_norm, config.iterations).init(policy)
        return Agent(policy, optimizer, RunningStats.create(obs.shape[-1], network.pixels).update(obs), key, network)

    obs = split_blocks(flatten(state.obs), len(configs))
    agents = for_each_seed(init_agent, k_policy, k_agent, obs)
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
    initial_memory = agents.network.make_memory(*learner.env.reward.shape)
    restart = partial(select_worlds, learner.env.done)
    initial_memory = jax.tree.map(restart, initial_memory, learner.memory)
    # On several devices each has a copy of the policy for its worlds. They sum the gradients of the copies once, after
    # all steps; with a single policy they would sum its gradients in every step.
    n_copies = 1 if mesh is None or are_seeds_divided(n_seeds, mesh) else mesh.size

    def copy(tree: T) -> T:
        if mesh is None or n_copies == 1:
            return tree
        copies = jax.tree.map(lambda x: jnp.repeat(x, n_copies, axis=0), tree)
        return jax.lax.with_sharding_constraint(copies, NamedSharding(mesh, PartitionSpec(WORLD_AXIS)))

    def loss(weights: Weights) -> tuple[Array, Any]:
        copies = Policy(copy(agents.stats), weights.layers, weights.body, agents.network)
        state, memory, records = rollout_seeds(
            env, initial_state, act, record, (copies,), copy(agents.key), configs[0].n_steps, initial_memory
        )
        records = jax.tree.map(lambda x: x.reshape(x.shape[0], n_seeds, -1, *x.shape[3:]), records)
        errors = split_blocks(state.info["error"], n_seeds)
        losses, metrics = for_each_seed(compute_loss, config, records, errors, axes=(0, 1, 0))
        return losses.sum(), (losses, metrics, state, memory, records[0])

    (_, (losses, metrics, state, memory, raw_obs)), grads = jax.value_and_grad(loss, has_aux=True)(copy(agents.policy))
    grads = jax.tree.map(lambda x: x.reshape(n_seeds, n_copies, *x.shape[1:]).sum(axis=1), grads)
    is_early = jnp.broadcast_to(learner.iteration < STATS_ITERATIONS, n_seeds)
    agents, update_metrics = for_each_seed(
        learn, agents, config, losses, grads, raw_obs, is_early, axes=(0, 0, 0, 0, 1, 0)
    )
    return Learner(agents, state, memory, learner.iteration + 1), metrics | update_metrics


def act(policy: Policy, obs: Obs, memory: Any, key: Array) -> tuple[Array, Any, Array]:
    """Return the action of the policy; the observations are kept for the statistics."""
    del key
    return *policy.act(obs, memory), flatten(obs)


def record(policy: Policy, step: Step, raw_obs: Array) -> tuple[Array, Array, Array]:
    """Return what loss, statistics and metrics need of a step."""
    del policy
    return raw_obs, step.reward, step.terminated


def compute_loss(config: Config, records: Any, error: Array) -> tuple[Array, dict[str, Array]]:
    """Compute the negative mean of the discounted rewards of a rollout, and its metrics."""
    _, rewards, terminated = records
    rewards = rewards.mean(axis=(1, 2))
    discounts = config.discount ** jnp.arange(len(rewards), dtype=rewards.dtype)
    metrics = {"reward": rewards.mean(), "crashed": terminated.mean(axis=1).mean(), "error": jnp.nanmean(error)}
    return -(discounts * rewards).mean(), metrics


def learn(
    agent: Agent, config: Config, loss: Array, grads: Any, raw_obs: Array, is_early: Array
) -> tuple[Agent, dict[str, Array]]:
    """Update the agent, or keep its weights and its optimiser state if the gradient is not finite."""
    grad_norm = jnp.sqrt(sum(jnp.sum(jnp.square(x)) for x in jax.tree.leaves(grads)))
    transform = build_optimizer(config.learning_rate, config.max_grad_norm, config.iterations)
    updates, optimizer = transform.update(grads, agent.optimizer, agent.policy)
    updated = optax.apply_updates(agent.policy, updates), optimizer
    policy, optimizer = _where(jnp.isfinite(grad_norm), updated, (agent.policy, agent.optimizer))
    # Normalisation that keeps shifting would degrade a policy that is already good, so it is frozen early.
    stats = _where(is_early, agent.stats.update(raw_obs), agent.stats)
    finite = all_finite((policy, optimizer, stats, loss))
    return agent.replace(policy=policy, optimizer=optimizer, stats=stats), {"gradient": grad_norm, "finite": finite}


def _where(condition: Array, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), new, old)
