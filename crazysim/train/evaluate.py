"""How good a policy is, judged by flights from starts that it has not trained on."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.envs.env import Env
from crazysim.pytree import PyTree, static
from crazysim.train.networks import QUICK

HELD_OUT = 0x5EED
"""Seed of the starts that policies are judged by; training seeds are folded away from it."""


class _Fixed(PyTree):
    """A policy that is a function of its own, and nothing to be traced."""

    fn: Callable[[Any], Array] = static()
    """Observations to actions."""

    def __call__(self, obs: Any) -> Array:
        """Return the actions."""
        return self.fn(obs)


@partial(jax.jit, static_argnames=("env",), compiler_options=QUICK)
def fly(env: Env, policy: Any, key: Array) -> dict[str, Array]:
    """Return what one episode of every world gives.

    Returns:
        ``error`` at the end of every step (n_steps, n_worlds, n_drones), that of the last where an episode is over;
        ``over``, whether an episode had ended by then because of what happened (n_steps, n_worlds); ``reward`` summed
        up to that, and ``succeeded``, whether a task that tells had been done by then (n_worlds, n_drones).
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
    flown = {"error": error, "over": over, "reward": total}
    return flown if env.succeeded(state) is None else flown | {"succeeded": done}


def evaluate(env: Env, policy: Callable[[Any], Array], key: Array | None = None) -> dict[str, float]:
    """Return how often a policy succeeds: the error stays below the task's tolerance to the episode's end.

    A task that tells when it is done, ``task.succeeded``, is done if it was by the end of the episode.

    Args:
        env: The environment, without automatic resets; each world is one start.
        policy: Observations to actions: what training gave, or any function.
        key: Of the starts; None for those that are held out.

    Returns:
        ``success`` (share of drones), ``crashed`` (share of worlds that ended before their time and not all of whose
        drones succeeded), ``error`` (mean over the last ``task.hold`` seconds of what did not crash, m; at the
        end alone of a task that tells when it is done), ``reward`` (mean sum of an episode).
    """
    flown = fly(
        env, policy if isinstance(policy, PyTree) else _Fixed(policy), jax.random.key(HELD_OUT) if key is None else key
    )
    last = max(round(env.task.hold * env.max_steps / env.task.seconds), 1)
    over = flown["over"][-1]
    settled = jnp.all(flown["error"][-last:] < env.task.tolerance, axis=0) & ~over[:, None]
    if "succeeded" in flown:
        last, settled = 1, flown["succeeded"]
    crashed = over & ~jnp.all(settled, axis=-1)
    error = jnp.where(crashed[None, :, None], jnp.nan, flown["error"][-last:])
    return {
        "success": float(settled.mean()),
        "crashed": float(crashed.mean()),
        "error": float(jnp.nanmean(error)),
        "reward": float(flown["reward"].mean()),
    }
