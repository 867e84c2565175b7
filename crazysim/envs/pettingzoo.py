"""One world of several drones as a parallel environment of PettingZoo, where each drone is an agent."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from crazysim.arguments import check_arguments
from crazysim.envs.env import Env
from crazysim.envs.random import as_seed, read_options
from crazysim.envs.registry import make
from crazysim.envs.rendering import RENDER_MODES, Renderer
from crazysim.envs.state import NO_EPISODE, EnvState, flatten
from crazysim.errors import ConfigError, UnknownNameError, expect, optional_import, require
from crazysim.tables import read_floats

with optional_import("crazysim.envs.pettingzoo needs", "pettingzoo", "pettingzoo"):
    from pettingzoo import ParallelEnv


class DroneParallelEnv(ParallelEnv):
    """PettingZoo's parallel interface to a functional environment of one world.

    Agents are ``drone_0``, ``drone_1`` and so on. An episode ends for all agents at once. Each agent has a dict of
    named observations, (k,) each, an action, (k,), within [-1, 1], and its own reward. Observations are NumPy arrays.
    """

    @check_arguments
    def __init__(self, env: Env, render_mode: str | None = None, render_size: tuple[int, int] = (640, 480)):
        require(
            env.sim.n_worlds == 1,
            f"expected an environment of one world, got {env.sim.n_worlds} worlds. Make it with n_worlds=1, or use "
            f"crazysim.envs.DroneVectorEnv.",
        )
        require(
            env.reset_policy is None,
            "expected an environment without AutoReset, got one with it. Call reset() after an episode.",
        )
        self.env, self.sim, self.render_mode = env, env.sim, render_mode
        self._renderer = Renderer(env, render_mode, size=render_size)
        self.metadata = {
            "name": f"crazysim/{env.task.name}",
            "render_modes": list(RENDER_MODES),
            "render_fps": round(env.max_steps / env.task.seconds),
            "is_parallelizable": True,
        }
        self.possible_agents = [f"drone_{i}" for i in range(env.sim.n_drones)]
        self.agents: list[str] = []
        self.env_state: EnvState | None = None
        self._reset, self._step = jax.jit(env.reset), jax.jit(self._advance)
        self._generator, _ = gymnasium.utils.seeding.np_random()
        shapes = self._reset.eval_shape(jax.random.key(0))  # ``reset`` reuses this trace
        self.observation_spaces = {
            agent: gymnasium.spaces.Dict({k: _box(x.shape[2:], np.inf, x.dtype) for k, x in shapes.obs.items()})
            for agent in self.possible_agents
        }
        action = shapes.action
        self.action_spaces = {agent: _box(action.shape[2:], 1.0, action.dtype) for agent in self.possible_agents}
        size = sum(x.shape[1] * x.shape[2] for x in shapes.obs.values())
        self.state_space = _box((size,), np.inf, action.dtype)

    def observation_space(self, agent: str) -> gymnasium.Space:
        """Return the observation space of an agent, the same object at every call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.Space:
        """Return the action space of an agent, the same object at every call."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; return observations and infos by agent.

        Args:
            seed: Seed of all random numbers; None to continue the earlier sequence, or start from the system's entropy.
            options: None; ``options["options"]``, which PettingZoo's ``parallel_api_test`` passes, has no effect.
        """
        read_options(options, "options")
        seed = as_seed(seed)
        if seed is not None:
            self._generator, _ = gymnasium.utils.seeding.np_random(seed)
        key_seed = seed if seed is not None else int(self._generator.integers(2**31))
        self.env_state = self._reset(jax.random.key(key_seed))
        self.agents = list(self.possible_agents)
        obs, info = jax.device_get((self.env_state.obs, self.env_state.info))
        return self._split_by_agent(obs), self._split_by_agent(info)

    def step(self, actions: Mapping[str, Any]) -> tuple[dict[str, Any], ...]:
        """Advance the world by one action of every drone.

        Returns:
            Observations, rewards, terminations, truncations and infos, by agent.
        """
        require(self.agents, NO_EPISODE)
        self.env_state, results = self._step(self.env_state, self._stack_actions(actions))
        obs, reward, terminated, truncated, info = jax.device_get(results)
        if self.render_mode == "human":
            self.render()
        agents, self.agents = self.agents, [] if terminated or truncated else self.agents
        return (
            self._split_by_agent(obs),
            {agent: float(r) for agent, r in zip(agents, reward, strict=True)},
            dict.fromkeys(agents, bool(terminated)),
            dict.fromkeys(agents, bool(truncated)),
            self._split_by_agent(info),
        )

    def state(self) -> np.ndarray:
        """Return the observations of all drones as one vector: drone after drone, sorted by name for each drone."""
        require(self.env_state is not None, "expected a reset before state(), got none. Call reset() first.")
        return np.array(flatten(self.env_state.obs)).ravel()

    def render(self) -> np.ndarray | None:
        """Render the world: return an image (height, width, 3), or draw into a window.

        Raises:
            RenderError: If this machine cannot render.
        """
        images = self._renderer(self.env_state)
        return images[0] if images else None

    def explain(self) -> str:
        """Return how a step is executed, as ``Env.explain`` does."""
        return self.env.explain()

    def close(self) -> None:
        """Close the window, and end the episode."""
        self.env_state, self.agents = None, []
        self.sim.close()

    def _advance(self, state: EnvState, actions: Array) -> tuple[EnvState, Any]:
        state = self.env.step(state, actions[None])
        return state, (state.obs, state.reward[0], state.terminated[0], state.truncated[0], state.info)

    def _stack_actions(self, actions: Mapping[str, Any]) -> np.ndarray:
        expect(isinstance(actions, Mapping), "a dict with an action of every drone", actions, "Use {'drone_0': ...}.")
        if unknown_agents := [agent for agent in actions if agent not in self.agents]:
            raise UnknownNameError(f"expected actions of {', '.join(self.agents)}, got one of {unknown_agents[0]}")
        if missing_agents := [agent for agent in self.agents if agent not in actions]:
            raise ConfigError(f"expected an action of every drone, got none of {', '.join(missing_agents)}")
        shape = self.action_spaces[self.agents[0]].shape
        rows = [np.float32(read_floats(f"action of {agent}", actions[agent])) for agent in self.agents]
        for agent, row in zip(self.agents, rows, strict=True):
            require(row.shape == shape, f"expected an action of {agent} of shape {shape}, got {row.shape}", ValueError)
            require(np.isfinite(row).all(), f"expected a finite action of {agent}, got NaN or infinity")
        return np.stack(rows)

    def _split_by_agent(self, tree: Any) -> dict[str, Any]:
        def agent_entry(x: Any, i: int) -> Any:
            # A copy, because arrays from JAX are read-only.
            return (x[0, i] if x.ndim > 1 else x[0]).copy()

        return {
            agent: jax.tree.map(lambda x, i=i: agent_entry(x, i), tree) for i, agent in enumerate(self.possible_agents)
        }


def make_parallel(task: str, render_mode: str | None = None, **options: Any) -> DroneParallelEnv:
    """Return one world of a task for PettingZoo.

    Args:
        task: One of ``crazysim.envs.TASKS``.
        options: Options of ``crazysim.envs.make``, such as ``n_drones``.
    """
    return DroneParallelEnv(make(task, options.pop("n_worlds", 1), **options), render_mode)


def _box(shape: tuple[int, ...], limit: float, dtype: DTypeLike) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-limit, limit, shape, jnp.dtype(dtype))
