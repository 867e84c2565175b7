"""Environments as Gymnasium's vector environments: one compiled call a step, arrays that stay on the device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode as GymnasiumMode
from jax import Array

from crazysim.core.settings import as_mask, member
from crazysim.envs.env import DroneEnv, Env
from crazysim.envs.registry import TASKS, make
from crazysim.envs.rendering import RENDER_MODES, Renderer
from crazysim.envs.state import EnvState, from_host
from crazysim.envs.stepper import EnvStepper
from crazysim.envs.wrappers import AutoReset, AutoresetMode
from crazysim.errors import ConfigError


class DroneVectorEnv(gymnasium.vector.VectorEnv):
    """A vector environment of Gymnasium's over a functional one.

    Observations are named, (num_envs, k) for a single drone a world and (num_envs, n_drones, k) else, actions likewise;
    with several drones the reward is their mean. All are JAX arrays on the simulation's device: Gymnasium's wrappers
    ``JaxToNumpy`` and ``JaxToTorch`` make others of them.
    """

    def __init__(
        self,
        env: Env,
        autoreset_mode: GymnasiumMode | str = GymnasiumMode.NEXT_STEP,
        render_mode: str | None = None,
        render_worlds: Sequence[int] = (0,),
        render_size: tuple[int, int] = (640, 480),
    ):
        """Take the functional environment, without automatic resets.

        Args:
            env: The environment.
            autoreset_mode: When new episodes begin.
            render_mode: What ``render`` does: ``"rgb_array"`` returns pictures, ``"human"`` draws the first world into
                a window.
            render_worlds: Which worlds are drawn.
            render_size: Width and height of a picture, pixels.

        Raises:
            ConfigError: If there is no such mode, or the environment begins episodes by itself.
        """
        if isinstance(env, AutoReset):
            raise ConfigError("give the environment without AutoReset, and say autoreset_mode= here")
        mode = member(GymnasiumMode, "autoreset_mode", autoreset_mode)
        self.env = AutoReset(env, AutoresetMode(mode.value))
        self.sim, self.render_mode = env.sim, render_mode
        self._renderer = Renderer(env.sim, render_mode, render_worlds, render_size)
        self.metadata = {
            "autoreset_mode": mode,
            "render_modes": list(RENDER_MODES),
            "render_fps": round(env.max_steps / env.task.seconds),
        }
        self.num_envs = env.sim.n_worlds
        self._single = env.sim.n_drones == 1
        self._begin = jax.jit(self.env.reset)
        self._again = jax.jit(self.env.restart)
        self._stepper = EnvStepper(self.env, self._output)
        self._outputs: Any = None
        shapes = jax.eval_shape(self.env.reset, jax.random.key(0))
        self._of_drone = {k for k, v in shapes.info.items() if k != "final_obs" and v.ndim > 1}
        self.single_observation_space = gymnasium.spaces.Dict(
            {name: self._box(x, np.inf) for name, x in shapes.obs.items()}
        )
        self.single_action_space = self._box(shapes.action, 1.0)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin new episodes in all worlds, or in those of ``options["reset_mask"]``, (num_envs,) of type bool.

        Without a seed the random numbers go on from those before; the first ones come from the system.

        Raises:
            ConfigError: If the seed is no integer, or an option does not exist.
        """
        options = dict(options or {})
        mask = as_mask(options.pop("reset_mask", None), self.num_envs)
        if options:
            raise ConfigError(f"reset has no option {', '.join(options)}; it has reset_mask")
        if seed is not None and not isinstance(seed, (int, np.integer)):
            raise ConfigError(
                f"the seed is {seed!r}; one integer seeds all worlds, each of which draws its own numbers"
            )
        super().reset(seed=None if seed is None else int(seed))
        before = self.state if mask is not None else None
        if before is not None:
            if seed is not None:
                raise ConfigError("a seed is one for all worlds; reset them all with it, or leave it out with a mask")
            state = self._again(before, mask)
        else:
            number = seed if seed is not None else int(self.np_random.integers(2**31))
            state = self._begin(jax.random.key(int(number)))
        self._stepper.state, self._outputs = state, self._output(state)
        return self._outputs[0], self._outputs[2]

    @property
    def state(self) -> EnvState | None:
        """The functional environment's state, each drone with the reward of its world; None before the first reset."""
        state = self._stepper.state
        if state is None:
            return None
        obs, reward, info = self._outputs
        n = (self.num_envs, self.sim.n_drones)
        info = {k: v for k, v in info.items() if not k.endswith("final_obs")}
        info = {k: v.reshape(*n, *v.shape[1:]) if self._single and k in self._of_drone else v for k, v in info.items()}
        obs = {k: v.reshape(*n, -1) for k, v in obs.items()}
        return state.replace(obs=obs, reward=jnp.broadcast_to(reward[:, None], n), info=info)

    def step(self, actions: Any) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Advance all worlds.

        Args:
            actions: (num_envs, k), or (num_envs, n_drones, k) with several drones.

        Raises:
            ConfigError: If the environment was not reset, or actions of the host are not finite.
            ValueError: If they have another shape.
        """
        if self._outputs is None:
            raise ConfigError("the environment must be reset before its first step: call reset()")
        needed = self.action_space.shape or ()
        if not isinstance(actions, jax.Array):
            actions = from_host(actions, needed)
        elif actions.shape != needed:
            raise ValueError(f"actions have shape {actions.shape}; needed is {needed}")
        self._outputs, terminated, truncated = self._stepper(actions)
        obs, reward, info = self._outputs
        if self.render_mode == "human":
            self.render()
        return obs, reward, terminated, truncated, info

    def _output(self, state: EnvState) -> tuple[Any, Array, dict[str, Any]]:
        """Return observations, rewards and infos as Gymnasium has them."""
        reward = state.reward[:, 0] if self._single else jnp.mean(state.reward, axis=1)
        return self._of_drones(state.obs), reward, self._info(state)

    def _of_drones(self, tree: Any) -> Any:
        """Return arrays of drones without the drones' axis where there is one drone."""
        return jax.tree.map(lambda x: x[:, 0], tree) if self._single else tree

    def _info(self, state: EnvState) -> dict[str, Any]:
        info = {k: self._of_drones(v) if k in self._of_drone else v for k, v in state.info.items() if k != "final_obs"}
        if "final_obs" in state.info:
            info |= {"final_obs": self._of_drones(state.info["final_obs"]), "_final_obs": state.done}
        return info

    def _box(self, x: Any, limit: float) -> gymnasium.spaces.Box:
        shape = x.shape[2:] if self._single else x.shape[1:]
        return gymnasium.spaces.Box(-limit, limit, shape, x.dtype)

    def render(self) -> tuple[Any, ...] | None:
        """Draw the chosen worlds as they are: a picture (height, width, 3) of each, or a window.

        Raises:
            ConfigError: If nothing was said of drawing when the environment was made, or it was not reset.
            RenderError: If this machine cannot draw.
        """
        pictures = self._renderer(self.state)
        return tuple(pictures) if self.render_mode == "rgb_array" else None

    def close_extras(self, **kwargs: Any) -> None:
        """Close the window."""
        del kwargs
        self.sim.close()


def make_vector(
    task: str,
    num_envs: int = 1,
    autoreset_mode: GymnasiumMode | str = GymnasiumMode.NEXT_STEP,
    render_mode: str | None = None,
    max_episode_steps: int | None = None,
    **options: Any,
) -> DroneVectorEnv:
    """Return a vector environment of a task; what ``gymnasium.make_vec`` calls.

    Args:
        task: One of ``crazysim.envs.TASKS``.
        num_envs: Number of worlds.
        autoreset_mode: When new episodes begin.
        render_mode: What ``render`` does.
        max_episode_steps: Length of an episode in steps; None for the task's.
        options: As for ``crazysim.envs.make``.
    """
    if max_episode_steps is not None:
        options["seconds"] = max_episode_steps / options.get("freq", 50)
    env: DroneEnv = make(task, num_envs, **options)
    return DroneVectorEnv(env, autoreset_mode, render_mode)


def register() -> None:
    """Have Gymnasium know every task by its id."""
    for name, entry in TASKS.items():
        if entry.id not in gymnasium.registry:
            gymnasium.register(entry.id, vector_entry_point=f"{__name__}:make_vector", kwargs={"task": name})
