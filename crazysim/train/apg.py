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

from crazysim.core.sharding import WORLD_AXIS
from crazysim.envs.env import Env
from crazysim.envs.rollout import Transition, rollout
from crazysim.envs.state import EnvState, Obs, flatten
from crazysim.envs.statistics import RunningStats
from crazysim.pytree import PyTree
from crazysim.train.hyperparameters import check_hyperparameters
from crazysim.train.networks import Layers, Policies, Policy, all_finite, init_mlp
from crazysim.train.optimizer import build_optimizer
from crazysim.train.seeds import SweptValues, are_seeds_divided, for_each_seed, split_blocks, stack_swept_values

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


class Agent(PyTree):
    """Network, optimiser and statistics of one seed; in a ``Learner``, the arrays of all seeds are stacked."""

    policy: Layers
    """Network from normalised observations to the action before tanh."""
    optimizer: optax.OptState
    """State of the optimiser."""
    stats: RunningStats
    """Mean and variance with which observations are normalised."""
    key: Array
    """Random key. ()"""


class Learner(PyTree):
    """Complete state of a training run; saving and loading it resumes the run bit for bit."""

    agents: Agent
    """The agents of all seeds. (n_seeds, ...) each"""
    env: EnvState
    """State of the environments at the end of the last iteration: a block of worlds for each seed, of equal size."""
    iteration: Array
    """Number of completed iterations. ()"""

    def as_policy(self) -> Policy:
        """Return the policies of all seeds. (n_seeds, ...) each"""
        return Policy(self.agents.stats, self.agents.policy)


def init(env: Env, configs: Sequence[Config], keys: Array) -> Learner:
    """Return an untrained learner.

    Args:
        env: Environment without automatic resets, with a block of worlds for each seed.
        configs: Hyperparameters of each seed; only ``SWEEPABLE`` ones may differ between seeds.
        keys: Random keys of the seeds. (n_seeds,)
    """
    config = configs[0]
    k_policy, k_env, k_agent = jnp.moveaxis(for_each_seed(lambda key: jax.random.split(key, 3), keys), 1, 0)
    state = env.reset(k_env)

    def init_agent(k_policy: Array, key: Array, obs: Array) -> Agent:
        policy = init_mlp(k_policy, (obs.shape[-1], *config.hidden, env.actions.size), 0.01)
        optimizer = build_optimizer(config.learning_rate, config.max_grad_norm, config.iterations).init(policy)
        return Agent(policy, optimizer, RunningStats.create(obs.shape[-1]).update(obs), key)

    obs = split_blocks(flatten(state.obs), len(configs))
    return Learner(for_each_seed(init_agent, k_policy, k_agent, obs), state, jnp.int32(0))


