"""Analytic policy gradients: the return of a short flight is differentiated through the simulator."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

from crazysim.envs.env import Env
from crazysim.envs.state import EnvState, flatten
from crazysim.envs.statistics import RunningStats
from crazysim.pytree import PyTree
from crazysim.train.networks import QUICK, Layers, Policy, init_mlp


@dataclass(frozen=True)
class Config:
    """Settings of the algorithm."""

    iterations: int = 400
    """Rounds of flying and learning."""
    n_steps: int = 40
    """Environment steps that a gradient looks back over."""
    hidden: tuple[int, ...] = (64, 64)
    """Neurons of the policy."""
    learning_rate: float = 3e-3
    """Of Adam, falling to zero linearly."""
    discount: float = 0.99
    """Weight of a reward one step later."""
    max_grad_norm: float = 1.0
    """Gradients are scaled down to this length."""


class Learner(PyTree):
    """Everything that training changes; saved as it is, it goes on as if it had not stopped."""

    policy: Layers
    """From observations to the action, before tanh."""
    optimizer: Any
    """State of the optimiser."""
    stats: RunningStats
    """What observations are normalised with."""
    key: Array
    """Random key."""
    env: EnvState
    """Where the worlds are."""
    iteration: Array
    """Rounds done. ()"""

    def as_policy(self) -> Policy:
        """Return the policy."""
        return Policy(self.stats, self.policy)


def init(env: Env, config: Config, key: Array) -> Learner:
    """Return a learner that has learnt nothing; ``env`` does not begin new episodes by itself."""
    k_policy, k_env, key = jax.random.split(key, 3)
    state = env.reset(k_env)
    n_obs = flatten(state.obs).shape[-1]
    policy = init_mlp(k_policy, (n_obs, *config.hidden, env.actions.size), 0.01)
    stats = RunningStats.create(n_obs).update(flatten(state.obs))
    return Learner(policy, _optimizer(config).init(policy), stats, key, state, jnp.int32(0))


@partial(jax.jit, static_argnames=("env", "config"), compiler_options=QUICK)
def iterate(learner: Learner, env: Env, config: Config) -> tuple[Learner, dict[str, Array]]:
    """Fly a short way and learn from it; return the learner, and figures of the round.

    A round begins where the last has ended, or with a new episode where that one was over. A gradient that is not
    finite is left out.
    """
    begin = env.restart(learner.env, learner.env.done)

    def loss(policy: Layers) -> tuple[Array, Any]:
        actor = Policy(learner.stats, policy)

        # @jax.checkpoint
        def step(carry: tuple[EnvState, Array], _: None) -> tuple[tuple[EnvState, Array], Any]:
            state, weight = carry
            raw = flatten(state.obs)
            state = env.step(state, actor(state.obs))
            gain = weight * jnp.mean(state.reward)
            return (state, weight * config.discount), (gain, raw, jnp.mean(state.reward), state.terminated.mean())

        carry = (begin, jnp.ones((), begin.reward.dtype))
        (state, _), (gains, raw, reward, crashed) = jax.lax.scan(step, carry, length=config.n_steps)
        figures = {"reward": reward.mean(), "crashed": crashed.mean(), "error": jnp.nanmean(state.info["error"])}
        return -gains.mean(), (state, raw, figures)

    grads, (state, raw, figures) = jax.grad(loss, has_aux=True)(learner.policy)
    norm = jnp.sqrt(sum(jnp.sum(jnp.square(x)) for x in jax.tree.leaves(grads)))
    updates, optimizer = _optimizer(config).update(grads, learner.optimizer, learner.policy)
    new = (optax.apply_updates(learner.policy, updates), optimizer)
    policy, optimizer = jax.tree.map(
        lambda x, old: jnp.where(jnp.isfinite(norm), x, old), new, (learner.policy, learner.optimizer)
    )
    # Inputs that shift under a policy that is already good would spoil it: the statistics are of the first rounds.
    seen = learner.stats.update(raw)
    stats = jax.tree.map(lambda x, old: jnp.where(learner.iteration < 20, x, old), seen, learner.stats)
    learner = Learner(policy, optimizer, stats, learner.key, state, learner.iteration + 1)
    return learner, figures | {"gradient": norm}


def _optimizer(config: Config) -> optax.GradientTransformation:
    schedule = optax.linear_schedule(config.learning_rate, 0.0, config.iterations)
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(schedule))
