"""Many steps of an environment in one compiled call, which carries from step to step only what the next one reads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jax import Array

from crazysim.core.settings import positive
from crazysim.envs.env import Env
from crazysim.envs.fused_step import FusedEnvStep
from crazysim.envs.state import EnvState, bare
from crazysim.envs.wrappers import AutoReset

Act = Callable[[EnvState, Array], Array]
"""State and random key to the actions of all drones. (n_worlds, n_drones, k)"""
Keep = Callable[[EnvState], Any]
"""State after a step to the part of it that is kept: any tree of arrays."""


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
        env: The environment, usually inside ``AutoReset``.
        state: The state at the start.
        act: ``act(state, key)``: actions of all drones, (n_worlds, n_drones, k). The state has data, observations and
            memory, but no reward and info.
        key: Random key; each step receives one of its own.
        n_steps: Number of steps, a positive integer.
        keep: ``keep(state)``: the part of the state after each step to return; rewards and ends by default.

    Returns:
        The state, without reward and info, and what was kept, with time in front. (n_steps, ...)

    Raises:
        ConfigError: If the number of steps is not a positive integer.
    """
    n_steps = positive("n_steps", n_steps)
    start = bare(state)
    keys = jax.random.split(key, n_steps)
    fused = env.fused_step(start, start.action, packed=True) if isinstance(env, AutoReset) else None
    if fused is not None:
        return _packed(fused, start, act, keys, keep)

    def step(carry: EnvState, key: Array) -> tuple[EnvState, Any]:
        after = env.step(carry, act(carry, key))
        return bare(after), keep(after)

    return jax.lax.scan(step, start, keys)


def _packed(fused: FusedEnvStep, start: EnvState, act: Act, keys: Array, keep: Keep) -> tuple[EnvState, Any]:
    """Return the same with states that stay packed between steps."""
    first = fused.pack(start)

    def step(carry: tuple[list[Array], dict[str, Any]], key: Array) -> tuple[Any, Any]:
        packed, before = first._replace(rows=carry[0]), seen(carry)
        packed, outputs = fused.step_packed(packed, (before.terminated, before.truncated), act(before, key))
        after = fused.unpack(packed, start)
        after = outputs.replace(data=after.data, action=after.action, memory=after.memory)
        return (packed.rows, {name: getattr(after, name) for name in ("obs", "terminated", "truncated")}), keep(after)

    def seen(carry: tuple[list[Array], dict[str, Any]]) -> EnvState:
        return fused.unpack(first._replace(rows=carry[0]), start).replace(**carry[1])

    outputs = {"obs": start.obs, "terminated": start.terminated, "truncated": start.truncated}
    carry, kept = jax.lax.scan(step, (first.rows, outputs), keys)
    return seen(carry), kept
