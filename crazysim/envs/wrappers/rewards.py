"""Wrappers that add returns and terms of rewards to ``info``."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.engine.pytree import PyTree, leaf
from crazysim.envs.env import Env
from crazysim.envs.state import EnvState
from crazysim.envs.wrappers.base import Wrapper


class EpisodeSums(PyTree):
    """Memory of ``EpisodeStatistics``."""

    reward: Array = leaf("drone")
    """Sum of the rewards of the episode. (n_worlds, n_drones)"""
    length: Array = leaf("world")
    """Number of steps of the episode. (n_worlds, 1)"""


class LastAction(PyTree):
    """Memory of ``RewardTerms``."""

    action: Array = leaf("drone", 1)
    """Action of the last step. (n_worlds, n_drones, k)"""


class EpisodeStatistics(Wrapper):
    """Add return and length of episodes that end: ``info["episode_return"]``, ``info["episode_length"]``.

    Return and length are zero in worlds where the episode continues.
    """

    def after_reset(self, state: EnvState) -> EnvState:
        return self._store(state, EpisodeSums(jnp.zeros_like(state.reward), jnp.zeros((), jnp.int32)))

    def after_step(self, state: EnvState) -> EnvState:
        sums = self.recall(state)
        return self._store(state, EpisodeSums(sums.reward + state.reward, sums.length + 1))

    def _store(self, state: EnvState, sums: EpisodeSums) -> EnvState:
        def zero_outside(mask: Array, x: Array) -> Array:
            return jnp.where(mask, x, jnp.zeros((), x.dtype))

        final_sums: Any = jax.tree.map(lambda x: zero_outside(state.done, x), sums)
        running_sums = jax.tree.map(lambda x: zero_outside(~state.done, x), sums)
        info = {"episode_return": final_sums.reward, "episode_length": final_sums.length}
        return self.remember(state, running_sums, info=state.info | info)


class RewardTerms(Wrapper):
    """Add the terms of the reward by name: ``info["reward proximity"]`` and so on. (n_worlds, n_drones) each"""

    def __init__(self, env: Env):
        super().__init__(env)
        self.batched = env.task.batched

    def after_reset(self, state: EnvState) -> EnvState:
        shapes = jax.eval_shape(self.task.rewards, state.data, state.action, state.action)
        terms = {f"reward {name}": jnp.zeros(x.shape, state.reward.dtype) for name, x in shapes.items()}
        return self.remember(state, LastAction(state.action), info=state.info | terms)

    def after_step(self, state: EnvState) -> EnvState:
        terms = self.task.rewards(state.data, state.action, self.recall(state).action)
        nonfinite, dtype = state.data.core.nonfinite, state.reward.dtype
        info = {
            f"reward {k}": jnp.where(nonfinite, jnp.zeros((), dtype), jnp.asarray(x, dtype)) for k, x in terms.items()
        }
        return self.remember(state, LastAction(state.action), info=state.info | info)
