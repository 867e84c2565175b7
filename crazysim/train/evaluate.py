"""Evaluation of policies on held-out initial states."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.envs.env import Env
from crazysim.pytree import PyTree, static
from crazysim.train.networks import QUICK

HELD_OUT = 0x5EED
"""Seed of the held-out initial states; keys of training are folded, so they never coincide with it."""


class _FunctionPolicy(PyTree):
    """Policy given as a plain function, which is static for JAX."""

    fn: Callable[[Any], Array] = static()
    """Function from observations to actions."""

    def __call__(self, obs: Any) -> Array:
        """Return the actions for observations."""
        return self.fn(obs)


@partial(jax.jit, static_argnames=("env",), compiler_options=QUICK)
def fly(env: Env, policy: Any, key: Array) -> dict[str, Array]:
    """Fly one episode in every world and return its record.

    Returns:
        ``error``: task error after every step, held from the end of the episode on (n_steps, n_worlds, n_drones);
        ``over``: True once the episode has terminated (n_steps, n_worlds); ``reward``: sum over the episode
        (n_worlds, n_drones); ``succeeded``: True where a task with ``task.succeeded`` was completed during the
        episode (n_worlds, n_drones).
    """

    def step(carry: Any, _: None) -> Any:
        state, over, total, error, done = carry
        state = env.step(state, policy(state.obs))
        total = total + jnp.where(over[:, None], 0.0, state.reward)
        error = jnp.where(over[:, None], error, state.info["error"])
        succeeded = env.succeeded(state)
        if succeeded is not None:
            done = done | (succeeded & ~over[:, None])
        over = over | state.terminated
        return (state, over, total, error, done), (error, over)

    state = env.reset(key)
    done = jnp.zeros(state.reward.shape, bool)
    carry = (state, jnp.zeros_like(state.terminated), jnp.zeros_like(state.reward), state.info["error"], done)
    (_, _, total, _, done), (error, over) = jax.lax.scan(step, carry, length=env.max_steps)
    flight = {"error": error, "over": over, "reward": total}
    return flight if env.succeeded(state) is None else flight | {"succeeded": done}


def evaluate(env: Env, policy: Callable[[Any], Array], key: Array | None = None) -> dict[str, float]:
    """Return the success rate of a policy, its crash rate, its mean error and its mean return.

    A drone succeeds if its error stays below ``task.tolerance`` for the last ``task.hold`` seconds of the episode. A
    task with a criterion of its own, ``task.succeeded``, is judged by that instead.

    Args:
        env: Environment without automatic resets; each world flies from one initial state.
        policy: Trained policy, or any function from observations to actions.
        key: Random key of the initial states; None for the held-out ones.

    Returns:
        ``success``: fraction of drones that succeed; ``crashed``: fraction of worlds that terminated although not all
        of their drones had succeeded; ``error``: mean error of the other worlds over the last ``task.hold`` seconds,
        m (at the end of the episode for tasks with ``task.succeeded``); ``reward``: mean return of an episode.
    """
    compiled: Any = policy if isinstance(policy, PyTree) else _FunctionPolicy(policy)
    flight = fly(env, compiled, jax.random.key(HELD_OUT) if key is None else key)
    by_task = "succeeded" in flight
    last = 1 if by_task else max(round(env.task.hold * env.max_steps / env.task.seconds), 1)
    flight = jax.device_get(flight | {"error": flight["error"][-last:], "over": flight["over"][-1]})
    error, over = flight["error"], flight["over"]
    settled = flight["succeeded"] if by_task else np.all(error < env.task.tolerance, axis=0) & ~over[:, None]
    crashed = over & ~np.all(settled, axis=-1)
    error = error[:, ~crashed]
    error = error[~np.isnan(error)]
    return {
        "success": float(settled.mean()),
        "crashed": float(crashed.mean()),
        "error": float(error.mean()) if error.size else float("nan"),
        "reward": float(flight["reward"].mean()),
    }
