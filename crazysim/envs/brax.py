"""Environments with Brax's interface, as its training algorithms take them. Nothing of Brax is needed, or imported."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.envs.env import Env
from crazysim.envs.state import EnvState, Obs, flatten
from crazysim.envs.wrappers import AutoReset
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree


class State(PyTree):
    """Brax's ``State``, of all worlds at once."""

    pipeline_state: EnvState
    """The environment behind it."""
    obs: Array
    """Observations by name, one behind the other, drone after drone. (n_worlds, observation_size)"""
    reward: Array
    """Mean of the drones' rewards. (n_worlds,)"""
    done: Array
    """One where an episode ended with the step, zero elsewhere, as a float. (n_worlds,)"""
    metrics: dict[str, Array]
    """``error``: mean of the drones' errors. (n_worlds,) each"""
    info: dict[str, Any]
    """What Brax's algorithms ask for: ``steps``, ``truncation``, ``episode_done``, ``episode_metrics``."""


class BraxEnv:
    """Brax's interface to a functional environment: ``reset(rng) -> State``, ``step(state, action) -> State``.

    Brax writes an environment for one world, and batches it with ``vmap``. Here the worlds are batched already, and so
    this is what Brax's ``training.wrap`` makes of an environment, not what goes into it: keys, observations and actions
    have an axis of worlds, episodes end when their time is over, a new one begins within the step that ends one, and
    ``info`` has what the wrappers put there. Give it to an algorithm with ``wrap_env=False``, with ``num_envs`` as many
    as there are worlds, and another one of ``num_eval_envs`` worlds as ``eval_env``.
    """

    def __init__(self, env: Env):
        """Take the functional environment, without automatic resets.

        Raises:
            ConfigError: If it begins episodes by itself.
        """
        if isinstance(env, AutoReset):
            raise ConfigError("give the environment without AutoReset: Brax's episodes begin as its wrappers have it")
        self.env = AutoReset(env)
        self.sim = env.sim
        shapes = jax.eval_shape(env.reset, jax.random.key(0))
        self._action_shape = shapes.action.shape
        self._n_obs = sum(x.shape[1] * x.shape[2] for x in shapes.obs.values())

    @property
    def observation_size(self) -> int:
        """Numbers that are observed of a world."""
        return self._n_obs

    @property
    def action_size(self) -> int:
        """Numbers in the action of a world: of all its drones."""
        return self._action_shape[1] * self._action_shape[2]

    @property
    def backend(self) -> str:
        """What the physics is computed by."""
        return "crazysim"

    @property
    def unwrapped(self) -> BraxEnv:
        """The environment itself."""
        return self

    @property
    def dt(self) -> float:
        """Length of a step, s."""
        return self.env.task.seconds / self.env.max_steps

    def reset(self, rng: Array) -> State:
        """Return all worlds at the beginning of an episode.

        Args:
            rng: A key, or one for each world as Brax gives them, typed or not. The first one seeds all worlds, each of
                which draws its own numbers.

        Raises:
            ValueError: If it is neither.
        """
        state = self.env.reset(self._key(rng))
        zeros = jnp.zeros(self.sim.n_worlds, state.reward.dtype)
        metrics = {"error": self._mean(state.info["error"])}
        episode = {"sum_reward": zeros, "length": zeros} | dict.fromkeys(metrics, zeros)
        info = {"steps": zeros, "truncation": zeros, "episode_done": zeros, "episode_metrics": episode}
        return State(state, self._flat(state.obs), zeros, zeros, metrics, info)

    def step(self, state: State, action: Array) -> State:
        """Return all worlds one step later.

        Args:
            state: Where all worlds are.
            action: Within [-1, 1], drone after drone. (n_worlds, action_size)

        Raises:
            ValueError: If the action has another shape.
        """
        needed = (self.sim.n_worlds, self.action_size)
        if jnp.shape(action) != needed:
            raise ValueError(
                f"action has shape {jnp.shape(action)}; needed is {needed} = (n_worlds, action_size): the worlds are "
                f"batched already, so leave vmap and Brax's wrappers out (wrap_env=False)"
            )
        inner = self.env.step(state.pipeline_state, jnp.reshape(action, self._action_shape))
        dtype = state.reward.dtype
        done, reward = inner.done.astype(dtype), self._mean(inner.reward)
        metrics = {"error": self._mean(inner.info["error"])}
        goes_on = 1 - state.done
        told = {"sum_reward": reward, "length": jnp.ones_like(reward)} | metrics
        before = state.info["episode_metrics"]
        info = {
            "steps": state.info["steps"] * goes_on + 1,
            "truncation": (inner.truncated & ~inner.terminated).astype(dtype),
            "episode_done": done,
            "episode_metrics": {name: before[name] * goes_on + x for name, x in told.items()},
        }
        return state.replace(
            pipeline_state=inner,
            obs=self._flat(inner.obs),
            reward=reward,
            done=done,
            metrics=state.metrics | metrics,
            info=state.info | info,
        )

    def _key(self, rng: Array) -> Array:
        """Return the one key that all worlds are seeded with."""
        n_worlds, typed = self.sim.n_worlds, jnp.issubdtype(rng.dtype, jax.dtypes.prng_key)
        shape = rng.shape if typed else rng.shape[:-1]
        if shape not in ((), (n_worlds,)):
            raise ValueError(
                f"rng is {'keys' if typed else 'key data'} of shape {rng.shape}; needed is one key, or one for each of "
                f"the {n_worlds} worlds of this environment: make it with n_worlds as many as Brax's num_envs"
            )
        rng = rng if typed else jax.random.wrap_key_data(rng)
        return rng[0] if shape else rng

    @staticmethod
    def _mean(x: Array) -> Array:
        return jnp.mean(x, axis=1)

    def _flat(self, obs: Obs) -> Array:
        return flatten(obs).reshape(self.sim.n_worlds, -1)
