"""Wrappers that change observations.

``state.obs`` has all observations, ``state.record.obs`` has them without images.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from crazysim.arguments import check_array
from crazysim.core.data import SimData
from crazysim.core.plugin import Plugin
from crazysim.core.random import normal, world_key
from crazysim.core.settings import positive_integer
from crazysim.engine.pytree import PyTree, leaf, scopes
from crazysim.engine.stage import vmap_drones
from crazysim.envs.env import Env
from crazysim.envs.state import PRIVILEGED, EnvState, Obs, flatten
from crazysim.envs.statistics import RunningStats
from crazysim.envs.tasks.goals import state_of
from crazysim.envs.wrappers.action import MAX_FRAMES
from crazysim.envs.wrappers.base import Wrapper
from crazysim.errors import ConfigError, expect, require
from crazysim.tables import NOT_NEGATIVE, read_number


class Observe(Wrapper):
    """Change observations by ``fn(obs, data) -> obs``, a pure function of one world.

    ``Observe(env, lambda obs, data: {"vector": flatten(obs)})`` concatenates all observations.
    """

    def __init__(self, env: Env, fn: Callable[[Obs, SimData], Obs]):
        super().__init__(env)
        expect(callable(fn), "a function (obs, data) -> obs", fn)
        self.fn = fn

    def after_reset(self, state: EnvState) -> EnvState:
        return self._observe(state)

    def after_step(self, state: EnvState) -> EnvState:
        return self._observe(state)

    def _observe(self, state: EnvState) -> EnvState:
        obs = self.fn(state.obs, state.data)
        expect(
            isinstance(obs, Mapping) and obs,
            f"the function of {self.name!r} to return a dict of names to arrays",
            obs,
            "Use for example {'vector': flatten(obs)}.",
        )
        for name, x in obs.items():
            check_array(f"observation {name!r} of {self.name!r}", x)
        return state.replace(obs={name: jnp.asarray(x) for name, x in obs.items()})


class PrivilegedObservation(Observe):
    """Add ``obs["privileged"]``: true state and parameters, which a critic may use in training, but no policy.

    Its parts, for every drone, are

    - attitude (rotation matrix), angular velocity, position, velocity and rotor speeds;
    - the parameters that have a value per drone, divided by the largest magnitude of the parameter in the default data;
    - the observations of plugins that change the dynamics, such as the factors that ``Randomize`` has drawn and the
      charge of a ``Battery``;
    - the observations of ``task.privileged``.
    """

    def __init__(self, env: Env):
        super().__init__(env, self._add_privileged)
        scales = jax.tree.map(lambda x: np.abs(x).max(), env.sim.default_data.params)
        self._scales = [float(x) or 1.0 for x in jax.tree.leaves(scales)]
        plugins = env.sim.plugins.values()
        self._plugins = [plugin for plugin in plugins if type(plugin).influence is not Plugin.influence]

    def _add_privileged(self, obs: Obs, data: SimData) -> Obs:
        require(
            PRIVILEGED not in obs,
            f"expected observations without {PRIVILEGED!r}, got {', '.join(obs)}. Use another name in the task.",
        )
        params = zip(jax.tree.leaves(data.params), jax.tree.leaves(scopes(data.params)), self._scales, strict=True)
        drone_params = [(x / scale).reshape(len(x), -1) for x, scope, scale in params if scope == "drone"]
        effects = vmap_drones(lambda drone: [plugin.bound(drone).observations(drone) for plugin in self._plugins])(data)
        parts = [flatten(state_of(data)), data.states.rotor_vel, *drone_params, *jax.tree.leaves(effects)]
        parts += self.task.privileged(data).values()
        return obs | {PRIVILEGED: jnp.concatenate(parts, axis=-1)}


class ObservationNoise(Wrapper):
    """Add normally distributed noise to observations, independent in every step and repeatable by seed and world.

    ``std`` maps names of observations to standard deviations, each in the unit of the observation.
    """

    def __init__(self, env: Env, std: dict[str, float]):
        super().__init__(env)
        expect(isinstance(std, Mapping), "std as a dict of numbers by name", std, "Use for example {'pos': 0.01}.")
        self.std = {name: read_number(f"std of {name!r}", value, NOT_NEGATIVE) for name, value in std.items()}

    def after_reset(self, state: EnvState) -> EnvState:
        return state.replace(obs=self._add_noise(state.record.obs, state.data))

    def after_step(self, state: EnvState) -> EnvState:
        return state.replace(obs=self._add_noise(state.record.obs, state.data))

    def _add_noise(self, obs: Obs, data: SimData) -> Obs:
        if unknown_obs := set(self.std) - set(obs):
            raise ConfigError(f"expected names of observations, {', '.join(obs)}, got {', '.join(sorted(unknown_obs))}")
        key = world_key(data, f"observation noise {self.name}")
        keys = jax.vmap(lambda drone: jax.random.fold_in(key, drone))(data.core.drone_id)
        noisy = dict(obs)
        for i, (name, std) in enumerate(sorted(self.std.items())):
            noisy[name] = obs[name] + std * jax.vmap(
                lambda key, i=i, x=obs[name]: normal(jax.random.fold_in(key, i), x.shape[1:], x.dtype)
            )(keys)
        return noisy


class Normalize(Wrapper):
    """Normalise observations to mean zero and variance one, and clip them to [-10, 10]. Images are not normalised.

    Mean and variance are over all worlds, drones and steps so far; ``state.memory["Normalize"]`` has them by name of
    the observation. To fly a policy with the statistics of its training, pass them: ``Normalize(env, stats)`` does not
    update them. If ``reset`` gets one key for each block of worlds, as in a training with several seeds, all blocks
    share the statistics.
    """

    batched = True

    def __init__(self, env: Env, stats: dict[str, RunningStats] | None = None):
        super().__init__(env)
        expect(isinstance(stats, (Mapping, type(None))), "stats as a dict of RunningStats by name, or None", stats)
        self.stats = stats

    def after_reset(self, state: EnvState) -> EnvState:
        if self.name in state.memory:
            return self._normalize(state, self.recall(state))
        obs = state.record.obs  # without images
        stats = self.stats or {name: RunningStats.create(x.shape[-1]) for name, x in obs.items()}
        if unmatched := set(obs) ^ set(stats):
            raise ConfigError(
                f"expected statistics of the observations {', '.join(sorted(obs))}, got "
                f"{', '.join(sorted(stats))}: {', '.join(sorted(unmatched))} is in one of them only"
            )
        return self._update(state, stats)

    def after_step(self, state: EnvState) -> EnvState:
        return self._update(state, self.recall(state))

    def _update(self, state: EnvState, stats: dict[str, RunningStats]) -> EnvState:
        if self.stats is None:
            stats = {name: stats[name].update(x) for name, x in state.record.obs.items()}
        return self._normalize(state, stats)

    def _normalize(self, state: EnvState, stats: dict[str, RunningStats]) -> EnvState:
        return self.remember(state, stats, obs={name: stats[name].normalize(x) for name, x in state.record.obs.items()})


class Frames(PyTree):
    """Memory of ``FrameStack``."""

    obs: Obs = leaf("drone", 2)
    """The last n observations, the oldest first. (n_worlds, n_drones, n, k) each"""


class FrameStack(Wrapper):
    """Observe the last ``n`` observations, the oldest first, concatenated along the last axis; images stay single."""

    def __init__(self, env: Env, n: int):
        super().__init__(env)
        self.n = positive_integer("n", n, MAX_FRAMES)

    def after_reset(self, state: EnvState) -> EnvState:
        frames = jax.tree.map(lambda x: jnp.repeat(x[..., None, :], self.n, axis=-2), state.record.obs)
        return self._stack(state, frames)

    def after_step(self, state: EnvState) -> EnvState:
        old_frames = self.recall(state).obs
        frames = jax.tree.map(
            lambda x, y: jnp.concatenate([y[..., 1:, :], x[..., None, :]], axis=-2), state.record.obs, old_frames
        )
        return self._stack(state, frames)

    def _stack(self, state: EnvState, frames: Obs) -> EnvState:
        return self.remember(state, Frames(frames), obs=jax.tree.map(lambda x: x.reshape(*x.shape[:-2], -1), frames))
