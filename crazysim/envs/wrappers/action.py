"""Wrappers that change actions."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from crazysim.core.settings import positive_integer
from crazysim.engine.pytree import PyTree, leaf
from crazysim.envs.env import Env
from crazysim.envs.state import EnvState
from crazysim.envs.wrappers.base import Wrapper


class ActionQueue(PyTree):
    """Memory of ``ActionDelay``."""

    actions: Array = leaf("drone", 2)
    """The n actions that have not arrived yet, the oldest first. (n_worlds, n_drones, n, k)"""


MAX_FRAMES = 1000
"""Largest number of environment steps that a wrapper keeps; its memory is copied in every step."""


class ActionDelay(Wrapper):
    """Delay actions by ``n`` environment steps; the first ``n`` actions of an episode are zero, by default hover."""

    def __init__(self, env: Env, n: int):
        super().__init__(env)
        self.n = positive_integer("n", n, MAX_FRAMES)

    def after_reset(self, state: EnvState) -> EnvState:
        n_drones, size = state.action.shape
        return self.remember(state, ActionQueue(jnp.zeros((n_drones, self.n, size), state.action.dtype)))

    def before_step(self, state: EnvState, action: Array) -> tuple[EnvState, Array]:
        queue = self.recall(state).actions
        actions = jnp.concatenate([queue, action[:, None]], axis=1)
        return self.remember(state, ActionQueue(actions[:, 1:])), actions[:, 0]
