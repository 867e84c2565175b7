"""Many steps of an environment in one compiled call, carrying from one to the next only what it needs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jax import Array

from crazysim.envs.env import Env, EnvState
from crazysim.envs.fused_step import WholeStep
from crazysim.envs.wrappers import AutoReset

Act = Callable[[EnvState, Array], Array]
"""State and random key to what all drones do. (n_worlds, n_drones, k)"""
Keep = Callable[[EnvState], Any]
"""State after a step to what is kept of it: any tree of arrays."""


def rollout(
    env: Env,
    state: EnvState,
    act: Act,
    key: Array,
    n_steps: int,
    keep: Keep = lambda state: (state.reward, state.done),
) -> tuple[EnvState, Any]:
    """Return the state some steps later, and what was kept on the way; pure, for jit and grad.

    Args:
        env: The environment, usually with ``AutoReset`` around it.
        state: Where it begins.
        act: ``act(state, key)``: what all drones do, (n_worlds, n_drones, k). Of the state it sees data, observations,
            and what wrappers remember, but not the last reward and info.
        key: Random key, of which each step is given one of its own.
        n_steps: How many steps.
        keep: What is kept of the state after each step.

    Returns:
        The state, without reward and info, and what was kept with time in front, (n_steps, ...): rewards and ends if
        nothing else is asked for.
    """
    start = bare(state)
    keys = jax.random.split(key, n_steps)
    whole = env.whole(start, start.action, laid=True) if isinstance(env, AutoReset) else None
    if isinstance(whole, WholeStep):
        return _laid(whole, start, act, keys, keep)

    def step(carry: EnvState, key: Array) -> tuple[EnvState, Any]:
        after = env.step(carry, act(carry, key))
        return bare(after), keep(after)

    return jax.lax.scan(step, start, keys)


def _laid(whole: WholeStep, start: EnvState, act: Act, keys: Array, keep: Keep) -> tuple[EnvState, Any]:
    """Do the same in rows, which no step takes apart."""
    first = whole.lay(start)

    def step(carry: tuple[list[Array], dict[str, Any]], key: Array) -> tuple[Any, Any]:
        laid, before = first._replace(rows=carry[0]), seen(carry)
        laid, told = whole.advance(laid, (before.terminated, before.truncated), act(before, key))
        after = whole.unlay(laid, start)
        after = told.replace(data=after.data, action=after.action, memory=after.memory)
        return (laid.rows, {name: getattr(after, name) for name in ("obs", "terminated", "truncated")}), keep(after)

    def seen(carry: tuple[list[Array], dict[str, Any]]) -> EnvState:
        return whole.unlay(first._replace(rows=carry[0]), start).replace(**carry[1])

    told = {"obs": start.obs, "terminated": start.terminated, "truncated": start.truncated}
    carry, kept = jax.lax.scan(step, (first.rows, told), keys)
    return seen(carry), kept


def bare(state: EnvState) -> EnvState:
    """Return a state without what no step reads: reward and info."""
    return state.replace(reward=None, info={})
