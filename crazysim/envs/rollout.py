"""Many steps of an environment in one compiled call, carrying from one to the next only what it needs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jax import Array

from crazysim.envs.env import Env, EnvState


def rollout(
    env: Env,
    state: EnvState,
    act: Callable[[EnvState, Array], Array],
    key: Array,
    n_steps: int,
    keep: Callable[[EnvState], Any] = lambda state: (state.reward, state.done),
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

    def step(carry: EnvState, key: Array) -> tuple[EnvState, Any]:
        after = env.step(carry, act(carry, key))
        return bare(after), keep(after)

    return jax.lax.scan(step, bare(state), jax.random.split(key, n_steps))


def bare(state: EnvState) -> EnvState:
    """Return a state without what no step reads: reward and info."""
    return state.replace(reward=None, info={})
