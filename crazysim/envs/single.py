"""One world as an environment of ``gymnasium.make``, with NumPy arrays."""

from __future__ import annotations

from typing import Any

import gymnasium
import jax
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from crazysim.arguments import check_arguments
from crazysim.envs.env import Env
from crazysim.envs.random import as_seed, read_options
from crazysim.envs.registry import make
from crazysim.envs.rendering import RENDER_MODES
from crazysim.envs.vector import DroneVectorEnv
from crazysim.errors import require


class DroneSingleEnv(gymnasium.Env):
    """Gymnasium environment over a functional environment of one world.

    Use it for programs that support no other interface, and to look at one drone: a step takes nearly as long as a step
    of thousands of worlds. Observations are NumPy arrays that the caller may write to; the reward is a float.
    """

    @check_arguments
    def __init__(self, env: Env, render_mode: str | None = None, render_size: tuple[int, int] = (640, 480)):
        require(
            env.sim.n_worlds == 1,
            f"expected an environment of one world, got {env.sim.n_worlds} worlds. Use gymnasium.make_vec.",
        )
        self.vector = DroneVectorEnv(env, AutoresetMode.DISABLED, render_mode, render_size=render_size, numpy=True)
        self.sim, self.render_mode = env.sim, render_mode
        self.metadata = {"render_modes": list(RENDER_MODES), "render_fps": self.vector.metadata["render_fps"]}
        self.observation_space = self.vector.single_observation_space
        self.action_space = self.vector.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start a new episode; return its observations and infos.

        Without a seed, the random numbers continue the earlier sequence, or start from the system's entropy.
        """
        read_options(options)
        super().reset(seed=as_seed(seed))
        obs, info = self.vector.reset(seed=int(self.np_random.integers(2**31)) if seed is None else seed)
        return _squeeze_world(obs), _squeeze_world(info)

    def step(self, action: ArrayLike) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance the world; return observations, reward, ``terminated``, ``truncated`` and infos.

        Args:
            action: Action in [-1, 1]. (k,), or (n_drones, k) with several drones
        """
        obs, reward, terminated, truncated, info = self.vector.step(
            action[None] if isinstance(action, jax.Array) else [action]
        )
        return _squeeze_world(obs), float(reward[0]), bool(terminated[0]), bool(truncated[0]), _squeeze_world(info)

    def render(self) -> NDArray | None:
        """Render an image (height, width, 3), or draw into a window.

        Raises:
            RenderError: If this machine cannot render.
        """
        images = self.vector.render()
        return None if images is None else images[0]

    def explain(self) -> str:
        return self.vector.explain()

    def close(self) -> None:
        """Close the window."""
        self.vector.close()


def _squeeze_world(tree: Any) -> Any:
    return jax.tree.map(lambda x: x[0], tree)


def make_single(
    task: str, render_mode: str | None = None, render_size: tuple[int, int] = (640, 480), **options: Any
) -> DroneSingleEnv:
    """Return one world of a task, for ``gymnasium.make``.

    Args:
        task: One of ``crazysim.envs.TASKS``.
        render_size: Width and height of an image, pixels.
        options: Options of ``crazysim.envs.make``.
    """
    return DroneSingleEnv(make(task, options.pop("n_worlds", 1), **options), render_mode, render_size)
