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
from crazysim.envs.random import check_key
from crazysim.envs.rollout import Transition, rollout
from crazysim.envs.state import TERM_PREFIX, Obs, terms_of
from crazysim.envs.wrappers import RewardTerms
from crazysim.train.interface import check_policy
from crazysim.train.policies import MultiPolicy, act, as_tree, initial_memory

EVALUATION_SEED = 0x5EED
"""Seed of the held-out initial states. Training keys are made with ``fold_in``, so they differ from the key of this
seed."""


def held_out_key() -> Array:
    return jax.random.key(EVALUATION_SEED)


@partial(jax.jit, static_argnames=("env", "n_blocks"))
def fly_episodes(env: Env, policy: Any, key: Array, n_blocks: int = 1) -> dict[str, Array]:
    """Fly one episode in every world, and return errors, rewards and ends by name.

    Args:
        env: Environment without automatic resets.
        policy: Policy of all worlds.
        key: Random key of the initial states.
        n_blocks: Number of blocks of worlds, of equal size. All blocks begin from the same initial states.

    Returns:
        ``error``: task error after every step, constant after the end of the episode (n_steps, n_worlds, n_drones);
        ``over``: True once the episode has terminated (n_steps, n_worlds);
        ``nonfinite``: True where the episode terminated because the world became non-finite (n_worlds,);
        ``reward``: return of the episode (n_worlds, n_drones);
        ``terms``: terms of the reward by name, means over the worlds and drones of a block, zero after the end of an
        episode (n_steps, n_blocks) each;
        ``succeeded``: True where the episode satisfied ``task.succeeded``; only for tasks that define it (n_worlds,
        n_drones);
        ``outcomes``: entries of the task's info that are True or False, by name, True where they were so at any time
        (n_worlds, n_drones) each.
    """
    env = RewardTerms(env)
    state = env.reset(jnp.broadcast_to(key, (n_blocks,)))

    def fly_step(obs: Obs, memory: Any, key: Array) -> tuple[Array, Any, Any]:
        del key
        return *act(policy, obs, memory), ()

    def record_transition(transition: Transition) -> dict[str, Any]:
        state = transition.state
        values = {
            name: state.info[name]
            for name in state.info
            if name in ("error", "nonfinite") or name.startswith(TERM_PREFIX)
        }
        outcomes = {name: x for name, x in state.info.items() if name != "nonfinite" and x.dtype == bool}
        values["outcomes"] = {name: x for name, x in outcomes.items() if x.shape == state.reward.shape}
        return values | {"reward": state.reward, "terminated": state.terminated, "succeeded": env.succeeded(state)}

    _, _, history = rollout(env, state, fly_step, key, env.max_steps, record_transition, initial_memory(policy, env))
    is_over = jnp.cumsum(history["terminated"], axis=0) > 0
    was_over = jnp.concatenate([jnp.zeros_like(is_over[:1]), is_over[:-1]])
    is_flying = ~was_over[..., None]
    last_step = jnp.minimum(jnp.arange(env.max_steps)[:, None], was_over.shape[0] - was_over.sum(axis=0) - 1)[..., None]

    def split_blocks(x: Array) -> Array:
        # (n_steps, n_worlds, n_drones) -> (n_steps, n_blocks, n_worlds / n_blocks, n_drones)
        return x.reshape(x.shape[0], n_blocks, -1, x.shape[-1])

    flight = {
        "error": jnp.take_along_axis(history["error"], last_step, axis=0),
        "over": is_over,
        "nonfinite": jnp.any(history["nonfinite"] & ~was_over, axis=0),
        "reward": jnp.where(is_flying, history["reward"], 0.0).sum(axis=0),
        "terms": {
            name: split_blocks(jnp.where(is_flying, x, 0.0)).mean(axis=(2, 3)) for name, x in terms_of(history).items()
        },
    }
    succeeded = history["succeeded"]
    flight["outcomes"] = {name: jnp.any(x & is_flying, axis=0) for name, x in history["outcomes"].items()}
    return flight if succeeded is None else flight | {"succeeded": jnp.any(succeeded & is_flying, axis=0)}


def evaluate(env: Env, policy: Callable[[Obs], Array], key: Array | None = None) -> dict[str, float]:
    """Evaluate a policy: its success rate, its crash rate, its mean error and its mean return.

    A drone succeeds if its error stays below ``task.tolerance`` for the last ``task.hold`` seconds of the episode. If
    the task defines ``succeeded``, this criterion replaces the tolerance.

    Args:
        env: Environment without automatic resets; each world flies from one initial state.
        policy: Trained policy, or any function from observations to actions.
        key: Random key of the initial states; None for the held-out ones.

    Returns:
        ``success``: fraction of drones that succeed;
        ``crashed``: fraction of ``crashed_drones``; the others that did not succeed were late, or had too large an
        error at the end;
        ``nonfinite``: fraction of worlds that became non-finite;
        ``length``: mean length of an episode, s;
        ``error``: mean error of the worlds that did not crash, in ``task.unit``, over the last ``task.hold`` seconds,
        or at the end of the episode if the task defines ``succeeded``; NaN if there is none;
        ``reward``: mean return of an episode;
        ``reward NAME``: contribution of each term to the mean return.
    """
    check_policy(policy, env)
    check_key(held_out_key() if key is None else key)
    return evaluate_blocks(env, as_tree(policy), key)[0]


