"""Environments for Stable-Baselines3: a ``VecEnv`` of all worlds, with NumPy arrays."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from crazysim.arguments import check_arguments
from crazysim.envs.env import Env
from crazysim.envs.random import as_seed, read_options
from crazysim.envs.rendering import Renderer
from crazysim.envs.state import NO_EPISODE, EnvState, Obs, check_actions, flatten
from crazysim.envs.wrappers import AutoReset, EpisodeStatistics
from crazysim.errors import ConfigError, require

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise ImportError(
        "crazysim.envs.sb3 needs stable-baselines3, which is not installed. Run pip install stable-baselines3."
    ) from error


class DroneVecEnv(VecEnv):
    """Vector environment of Stable-Baselines3 over a functional environment; each world is one sub-environment.

    A new episode starts within the step that ends an episode. The info of a world has entries in such a step only:

    - ``terminal_observation`` and ``TimeLimit.truncated``, as ``DummyVecEnv`` adds them;
    - ``episode`` with ``r``, ``l`` and ``t``, as ``Monitor`` adds it;
    - ``error``, the task error at the end, and ``nonfinite``, which is True if the world became non-finite.

    With several drones, reward and error are means over the drones. Observations and actions are concatenated, drone
    after drone.
    """

    @check_arguments
    def __init__(
        self,
        env: Env,
        dict_obs: bool = False,
        render_mode: str | None = None,
        render_worlds: Sequence[int] = (0,),
        render_size: tuple[int, int] = (640, 480),
    ):
        self.env, self.sim, self.dict_obs = AutoReset(EpisodeStatistics(env)), env.sim, dict_obs
        self._renderer = Renderer(env, render_mode, render_worlds, render_size)
        self._reset_fn, self._step_fn = jax.jit(self._reset_state), jax.jit(self._step_state)
        self._generator, _ = gymnasium.utils.seeding.np_random()
        self._actions: np.ndarray | None = None
        self._start_time = time.time()
        self.state: EnvState | None = None
        _, obs = self._reset_fn.eval_shape(jax.random.key(0))  # ``reset`` reuses this trace
        spaces: dict[str, gymnasium.Space] = {
            name: gymnasium.spaces.Box(-np.inf, np.inf, x.shape[1:], np.float32) for name, x in obs.items()
        }
        size = env.sim.n_drones * env.actions.size
        super().__init__(
            env.sim.n_worlds,
            gymnasium.spaces.Dict(spaces) if dict_obs else spaces["all"],
            gymnasium.spaces.Box(-1.0, 1.0, (size,), np.float32),
        )

    def reset(self) -> Any:
        """Start new episodes in all worlds and return their observations.

        The first reset after ``seed(seed)`` uses that seed. Later resets use random seeds from a generator that was
        initialised with it.
        """
        seed = as_seed(self._seeds[0])
        key_seed = seed if seed is not None else int(self._generator.integers(2**31))
        if seed is not None:
            self._generator, _ = gymnasium.utils.seeding.np_random(seed)
        for options in self._options:
            read_options(options)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._actions, self._start_time = None, time.time()
        self.state, obs = self._reset_fn(jax.random.key(key_seed))
        return self._to_numpy(jax.device_get(obs))

    def step_async(self, actions: ArrayLike) -> None:
        """Store the actions for the next step. (num_envs, n_drones * k)"""
        require(self.state is not None, NO_EPISODE)
        self._actions = check_actions(actions, (self.num_envs, *(self.action_space.shape or ())))

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Advance all worlds; return observations, rewards, flags that are True where an episode ended, and infos."""
        require(self._actions is not None, "expected actions before step_wait(), got none. Call step(actions).")
        self.state, arrays = self._step_fn(self.state, self._actions)
        self._actions = None
        obs, final_obs, reward, done, episode_results = jax.device_get(arrays)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for world in np.flatnonzero(done):
            world_final_obs = {name: x[world] for name, x in final_obs.items()}
            infos[world] = {
                "terminal_observation": self._to_numpy(world_final_obs),
                "TimeLimit.truncated": bool(episode_results["out_of_time"][world]),
                "episode": {
                    "r": float(episode_results["return"][world]),
                    "l": int(episode_results["length"][world]),
                    "t": round(time.time() - self._start_time, 6),
                },
                "error": float(episode_results["error"][world]),
                "nonfinite": bool(episode_results["nonfinite"][world]),
            }
        return self._to_numpy(obs), np.array(reward), np.array(done), infos

    def get_attr(self, attr_name: str, indices: ArrayLike | None = None) -> list[Any]:
        """Return an attribute of the functional environment, repeated for each world."""
        value = self._renderer.mode if attr_name == "render_mode" else getattr(self.env, attr_name)
        return [value] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: ArrayLike | None = None) -> None:
        """Raise an error, because all worlds are one compiled program."""
        raise ConfigError(f"cannot set {attr_name!r}: all worlds are one compiled program. Make another environment.")

    def env_method(self, method_name: str, *args: Any, indices: ArrayLike | None = None, **kwargs: Any) -> list[Any]:
        """Call ``render``, the only method that is supported."""
        require(
            method_name == "render" and not args and not kwargs,
            f"expected method 'render' without arguments, got {method_name!r}: all worlds are one compiled program",
        )
        return list(self.get_images())

    def env_is_wrapped(self, wrapper_class: type, indices: ArrayLike | None = None) -> list[bool]:
        """Return True for ``Monitor``, because infos have its entries; False for other wrappers. One flag per world."""
        return [wrapper_class.__name__ == "Monitor"] * len(list(self._get_indices(indices)))

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return an image (height, width, 3) of each of ``render_worlds``, or draw the first of them into a window.

        Raises:
            RenderError: If this machine cannot render.
        """
        return self._renderer(self.state)

    def explain(self) -> str:
        """Return how a step is executed, as ``Env.explain`` does."""
        return self.env.explain()

    def close(self) -> None:
        """Close the window, free the renderers, and end the episodes."""
        self.state = self._actions = None
        self.sim.close()

    def _reset_state(self, key: Array) -> tuple[EnvState, Obs]:
        state = self.env.reset(key)
        return state, self._merge_obs(state.obs)

    def _step_state(self, state: EnvState, actions: Array) -> tuple[EnvState, Any]:
        state = self.env.step(state, actions.reshape(state.action.shape))
        info = state.info
        episode_results = {
            "out_of_time": state.truncated & ~state.terminated,
            "return": info["episode_return"].mean(axis=1),
            "length": info["episode_length"],
            "error": info["error"].mean(axis=1),
            "nonfinite": info["nonfinite"],
        }
        results = (
            self._merge_obs(state.obs),
            self._merge_obs(info["final_obs"]),
            state.reward.mean(axis=1),
            state.done,
            episode_results,
        )
        return state, results

    def _merge_obs(self, obs: Obs) -> Obs:
        if not self.dict_obs:
            obs = {"all": flatten(obs)}
        return {name: x.reshape(x.shape[0], -1).astype(jnp.float32) for name, x in obs.items()}

    def _to_numpy(self, obs: dict[str, Any]) -> Any:
        return {name: np.array(x) for name, x in obs.items()} if self.dict_obs else np.array(obs["all"])
