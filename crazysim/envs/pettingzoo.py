"""One world of several drones as a parallel environment of PettingZoo's, each drone an agent."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.envs.env import Env
from crazysim.envs.registry import make
from crazysim.envs.rendering import RENDER_MODES, Renderer
from crazysim.envs.state import EnvState, flatten
from crazysim.envs.wrappers import AutoReset
from crazysim.errors import ConfigError, UnknownNameError

try:
    from pettingzoo import ParallelEnv
except ImportError as error:
    raise ImportError("crazysim.envs.pettingzoo needs PettingZoo; pip install 'crazysim[pettingzoo]'") from error


class DroneParallelEnv(ParallelEnv):
    """PettingZoo's parallel interface to a functional environment of one world.

    Agents are ``drone_0``, ``drone_1`` and so on, and an episode ends for all of them at once. Observations are named,
    (k,) each; actions are (k,) within [-1, 1]; all are NumPy arrays, and every drone has a reward of its own.
    """

    def __init__(self, env: Env, render_mode: str | None = None, render_size: tuple[int, int] = (640, 480)):
        """Take the functional environment.

        Args:
            env: An environment of one world, without automatic resets.
            render_mode: What ``render`` does: ``"rgb_array"`` returns a picture, ``"human"`` draws into a window.
            render_size: Width and height of a picture, pixels.

        Raises:
            ConfigError: If it has several worlds, or begins episodes by itself, or there is no such mode.
        """
        if env.sim.n_worlds != 1:
            raise ConfigError(
                f"PettingZoo knows one world, and this environment has {env.sim.n_worlds}: make it with n_worlds=1, or "
                f"use crazysim.envs.DroneVectorEnv"
            )
        if isinstance(env, AutoReset):
            raise ConfigError("PettingZoo's users reset by themselves: give the environment without AutoReset")
        self.env, self.sim, self.render_mode = env, env.sim, render_mode
        self._renderer = Renderer(env.sim, render_mode, size=render_size)
        self.metadata = {
            "name": f"crazysim/{env.task.name}",
            "render_modes": list(RENDER_MODES),
            "render_fps": round(env.max_steps / env.task.seconds),
            "is_parallelizable": True,
        }
        self.possible_agents = [f"drone_{i}" for i in range(env.sim.n_drones)]
        self.agents: list[str] = []
        self.now: EnvState | None = None
        self._reset, self._step = jax.jit(env.reset), jax.jit(self._advance)
        self._generator, _ = gymnasium.utils.seeding.np_random()
        shapes = jax.eval_shape(env.reset, jax.random.key(0))
        self.observation_spaces = {
            agent: gymnasium.spaces.Dict({k: _box(x.shape[2:], np.inf, x.dtype) for k, x in shapes.obs.items()})
            for agent in self.possible_agents
        }
        action = shapes.action
        self.action_spaces = {agent: _box(action.shape[2:], 1.0, action.dtype) for agent in self.possible_agents}
        size = sum(x.shape[1] * x.shape[2] for x in shapes.obs.values())
        self.state_space = _box((size,), np.inf, action.dtype)

    def observation_space(self, agent: str) -> gymnasium.Space:
        """Return what an agent observes, the same object at every call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.Space:
        """Return what an agent may do, the same object at every call."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: Of all that is random; None to go on from what was drawn before, at first from the system.
            options: PettingZoo's; there are none here, and what is given is not looked at.
        """
        del options
        if seed is not None:
            self._generator, _ = gymnasium.utils.seeding.np_random(seed)
        number = seed if seed is not None else int(self._generator.integers(2**31))
        self.now = self._reset(jax.random.key(number))
        self.agents = list(self.possible_agents)
        obs, info = jax.device_get((self.now.obs, self.now.info))
        return self._of_agents(obs), self._of_agents(info)

    def step(self, actions: Mapping[str, Any]) -> tuple[dict[str, Any], ...]:
        """Advance the world by one action of every drone.

        Returns:
            Observations, rewards, terminations, truncations and infos, by agent.

        Raises:
            ConfigError: If no episode is going on, an action is missing or not finite.
            UnknownNameError: If there is no such agent.
            ValueError: If an action has another shape.
        """
        if self.now is None or not self.agents:
            raise ConfigError("no episode is going on: call reset() first")
        self.now, out = self._step(self.now, self._together(actions))
        obs, reward, terminated, truncated, info = jax.device_get(out)
        if self.render_mode == "human":
            self.render()
        agents, self.agents = self.agents, [] if terminated or truncated else self.agents
        return (
            self._of_agents(obs),
            {agent: float(r) for agent, r in zip(agents, reward, strict=True)},
            dict.fromkeys(agents, bool(terminated)),
            dict.fromkeys(agents, bool(truncated)),
            self._of_agents(info),
        )

    def state(self) -> np.ndarray:
        """Return what all drones observe in one vector: the first drone's observations by name, then the next one's.

        Raises:
            ConfigError: If there was no reset.
        """
        if self.now is None:
            raise ConfigError("there is no state before the first reset(): call it first")
        return np.array(flatten(self.now.obs)).ravel()

    def render(self) -> np.ndarray | None:
        """Draw the world: a picture (height, width, 3), or into a window.

        Raises:
            ConfigError: If nothing was said of drawing when the environment was made, or it was not reset.
            RenderError: If this machine cannot draw.
        """
        pictures = self._renderer(self.now)
        return pictures[0] if pictures else None

    def close(self) -> None:
        """Close the window."""
        self.sim.close()

    def _advance(self, state: EnvState, actions: Array) -> tuple[EnvState, Any]:
        state = self.env.step(state, actions[None])
        return state, (state.obs, state.reward[0], state.terminated[0], state.truncated[0], state.info)

    def _together(self, actions: Mapping[str, Any]) -> np.ndarray:
        """Return the actions of all agents as one array, checked. (n_drones, k)"""
        if unknown := set(actions) - set(self.agents):
            raise UnknownNameError(
                f"there is no agent {', '.join(sorted(unknown))}; there are {', '.join(self.agents)}"
            )
        if missing := [agent for agent in self.agents if agent not in actions]:
            raise ConfigError(f"there is no action for {', '.join(missing)}; every drone needs one")
        shape = self.action_spaces[self.agents[0]].shape
        rows = [np.asarray(actions[agent], np.float32) for agent in self.agents]
        for agent, row in zip(self.agents, rows, strict=True):
            if row.shape != shape:
                raise ValueError(f"the action of {agent} has shape {row.shape}; needed is {shape}")
            if not np.isfinite(row).all():
                raise ConfigError(f"the action of {agent} is NaN or infinite")
        return np.stack(rows)

    def _of_agents(self, tree: Any) -> dict[str, Any]:
        """Return for each agent what is its own, (1, n_drones, ...), and what the world has as a whole, (1,)."""

        def own(x: Any, i: int) -> Any:
            # A copy: what comes from JAX cannot be written to.
            return (x[0, i] if x.ndim > 1 else x[0]).copy()

        return {agent: jax.tree.map(lambda x, i=i: own(x, i), tree) for i, agent in enumerate(self.possible_agents)}


def make_parallel(task: str, render_mode: str | None = None, **options: Any) -> DroneParallelEnv:
    """Return one world of a task for PettingZoo.

    Args:
        task: One of ``crazysim.envs.TASKS``.
        render_mode: What ``render`` does.
        options: As for ``crazysim.envs.make``; ``n_drones`` above all.
    """
    return DroneParallelEnv(make(task, 1, **options), render_mode)


def _box(shape: tuple[int, ...], limit: float, dtype: Any) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-limit, limit, shape, jnp.dtype(dtype))
