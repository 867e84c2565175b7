"""Adapter from environments to the interface of Brax, for its training algorithms. Brax itself is not required."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.arguments import check_arguments, check_array
from crazysim.engine.pytree import PyTree
from crazysim.envs.env import Env
from crazysim.envs.state import EnvState, Obs, flatten
from crazysim.envs.wrappers import AutoReset
from crazysim.errors import expect, require


class State(PyTree):
    """Brax's ``State``, for all worlds at once."""

    pipeline_state: EnvState
    """State of the environment."""
    obs: Array
    """Observations: drone after drone, and for each drone concatenated by ``flatten``. (n_worlds, observation_size)"""
    reward: Array
    """Mean reward of the drones. (n_worlds,)"""
    done: Array
    """One where the episode ended in this step, zero elsewhere, as a float. (n_worlds,)"""
    metrics: dict[str, Array]
    """``error``: mean task error of the drones. (n_worlds,)"""
    info: dict[str, Any]
    """Entries that Brax's algorithms read: ``steps``, ``truncation``, ``episode_done``, ``episode_metrics``."""


class BraxEnv:
    """Brax's interface to a functional environment that has no automatic resets.

    Brax batches an environment of one world with ``vmap``. Here the worlds are batched already, so this class
    corresponds to an environment after Brax's ``training.wrap``. Keys, observations and actions have an axis over
    worlds. Episodes also end at their time limit, and the step that ends an episode also starts the next episode.
    ``info`` has the entries that Brax's wrappers add.

    Pass it to an algorithm with ``wrap_env=False`` and ``num_envs`` equal to the number of worlds. Pass another
    ``BraxEnv`` with ``num_eval_envs`` worlds as ``eval_env``.
    """

    @check_arguments
    def __init__(self, env: Env):
        self.env = AutoReset(env)
        self.sim = env.sim
        shapes = jax.eval_shape(env.reset, jax.random.key(0))
        self._action_shape = shapes.action.shape
        self._n_obs = sum(x.shape[1] * x.shape[2] for x in shapes.obs.values())

    @property
    def observation_size(self) -> int:
        """Size of the observation of a world."""
        return self._n_obs

    @property
    def action_size(self) -> int:
        """Size of the action of a world, for all of its drones together."""
        return self._action_shape[1] * self._action_shape[2]

    @property
    def backend(self) -> str:
        """Name of the physics backend."""
        return "crazysim"

    @property
    def unwrapped(self) -> BraxEnv:
        """This object: it has no wrappers of Brax."""
        return self

    @property
    def dt(self) -> float:
        """Duration of an environment step, s."""
        return self.env.task.seconds / self.env.max_steps

    def explain(self) -> str:
        """Explain how a step is executed, as ``Env.explain`` does."""
        return self.env.explain()

    def reset(self, rng: Array) -> State:
        """Start an episode in all worlds.

        Args:
            rng: A random key, or one key per world as Brax passes them; typed keys or raw key data. Only the first key
                is used. It seeds all worlds, and each world draws its own numbers.
        """
        state = self.env.reset(self._seed_key(rng))
        zeros = jnp.zeros(self.sim.n_worlds, state.reward.dtype)
        metrics = {"error": self._mean_over_drones(state.info["error"])}
        episode_metrics = {"sum_reward": zeros, "length": zeros} | dict.fromkeys(metrics, zeros)
        info = {"steps": zeros, "truncation": zeros, "episode_done": zeros, "episode_metrics": episode_metrics}
        return State(state, self._flatten_obs(state.obs), zeros, zeros, metrics, info)

    def step(self, state: State, action: Array) -> State:
        """Advance all worlds by one environment step.

        Args:
            action: Action in [-1, 1], drone after drone. (n_worlds, action_size)
        """
        check_array("action", action)
        shape = (self.sim.n_worlds, self.action_size)
        require(
            np.shape(action) == shape,
            f"expected an action of shape {shape} = (n_worlds, action_size), got {np.shape(action)}. The worlds "
            f"are batched already: leave out vmap and Brax's wrappers (wrap_env=False).",
            ValueError,
        )
        env_state = self.env.step(state.pipeline_state, jnp.reshape(jnp.asarray(action), self._action_shape))
        dtype = state.reward.dtype
        done, reward = env_state.done.astype(dtype), self._mean_over_drones(env_state.reward)
        metrics = {"error": self._mean_over_drones(env_state.info["error"])}
        was_running = 1 - state.done
        increments = {"sum_reward": reward, "length": jnp.ones_like(reward)} | metrics
        sums = state.info["episode_metrics"]
        info = {
            "steps": state.info["steps"] * was_running + 1,
            "truncation": (env_state.truncated & ~env_state.terminated).astype(dtype),
            "episode_done": done,
            "episode_metrics": {name: sums[name] * was_running + x for name, x in increments.items()},
        }
        return state.replace(
            pipeline_state=env_state,
            obs=self._flatten_obs(env_state.obs),
            reward=reward,
            done=done,
            metrics=state.metrics | metrics,
            info=state.info | info,
        )

    def _seed_key(self, rng: Array) -> Array:
        expect(hasattr(rng, "dtype"), "a random key", rng, "Use jax.random.key(0).")
        n_worlds, is_typed = self.sim.n_worlds, jnp.issubdtype(rng.dtype, jax.dtypes.prng_key)
        shape = rng.shape if is_typed else rng.shape[:-1]
        require(
            shape in ((), (n_worlds,)),
            f"expected one key, or one for each of the {n_worlds} worlds, got "
            f"{'keys' if is_typed else 'key data'} of shape {rng.shape}. Make the environment with n_worlds "
            f"equal to Brax's num_envs.",
            ValueError,
        )
        rng = rng if is_typed else jax.random.wrap_key_data(rng)
        return rng[0] if shape else rng

    @staticmethod
    def _mean_over_drones(x: Array) -> Array:
        return jnp.mean(x, axis=1)

    def _flatten_obs(self, obs: Obs) -> Array:
        return flatten(obs).reshape(self.sim.n_worlds, -1)
