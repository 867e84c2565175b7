"""Evaluation of policies on held-out initial states."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.envs.env import Env
from crazysim.envs.state import Obs
from crazysim.envs.wrappers import RewardTerms
from crazysim.pytree import PyTree, static
from crazysim.train.networks import QUICK

HELD_OUT = 0x5EED
"""Seed of the held-out initial states; keys of training are folded, so they never coincide with it."""
TERM = "reward "
"""Beginning of the names of the terms of a reward, as in ``RewardTerms``."""


class _FunctionPolicy(PyTree):
    """Policy given as a plain function, which is static for JAX."""

    fn: Callable[[Obs], Array] = static()
    """Function from observations to actions."""

    def __call__(self, obs: Obs) -> Array:
        """Return the actions for observations."""
        return self.fn(obs)


def as_tree(policy: Callable[[Obs], Array]) -> Any:
    """Return a policy as an argument of compiled functions."""
    return policy if isinstance(policy, PyTree) else _FunctionPolicy(policy)


@partial(jax.jit, static_argnames=("env",), compiler_options=QUICK)
def fly(env: Env, policy: Any, key: Array) -> dict[str, Array]:
    """Fly one episode in every world and return its record.

    Returns:
        ``error``: task error after every step, held from the end of the episode on (n_steps, n_worlds, n_drones);
        ``over``: True once the episode has terminated (n_steps, n_worlds); ``nonfinite``: True where it did so because
        the world became non-finite (n_worlds,); ``reward``: sum over the episode (n_worlds, n_drones); ``terms``: terms
        of the reward by name, means over worlds and drones, zero from the end of an episode on (n_steps,) each;
        ``succeeded``: True where a task with ``task.succeeded`` was completed during the episode (n_worlds, n_drones).
    """
    env = RewardTerms(env)

    def step(carry: Any, _: None) -> Any:
        state, over, lost, total, error, done = carry
        state = env.step(state, policy(state.obs))
        total = total + jnp.where(over[:, None], 0.0, state.reward)
        terms = {k[len(TERM) :]: x for k, x in state.info.items() if k.startswith(TERM)}
        terms = {k: jnp.where(over[:, None], 0.0, x).mean() for k, x in terms.items()}
        error = jnp.where(over[:, None], error, state.info["error"])
        succeeded = env.succeeded(state)
        if succeeded is not None:
            done = done | (succeeded & ~over[:, None])
        lost = lost | (state.info["nonfinite"] & ~over)
        over = over | state.terminated
        return (state, over, lost, total, error, done), (error, over, terms)

    state = env.reset(key)
    done = jnp.zeros(state.reward.shape, bool)
    no = jnp.zeros_like(state.terminated)
    carry = (state, no, no, jnp.zeros_like(state.reward), state.info["error"], done)
    (_, _, lost, total, _, done), (error, over, terms) = jax.lax.scan(step, carry, length=env.max_steps)
    flight = {"error": error, "over": over, "nonfinite": lost, "reward": total, "terms": terms}
    return flight if env.succeeded(state) is None else flight | {"succeeded": done}


def evaluate(env: Env, policy: Callable[[Obs], Array], key: Array | None = None) -> dict[str, float]:
    """Return the success rate of a policy, its crash rate, its mean error and its mean return.

    A drone succeeds if its error stays below ``task.tolerance`` for the last ``task.hold`` seconds of the episode. A
    task with a criterion of its own, ``task.succeeded``, is judged by that instead.

    Args:
        env: Environment without automatic resets; each world flies from one initial state.
        policy: Trained policy, or any function from observations to actions.
        key: Random key of the initial states; None for the held-out ones.

    Returns:
        ``success``: fraction of drones that succeed; ``crashed``: fraction of worlds that terminated although not all
        of their drones had succeeded; ``nonfinite``: fraction of worlds that became non-finite; ``length``: mean
        length of an episode, s; ``error``: mean error of the worlds that did not crash over the last ``task.hold``
        seconds, m (at the end of the episode for tasks with ``task.succeeded``), NaN if all crashed; ``reward``: mean
        return of an episode; ``reward NAME``: part of it by each term.
    """
    flight = fly(env, as_tree(policy), jax.random.key(HELD_OUT) if key is None else key)
    by_task = "succeeded" in flight
    last = 1 if by_task else max(round(env.task.hold * env.max_steps / env.task.seconds), 1)
    flight = jax.device_get(flight)  # the rest takes less time on the host than compiling it
    steps = 1 + (~flight["over"][:-1]).sum(axis=0)
    error, over = flight["error"][-last:], flight["over"][-1]
    settled = flight["succeeded"] if by_task else np.all(error < env.task.tolerance, axis=0) & ~over[:, None]
    crashed = over & ~np.all(settled, axis=-1)
    error = error[:, ~crashed]
    error = error[~np.isnan(error)]
    return {
        "success": float(settled.mean()),
        "crashed": float(crashed.mean()),
        "nonfinite": float(flight["nonfinite"].mean()),
        "length": float(steps.mean()) * env.task.seconds / env.max_steps,
        "error": float(error.mean()) if error.size else float("nan"),
        "reward": float(flight["reward"].mean()),
        **{f"{TERM}{name}": float(x.sum()) for name, x in flight["terms"].items()},
    }


def outcome(metrics: Mapping[str, float], unit: str) -> str:
    """Return the error and the crashes in the metrics of ``evaluate`` as a text, which explains a missing error.

    Args:
        metrics: From ``evaluate``.
        unit: Unit of the error, ``task.unit``.
    """
    crashed = f"crashed {metrics['crashed']:.1%}"
    if metrics["nonfinite"]:
        crashed += f" (of all worlds {metrics['nonfinite']:.1%} became non-finite)"
    if not math.isnan(metrics["error"]):
        return f"mean error {metrics['error']:.4f} {unit}, {crashed}"
    if metrics["crashed"] == 1:
        return f"{crashed}, on average after {metrics['length']:.2f} s, so there is no mean error"
    return f"no drone with a task error, {crashed}"
