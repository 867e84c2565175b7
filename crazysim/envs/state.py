"""State of an environment, of all worlds or of one, and checks of actions."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.core.data import SimData
from crazysim.envs.actions import Actions
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree, leaf

Obs = dict[str, Array]
"""Named observations. (n_worlds, n_drones, k) each, or (n_drones, k) in one world"""


class EnvState(PyTree):
    """An environment at one moment: argument and result of ``step``.

    Functions of one world, those of tasks and wrappers, receive it without the axis of worlds.
    """

    data: SimData
    """The simulation."""
    obs: Obs = leaf("drone", 1)
    """Observations passed to the policy. (n_worlds, n_drones, k) each"""
    reward: Array = leaf("drone")
    """Reward of the step that led here. (n_worlds, n_drones)"""
    terminated: Array = leaf("batched")
    """True where the episode ended by success or failure. (n_worlds,)"""
    truncated: Array = leaf("batched")
    """True where the episode reached its time limit. (n_worlds,)"""
    action: Array = leaf("drone", 1)
    """Action of the step that led here; zero at the start of an episode. (n_worlds, n_drones, k)"""
    info: dict[str, Any] = leaf("batched")
    """Further quantities by name. (n_worlds,) or (n_worlds, n_drones, ...) each"""
    memory: dict[str, Any] = leaf("batched")
    """State of the wrappers, by name of the wrapper. (n_worlds, ...) each; those of records have their declared axes"""

    @property
    def done(self) -> Array:
        """True where the episode is over. (n_worlds,)"""
        return self.terminated | self.truncated


def state_of_data(data: SimData) -> EnvState:
    """Return a state that has data only, from which an episode begins."""
    return EnvState(data, {}, None, None, None, None, {}, {})  # type: ignore[arg-type]


def bare(state: EnvState) -> EnvState:
    """Return a state without reward and info, which no step reads."""
    return state.replace(reward=None, info={})


def flatten(obs: Obs) -> Array:
    """Return named observations concatenated in alphabetical order of their names. (..., n_obs)"""
    return jnp.concatenate([obs[name] for name in sorted(obs)], axis=-1)


def check_actions(actions: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """Return actions of the host for all worlds, checked. (n_worlds, ...)

    Raises:
        ConfigError: If they are not finite, with the first few worlds where.
        ValueError: If they have another shape.
    """
    actions = np.asarray(actions, np.float32)
    if actions.shape != shape:
        raise ValueError(f"expected actions of shape {shape}, got {actions.shape}")
    if not np.all(np.isfinite(actions)):
        worlds = np.unique(np.nonzero(~np.isfinite(actions))[0])[:8]
        raise ConfigError(f"expected finite actions, got NaN or infinity in world(s) {worlds.tolist()}")
    return actions


def validate_action(action: Array, state: EnvState, actions: Actions) -> Array:
    """Return an action in the type of the state's.

    Raises:
        ValueError: If it has another shape.
    """
    if jnp.shape(action) != state.action.shape:
        raise ValueError(
            f"expected an action of shape {state.action.shape} = (n_worlds, n_drones, {actions.size}), got "
            f"{jnp.shape(action)}. Actions of this environment: {actions}"
        )
    return jnp.asarray(action, state.action.dtype)
