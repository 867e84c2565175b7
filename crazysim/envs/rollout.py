"""Many steps of an environment in one compiled call, which carries the memory of the policy from step to step."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.arguments import check_arguments
from crazysim.core.settings import positive_integer
from crazysim.engine.jaxcompat import is_key
from crazysim.engine.pytree import PyTree, select_worlds
from crazysim.engine.record import MAX_STEPS
from crazysim.engine.step import FlatData, scan
from crazysim.envs.env import Env
from crazysim.envs.random import check_key
from crazysim.envs.state import EnvState, Obs
from crazysim.errors import ConfigError, expect, require
from crazysim.sim.rollout import require_memory_of_records

Policy = Callable[[Obs, Any, Array], tuple[Array, Any, Any]]
"""``policy(obs, memory, key) -> (action, memory, extras)``, for all worlds at once. ``memory`` is the state that the
policy keeps between steps, (n_worlds, ...) each, or ``()``; ``key`` is one random key, or as many keys as ``rollout``
got; ``action`` has the actions of all drones, (n_worlds, n_drones, k); ``extras`` is any tree of arrays, for
``Transition.extras``."""


class Transition(PyTree):
    """One step of all worlds; only the arrays that ``keep`` returns are stored."""

    obs: Obs
    """Observations passed to the policy. (n_worlds, n_drones, k) each"""
    action: Array
    """Actions of the policy. (n_worlds, n_drones, k)"""
    extras: Any
    """Third result of the policy."""
    state: EnvState
    """State after the step, in which a new episode may have begun."""

    @property
    def reward(self) -> Array:
        """Rewards. (n_worlds, n_drones)"""
        return self.state.reward

    @property
    def terminated(self) -> Array:
        """Whether the episode ended by success or failure. (n_worlds,)"""
        return self.state.terminated

    @property
    def truncated(self) -> Array:
        """Whether the episode reached its time limit. (n_worlds,)"""
        return self.state.truncated

    @property
    def done(self) -> Array:
        """Whether the episode is over. (n_worlds,)"""
        return self.state.done

    @property
    def final_obs(self) -> Obs:
        """Observations at the end of the step, before a new episode begins. (n_worlds, n_drones, k) each"""
        return self.state.final_obs


KeepFunction = Callable[[Transition], Any]
"""``keep(transition)``: the part of a transition to store, any tree of arrays."""


@check_arguments
def rollout(
    env: Env,
    state: EnvState,
    policy: Policy,
    key: Array,
    n_steps: int,
    keep: KeepFunction = lambda transition: (transition.reward, transition.done),
    initial_memory: Any = (),
    memory: Any = None,
) -> tuple[EnvState, Any, Any]:
    """Run a policy for ``n_steps`` steps in one ``jax.lax.scan``. The function is pure and works with jit and grad.

    Args:
        env: The environment, usually inside ``AutoReset``.
        policy: The policy, for all worlds at once.
        key: Random key, or several. Each step receives the same number of new keys. () or (n_keys,)
        keep: ``keep(transition)``: the part of each transition to return; reward and ``done`` by default.
        initial_memory: Memory of the policy at the start of an episode; ``()`` for none. (n_worlds, ...) each
        memory: Memory of the policy before the first step, as another rollout returned it; None for ``initial_memory``.

    Returns:
        The state and the memory after the last step, and the results of ``keep``, stacked over time, (n_steps, ...).
    """
    n_steps = positive_integer("n_steps", n_steps)
    require(n_steps <= MAX_STEPS, f"expected n_steps of at most {MAX_STEPS}, got {n_steps}. Use several rollouts.")
    check_key(key)
    memory = initial_memory if memory is None else memory
    flat = env.flatten(state)
    if env.reset_policy is not None:
        n_worlds = state.reward.shape[0]
        if shapes := [jnp.shape(x) for x in jax.tree.leaves(initial_memory) if jnp.shape(x)[:1] != (n_worlds,)]:
            raise ConfigError(
                f"expected initial_memory of shape ({n_worlds}, ...) = (n_worlds, ...), got {shapes[0]}. Use "
                f"jnp.broadcast_to(x, (n_worlds, *x.shape))."
            )
        require(
            _formats(memory) == _formats(initial_memory),
            f"expected a memory of the shapes and types of initial_memory, {_formats(initial_memory)}, got "
            f"{_formats(memory)}. Use the memory that a rollout of the same policy returned.",
        )

    def step(flat: FlatData, memory: Any, key: Array) -> tuple[FlatData, Any, Any]:
        state = EnvState(flat.data())
        action, memory, extras = _evaluate(policy, state.obs, memory, key)
        flat_after = env.advance(flat, action)
        new_state = EnvState(flat_after.data())
        if env.reset_policy is not None:  # the policy forgets where a new episode begins
            must_reset = env.reset_policy.must_reset(state.done, new_state)
            memory = jax.tree.map(lambda initial, x: select_worlds(must_reset, initial, x), initial_memory, memory)
        return flat_after, memory, keep(Transition(state.obs, action, extras, new_state))

    if n_steps > 100_000:  # a step is traced once more for it
        require_memory_of_records(env.step_fn, n_steps, (key, jax.eval_shape(step, flat, memory, key)[2]))
    split_key = partial(jax.random.split, num=n_steps)
    keys = jax.vmap(split_key, out_axes=1)(key) if is_key(key) and key.ndim else split_key(key)
    flat, memory, outputs = scan(step, flat, memory, keys)
    return EnvState(flat.data()), memory, outputs


def _evaluate(policy: Policy, obs: Obs, memory: Any, key: Array) -> tuple[Array, Any, Any]:
    results = policy(obs, memory, key)
    expect(
        isinstance(results, (tuple, list)) and len(results) == 3,
        "a policy that returns (action, memory, extras)",
        results,
        "A policy without memory returns (action, memory, ()) with the memory that it receives.",
    )
    require(
        _formats(memory) == _formats(results[1]),
        f"expected a policy that returns a memory of the shapes and types that it receives, {_formats(memory)}, "
        f"got {_formats(results[1])}. Pass initial_memory= of the shapes that it returns.",
    )
    return results[0], results[1], results[2]


def _formats(tree: Any) -> Any:
    return jax.tree.map(lambda x: (jnp.shape(x), jnp.asarray(x).dtype), tree)
