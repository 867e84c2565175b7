"""Environments for RSL-RL: a ``VecEnv`` of all worlds, with tensors of PyTorch that share their memory with JAX."""

from __future__ import annotations

from typing import Any, cast

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.arguments import check_arguments
from crazysim.envs.env import Env
from crazysim.envs.random import as_seed
from crazysim.envs.state import PRIVILEGED, EnvState, Obs, flatten, read_action, terms_of
from crazysim.envs.stepper import EnvStepper
from crazysim.envs.wrappers import AutoReset, CameraImages
from crazysim.errors import require

try:
    import torch
    from rsl_rl.env import VecEnv
    from tensordict import TensorDict
except ImportError as error:
    raise ImportError(
        "crazysim.envs.rsl_rl needs rsl-rl-lib, which is not installed. Run pip install rsl-rl-lib."
    ) from error


class RslRlEnv(VecEnv):
    """Vector environment of RSL-RL over a functional environment; each world is one sub-environment.

    Tensors are on the device of the simulation and share their memory with JAX. A new episode starts within the step
    that ends an episode. Actions are clipped to [-1, 1], because RSL-RL does not limit them. With several drones,
    rewards are means over the drones; observations and actions are concatenated, drone after drone.

    Groups of observations, for ``obs_groups`` in the settings of a runner:

    - ``policy``: all observations but the following, concatenated by ``flatten``;
    - ``privileged``: that of ``PrivilegedObservation``, which only a critic may use;
    - images by their names, (num_envs, channels, height, width), for a ``CNNModel``.

    The log has the task error, mean over the worlds, and the terms of the reward if the environment has
    ``RewardTerms``.
    """

    @check_arguments
    def __init__(self, env: Env, seed: int = 0):
        require(env.sim.mesh is None, "expected worlds on one device, got several. Make one environment a device.")
        self.env, self.sim = AutoReset(env), env.sim
        self.num_envs, self.num_actions = env.sim.n_worlds, env.sim.n_drones * env.actions.size
        self.max_episode_length, self.step_dt = env.max_steps, env.task.seconds / env.max_steps
        self.cfg = {"task": env.task.name, "seconds": env.task.seconds, "n_worlds": self.num_envs}
        cameras = [wrapper for wrapper in env.wrappers if isinstance(wrapper, CameraImages)]
        self._image_shapes = {name: shape for camera in cameras for name, shape in camera.shapes.items()}
        self._reset_fn, self._output_fn = jax.jit(self.env.reset), jax.jit(self._output)
        self._stepper = EnvStepper(self.env, self._output)
        self.device = str(self.reset(seed)[0]["policy"].device)

    @property
    def unwrapped(self) -> RslRlEnv:
        """This object, whose ``step_dt`` RSL-RL reads."""
        return self

    @property
    def state(self) -> EnvState:
        """State of the functional environment, whose observations and reward may be those of an earlier step."""
        return cast(EnvState, self._stepper.state)

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Environment steps since the start of each episode, which ``init_at_random_ep_len`` of runners sets."""
        return torch.from_dlpack(self.state.data.core.steps[:, 0] // self.env.n_substeps)

    @episode_length_buf.setter
    def episode_length_buf(self, lengths: torch.Tensor) -> None:
        state = self.state
        core = state.full_data.core
        steps = _to_jax(lengths).astype(core.steps.dtype)[:, None] * self.env.n_substeps
        self._stepper.state = state.replace(full_data=state.full_data.replace(core=core.replace(steps=steps)))

    def reset(self, seed: int = 0) -> tuple[TensorDict, dict[str, Any]]:
        """Start new episodes in all worlds; return their observations, and no extras."""
        state = self._reset_fn(jax.random.key(cast(int, as_seed(seed))))
        self._stepper.state, self._obs = state, self._to_torch(self._output_fn(state)[0])
        return self._obs, {}

    def get_observations(self) -> TensorDict:
        """Return the observations of the last step or reset, by group."""
        return self._obs

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance all worlds; return observations, rewards, flags that are True where an episode ended, and extras."""
        action = read_action(_to_jax(actions), (self.num_envs, self.num_actions))
        (obs, reward, log), terminated, truncated = self._stepper(jnp.clip(action, -1.0, 1.0))
        self._obs = self._to_torch(obs)
        reward, terminated, truncated, *means = map(torch.from_dlpack, (reward, terminated, truncated, *log.values()))
        extras = {"time_outs": truncated & ~terminated, "log": dict(zip(log, means, strict=True))}
        return self._obs, reward, terminated | truncated, extras

    def _output(self, state: EnvState) -> tuple[Obs, Array, dict[str, Array]]:
        obs, n_worlds = state.obs, self.num_envs
        groups = {"policy": flatten({k: x for k, x in obs.items() if k != PRIVILEGED and k not in self._image_shapes})}
        groups |= {PRIVILEGED: obs[PRIVILEGED]} if PRIVILEGED in obs else {}
        groups = {name: x.reshape(n_worlds, -1) for name, x in groups.items()}
        for name, (height, width, *channels) in self._image_shapes.items():
            images = obs[name].reshape(n_worlds, -1, height, width, *(channels or [1]))
            groups[name] = jnp.moveaxis(images, -1, 2).reshape(n_worlds, -1, height, width)
        log = {"/error": state.info["error"]} | {f"/reward {k}": x for k, x in terms_of(state.info).items()}
        return groups, state.reward.mean(axis=1), {name: x.mean() for name, x in log.items()}

    def _to_torch(self, obs: Obs) -> TensorDict:
        return TensorDict({name: torch.from_dlpack(x) for name, x in obs.items()}, batch_size=[self.num_envs])


def _to_jax(x: torch.Tensor) -> Array:
    return jax.dlpack.from_dlpack(x.detach().contiguous())