@partial(jax.jit, static_argnames=("env", "configs"))
def iterate(learner: Learner, env: Env, configs: tuple[Config, ...]) -> tuple[Learner, dict[str, Array]]:
    """Return the learner after one rollout and one update, and the metrics of the iteration. (n_seeds,) each

    The metric ``gradient`` is the norm of the gradient before it is limited; ``finite`` is True if weights, optimiser
    state, statistics and loss are finite. The rollout starts where
    the previous rollout ended; worlds in which the episode is over start a new episode. A seed with a non-finite
    gradient keeps its weights and optimiser state. The scan stores its intermediates instead of recomputing them under
    ``jax.checkpoint``: tens of steps fit in memory.
    """
    initial_state = env.restart(learner.env, learner.env.done)
    agents, swept_values, config = learner.agents, stack_swept_values(configs), configs[0]
    split_seeds = partial(split_blocks, n_seeds=len(configs))
    n_copies = _count_policy_copies(env, len(configs))

    def loss(policies: Layers) -> tuple[Array, Any]:
        """Return the sum of the losses of all seeds. Its gradient is the stack of the gradients of all copies."""
        seed_policies = Policies(Policy(_copy_per_device(agents.stats, n_copies, env), policies))

        def act(obs: Obs, memory: Any, key: Array) -> tuple[Array, Any, Any]:
            del key
            return seed_policies(obs), memory, ()

        def record_transition(transition: Transition) -> Any:
            reward, raw_obs, terminated = split_seeds(
                (transition.reward, flatten(transition.obs), transition.terminated)
            )
            return reward, raw_obs, terminated

        state, _, (rewards, raw_obs, crashed) = rollout(
            env, initial_state, act, agents.key, config.n_steps, record_transition
        )
        discounts = swept_values["discount"] ** jnp.arange(config.n_steps, dtype=rewards.dtype)[:, None]
        error = jnp.nanmean(split_seeds(state.info["error"]), axis=(1, 2))
        rewards, crashed = rewards.mean(axis=(2, 3)), crashed.mean(axis=2)
        metrics = {"reward": rewards.mean(axis=0), "crashed": crashed.mean(axis=0), "error": error}
        losses = -(discounts * rewards).mean(axis=0)
        return losses.sum(), (losses, state, raw_obs, metrics)

    def update(
        agent: Agent, loss: Array, grads: Layers, raw_obs: Array, swept_values: SweptValues
    ) -> tuple[Agent, dict[str, Array]]:
        grad_norm = jnp.sqrt(sum(jnp.sum(jnp.square(x)) for x in jax.tree.leaves(grads)))
        transform = build_optimizer(swept_values["learning_rate"], swept_values["max_grad_norm"], config.iterations)
        updates, optimizer = transform.update(grads, agent.optimizer, agent.policy)
        updated_state = (optax.apply_updates(agent.policy, updates), optimizer)
        policy, optimizer = jax.tree.map(
            lambda x, old: jnp.where(jnp.isfinite(grad_norm), x, old), updated_state, (agent.policy, agent.optimizer)
        )
        # Normalisation that keeps shifting would degrade a policy that is already good, so it is frozen early.
        updated_stats, is_updating_stats = agent.stats.update(raw_obs), learner.iteration < STATS_ITERATIONS
        stats = jax.tree.map(lambda x, old: jnp.where(is_updating_stats, x, old), updated_stats, agent.stats)
        finite = all_finite((policy, optimizer, stats, loss))
        return Agent(policy, optimizer, stats, agent.key), {"gradient": grad_norm, "finite": finite}

    policies = _copy_per_device(agents.policy, n_copies, env)
    (_, (losses, state, raw_obs, metrics)), grads = jax.value_and_grad(loss, has_aux=True)(policies)
    if n_copies > 1:
        grads = jax.tree.map(lambda x: x.reshape(-1, n_copies, *x.shape[1:]).sum(axis=1), grads)
    agents, update_metrics = for_each_seed(update, agents, losses, grads, raw_obs, swept_values, axes=(0, 0, 0, 1, 0))
    return Learner(agents, state, learner.iteration + 1), metrics | update_metrics


def _count_policy_copies(env: Env, n_seeds: int) -> int:
    """Return the number of copies of each seed's policy. Each copy controls worlds of one device.

    The devices sum the gradients of the copies once, after all steps. With a single policy they would sum its gradients
    in every step.
    """
    mesh = env.sim.mesh
    return 1 if mesh is None or are_seeds_divided(n_seeds, mesh) else mesh.size


def _copy_per_device(tree: T, n_copies: int, env: Env) -> T:
    """Return copies of the arrays of each seed, on the devices that use them. (n_seeds * n_copies, ...) each"""
    mesh = env.sim.mesh
    if mesh is None or n_copies == 1:
        return tree
    device_sharding = NamedSharding(mesh, PartitionSpec(WORLD_AXIS))
    return jax.lax.with_sharding_constraint(
        jax.tree.map(lambda x: jnp.repeat(x, n_copies, axis=0), tree), device_sharding
    )