def evaluate_each(env: Env, policy: MultiPolicy, key: Array | None = None) -> list[dict[str, float]]:
    """Evaluate the policies of several drones that fly together, each over its own drones.

    Args:
        env: Environment without automatic resets; each world flies from one initial state.
        key: Random key of the initial states; None for the held-out ones.

    Returns:
        For each policy ``success`` and ``reward`` as of ``evaluate``, and the share of its drones for which an outcome
        of the task came true, such as ``won``, ``collided`` or ``disabled`` in ``head_to_head``.
    """
    check_policy(policy, env)
    key = held_out_key() if key is None else key
    check_key(key)
    flight = jax.device_get(fly_episodes(env, policy, key))
    who = np.asarray(policy.of_drones(env.sim.n_worlds, env.sim.n_drones))
    values = {"success": _succeeded(env, flight), "reward": flight["reward"], **flight["outcomes"]}
    return [{name: float(x[who == i].mean()) for name, x in values.items()} for i in range(len(policy.members))]


def evaluate_blocks(env: Env, policy: Any, key: Array | None = None, n_blocks: int = 1) -> list[dict[str, float]]:
    """Return the metrics of ``evaluate`` for each block of worlds; all blocks begin from the same initial states.

    Args:
        env: Environment without automatic resets; each world flies from one initial state.
        policy: Policy of all worlds, such as ``Policies``.
        key: Random key of the initial states; None for the held-out ones.
    """
    key = held_out_key() if key is None else key
    # Computing the metrics on the host takes less time than compiling them would.
    flight = jax.device_get(fly_episodes(env, policy, key, n_blocks))
    n_worlds = env.sim.n_worlds // n_blocks
    return [_metrics(env, flight, i, slice(i * n_worlds, (i + 1) * n_worlds)) for i in range(n_blocks)]


def _n_final_steps(env: Env, flight: dict[str, Any]) -> int:
    return 1 if "succeeded" in flight else max(round(env.task.hold * env.max_steps / env.task.seconds), 1)


def _succeeded(env: Env, flight: dict[str, Any]) -> np.ndarray:
    if "succeeded" in flight:
        return flight["succeeded"]
    error = flight["error"][-_n_final_steps(env, flight) :]
    return np.all(error < env.task.tolerance, axis=0) & ~flight["over"][-1][:, None]


def crashed_drones(env: Env, flight: dict[str, Any]) -> np.ndarray:
    """Return which drones had not arrived when their episode was terminated, from ``fly_episodes``.

    A drone has arrived that succeeded, or reached the first of the task's ``outcomes``, which may be too late to
    succeed. (n_worlds, n_drones)
    """
    arrived = flight["outcomes"].get(getattr(env.task, "outcomes", ("",))[0], False)
    return flight["over"][-1][:, None] & ~_succeeded(env, flight) & ~np.asarray(arrived)


def _metrics(env: Env, flight: dict[str, Any], block: int, worlds: slice) -> dict[str, float]:
    over_by_step, succeeded = flight["over"][:, worlds], _succeeded(env, flight)[worlds]
    n_steps = 1 + (~over_by_step[:-1]).sum(axis=0)
    error = flight["error"][-_n_final_steps(env, flight) :, worlds]
    crashed = crashed_drones(env, flight)[worlds]
    error = error[:, ~np.any(crashed, axis=-1)]
    error = error[~np.isnan(error)]
    return {
        "success": float(succeeded.mean()),
        "crashed": float(crashed.mean()),
        "nonfinite": float(flight["nonfinite"][worlds].mean()),
        "length": float(n_steps.mean()) * env.task.seconds / env.max_steps,
        "error": float(error.mean()) if error.size else float("nan"),
        "reward": float(flight["reward"][worlds].mean()),
        **{f"{TERM_PREFIX}{name}": float(x[:, block].sum()) for name, x in flight["terms"].items()},
    }


def describe_flight(metrics: Mapping[str, float], unit: str) -> str:
    """Return success, outcome, return and its terms as text; arguments as of ``describe_outcome``."""
    terms = ", ".join(f"{name} {x:.4g}" for name, x in terms_of(metrics).items())
    return (
        f"success {metrics['success']:.1%}, {describe_outcome(metrics, unit)}, mean return {metrics['reward']:.4g} "
        f"({terms})"
    )


def describe_outcome(metrics: Mapping[str, float], unit: str) -> str:
    """Return the error and the crashes in the metrics of ``evaluate`` as text, with the reason for a missing error.

    Args:
        metrics: Metrics, from ``evaluate``.
        unit: Unit of the error, ``task.unit``.
    """
    late = max(1 - metrics["success"] - metrics["crashed"], 0.0)
    crashed = f"crashed {metrics['crashed']:.1%}, late or outside {late:.1%}"
    if metrics["nonfinite"]:
        crashed += f" (of all worlds {metrics['nonfinite']:.1%} became non-finite)"
    if not math.isnan(metrics["error"]):
        of_others = " of those that did not crash" if metrics["crashed"] else ""
        return f"mean error {metrics['error']:.4f} {unit}{of_others}, {crashed}"
    if metrics["crashed"] == 1:
        return f"{crashed}, on average after {metrics['length']:.2f} s, so there is no mean error"
    return f"no drone with a task error, {crashed}"
