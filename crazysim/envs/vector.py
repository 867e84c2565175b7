"""Environments as vector environments of Gymnasium: one compiled call per step, arrays that stay on the device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode as GymnasiumMode
from jax import Array

from crazysim.arguments import check_arguments, check_flag
from crazysim.core.settings import as_mask, enum_member, positive_integer
from crazysim.engine.cache import announce_if_slow
from crazysim.engine.jaxcompat import require_unforked_process
from crazysim.envs.env import Env
from crazysim.envs.random import as_seed, read_options
from crazysim.envs.registry import entry_of, make
from crazysim.envs.rendering import RENDER_MODES, Renderer
from crazysim.envs.state import NO_EPISODE, EnvState, check_actions, read_action
from crazysim.envs.stepper import EnvStepper
from crazysim.envs.wrappers import AutoReset, AutoresetMode
from crazysim.errors import require, short_repr


class DroneVectorEnv(gymnasium.vector.VectorEnv):
    """Vector environment of Gymnasium over a functional environment.

    Actions and each named observation are (num_envs, k) with one drone per world, and (num_envs, n_drones, k) with
    several. With several drones, the reward is the mean over the drones. All are JAX arrays on the simulation's device,
    which Gymnasium's wrappers ``JaxToNumpy`` and ``JaxToTorch`` convert without a copy. With ``numpy=True`` they are
    NumPy arrays that the caller may write to, as Gymnasium's reward wrappers do.
    """

    closed = True  # until it is complete: Gymnasium closes an environment that is deleted

    @check_arguments
    def __init__(
        self,
        env: Env,
        autoreset_mode: GymnasiumMode | str = GymnasiumMode.NEXT_STEP,
        render_mode: str | None = None,
        render_worlds: Sequence[int] | None = None,
        render_size: tuple[int, int] = (640, 480),
        numpy: bool = False,
    ):
        mode = enum_member(GymnasiumMode, "autoreset_mode", autoreset_mode)
        self.env = AutoReset(env, AutoresetMode(mode.value))
        self.sim, self.render_mode = env.sim, render_mode
        self._renderer = Renderer(env, render_mode, render_worlds, render_size)
        self.metadata = {
            "autoreset_mode": mode,
            "render_modes": list(RENDER_MODES),
            "render_fps": round(env.max_steps / env.task.seconds),
        }
        self.num_envs, self._numpy = env.sim.n_worlds, check_flag("numpy", numpy)
        self._has_single_drone = env.sim.n_drones == 1
        self._reset_fn = jax.jit(self.env.reset)
        self._restart_fn = jax.jit(self.env.restart)
        self._stepper = EnvStepper(self.env, self._output)
        self._outputs: Any = None
        """Observations, rewards and infos of the last reset or step, as ``_output`` returns them."""
        shapes = self._reset_fn.eval_shape(jax.random.key(0))  # ``reset`` reuses this trace
        self._drone_entries = {k for k, v in shapes.info.items() if k != "final_obs" and v.ndim > 1}
        """Names of the entries of ``info`` with a row for each drone."""
        self.single_observation_space = gymnasium.spaces.Dict(
            {name: self._box(x, np.inf) for name, x in shapes.obs.items()}
        )
        self.single_action_space = self._box(shapes.action, 1.0)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, self.num_envs)
        self.closed = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start new episodes in all worlds, or where ``options["reset_mask"]`` is True, bool (num_envs,).

        Return observations and infos.

        Without a seed, the random numbers continue the earlier sequence, or start from the system's entropy.
        """
        mask = as_mask(read_options(options, "reset_mask").get("reset_mask"), (self.num_envs,))
        seed = as_seed(seed)
        require_unforked_process()
        state_before = self.state
        require(
            mask is None or seed is None,
            "expected a seed or a reset_mask, got both. Leave the seed out: a seed is for all worlds.",
        )
        require(
            mask is None or state_before is not None,
            "expected a reset of all worlds before the first reset_mask, got none. Call reset().",
        )
        super().reset(seed=seed)
        if mask is not None:
            state = self._restart_fn(state_before, mask)
        else:
            key_seed = seed if seed is not None else int(self.np_random.integers(2**31))
            with announce_if_slow("compiling the environment", "2 to 4 s"):
                state = self._reset_fn(jax.random.key(key_seed))
        self._stepper.state, self._outputs, self.closed = state, self._output(state), False
        obs, _, info = self._outputs
        return self._convert((obs, self._add_final_info(info)))

    @property
    def state(self) -> EnvState | None:
        """State of the functional environment; all drones of a world have its reward. None before the first reset."""
        state = self._stepper.state
        if state is None or self._outputs is None:
            return None
        obs, reward, info = self._outputs
        batch_shape = (self.num_envs, self.sim.n_drones)
        drone_entries = self._drone_entries if self._has_single_drone else ()
        info_entries = {
            k: v.reshape(*batch_shape, *v.shape[1:]) if k in drone_entries else v
            for k, v in info.items()
            if k in state.info
        }
        if "final_obs" in info_entries:
            info_entries["final_obs"] = {k: v.reshape(*batch_shape, -1) for k, v in info["final_obs"].items()}
        obs = {k: v.reshape(*batch_shape, -1) for k, v in obs.items()}
        images = {name: obs.pop(name) for name in state.record.images}
        return state.replace(
            obs=obs, images=images, reward=jnp.broadcast_to(reward[:, None], batch_shape), info=info_entries
        )

    def step(self, actions: Any) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Advance all worlds; return observations, rewards, ``terminated``, ``truncated`` and infos.

        Args:
            actions: Actions in [-1, 1]. (num_envs, k), or (num_envs, n_drones, k) with several drones
        """
        require(self._outputs is not None, NO_EPISODE)
        shape = self.action_space.shape or ()
        actions = read_action(actions, shape) if isinstance(actions, jax.Array) else check_actions(actions, shape)
        self._outputs, terminated, truncated = self._stepper(actions)
        obs, reward, info = self._outputs
        if self.render_mode == "human":
            self.render()
        return self._convert((obs, reward, terminated, truncated, self._add_final_info(info)))

    def _add_final_info(self, info: dict[str, Any]) -> dict[str, Any]:
        is_over = info.get("_final_obs")
        if is_over is None:
            return info
        final_info = {k: v for k, v in info.items() if not k.endswith("final_obs")}
        return info | {"final_info": final_info | {f"_{k}": is_over for k in final_info}, "_final_info": is_over}

    def _convert(self, results: Any) -> Any:
        return jax.tree.map(np.array, results) if self._numpy else results

    def _output(self, state: EnvState) -> tuple[Any, Array, dict[str, Any]]:
        reward = state.reward[:, 0] if self._has_single_drone else jnp.mean(state.reward, axis=1)
        return self._squeeze_drones(state.obs), reward, self._convert_info(state)

    def _squeeze_drones(self, tree: Any) -> Any:
        return jax.tree.map(lambda x: x[:, 0], tree) if self._has_single_drone else tree

    def _convert_info(self, state: EnvState) -> dict[str, Any]:
        info = {
            k: self._squeeze_drones(v) if k in self._drone_entries else v
            for k, v in state.info.items()
            if k != "final_obs"
        }
        if "final_obs" in state.info:
            info |= {"final_obs": self._squeeze_drones(state.info["final_obs"]), "_final_obs": state.done}
        return info

    def _box(self, x: Any, limit: float) -> gymnasium.spaces.Box:
        shape = x.shape[2:] if self._has_single_drone else x.shape[1:]
        return gymnasium.spaces.Box(-limit, limit, shape, x.dtype)

    def render(self) -> tuple[Any, ...] | None:
        """Render an image (height, width, 3) of each of ``render_worlds``, or draw the first of them into a window.

        Raises:
            RenderError: If this machine cannot render.
        """
        images = self._renderer(self.state)
        return tuple(images) if self.render_mode == "rgb_array" else None

    def explain(self) -> str:
        """Explain how a step is executed, as ``Env.explain`` does."""
        return self.env.explain()

    def close_extras(self, **_: Any) -> None:
        """Close the window, and end the episodes."""
        self._outputs = None
        self.sim.close()


def make_vector(
    task: str,
    num_envs: int = 1,
    autoreset_mode: GymnasiumMode | str = GymnasiumMode.NEXT_STEP,
    render_mode: str | None = None,
    max_episode_steps: int | None = None,
    numpy: bool = False,
    render_worlds: Sequence[int] | None = None,
    render_size: tuple[int, int] = (640, 480),
    **options: Any,
) -> DroneVectorEnv:
    """Return a vector environment of a task, for ``gymnasium.make_vec``.

    Args:
        task: One of ``crazysim.envs.TASKS``.
        num_envs: Number of worlds.
        max_episode_steps: Length of an episode, environment steps; None for the length that ``seconds`` sets.
        numpy: Whether to return NumPy arrays, copies that may be written to.
        render_worlds: Worlds to render; None for all.
        render_size: Width and height of an image, pixels.
        options: Options of ``crazysim.envs.make``.
    """
    require(
        "n_worlds" not in options,
        f"expected num_envs, got n_worlds={short_repr(options.get('n_worlds'))}. Use num_envs alone.",
    )
    if max_episode_steps is not None:
        require(
            "seconds" not in options,
            f"expected max_episode_steps or seconds, got {short_repr(max_episode_steps)} and "
            f"{short_repr(options.get('seconds'))}: both are the length of an episode. Leave one out.",
        )
        options["seconds"] = positive_integer("max_episode_steps", max_episode_steps) / positive_integer(
            "freq", options.get("freq") or entry_of(task).task.freq
        )
    env = make(task, num_envs, **options)
    return DroneVectorEnv(env, autoreset_mode, render_mode, render_worlds, render_size, numpy)
