"""What is put around an environment; every wrapper is an environment again, and keeps its own in ``state.memory``."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.random import drone_keys
from crazysim.core.settings import member, positive
from crazysim.core.stage import Axes
from crazysim.engine.lower import UnsupportedError
from crazysim.envs.actions import Actions
from crazysim.envs.env import Env, EnvState, Obs, Task, fitting, observed, told
from crazysim.envs.fused_step import Renewal, WholeStep, base_of
from crazysim.envs.random import episode_keys
from crazysim.envs.statistics import RunningStats
from crazysim.errors import ConfigError
from crazysim.pytree import map_batched, scopes, select_worlds
from crazysim.sim.sim import Sim


class Wrapper:
    """An environment as it is; wrappers change what they are about."""

    name: str = ""
    """Name of what it remembers, in ``state.memory``."""

    def __init__(self, env: Env):
        """Take the environment to put it around.

        Raises:
            ConfigError: If that begins episodes by itself, which a wrapper around it would not notice.
        """
        if isinstance(env, AutoReset):
            raise ConfigError(f"{type(self).__name__} goes inside of AutoReset, which is the outermost wrapper")
        self.env = env
        self.name = self.name or type(self).__name__

    @property
    def sim(self) -> Sim:
        """The simulation that the environment was made from."""
        return self.env.sim

    @property
    def task(self) -> Task:
        """What is to be done."""
        return self.env.task

    @property
    def actions(self) -> Actions:
        """What an action means."""
        return self.env.actions

    @property
    def n_substeps(self) -> int:
        """Physics steps in one environment step."""
        return self.env.n_substeps

    @property
    def max_steps(self) -> int:
        """Environment steps in one episode."""
        return self.env.max_steps

    def reset(self, key: Array) -> EnvState:
        """Return all worlds at the beginning of an episode."""
        return self.env.reset(key)

    def restart(self, state: EnvState, mask: Array) -> EnvState:
        """Return the state with new episodes in the worlds of a mask. (n_worlds,)"""
        return self.env.restart(state, mask)

    def step(self, state: EnvState, action: Array) -> EnvState:
        """Return the state one environment step later. (n_worlds, n_drones, k)"""
        return self.env.step(state, action)

    def recall(self, state: EnvState) -> Any:
        """Return what this wrapper remembers."""
        return state.memory[self.name]

    def remember(self, state: EnvState, memory: Any, **changes: Any) -> EnvState:
        """Return the state with what this wrapper is to remember."""
        return state.replace(memory=state.memory | {self.name: memory}, **changes)


class AutoresetMode(StrEnum):
    """When a new episode begins; the words are Gymnasium's."""

    next_step = "NextStep"
    """With the step after the last, which heeds no action and gives no reward."""
    same_step = "SameStep"
    """At the end of the last step itself: ``obs`` is of the new episode, reward and ``info`` are of that step, and the
    last observation is in ``info["final_obs"]``."""
    disabled = "Disabled"
    """When the user says so."""


class AutoReset(Wrapper):
    """Begin a new episode where one is over; the outermost of all wrappers."""

    def __init__(self, env: Env, mode: AutoresetMode | str = AutoresetMode.same_step):
        """Take the environment, and when to begin.

        Raises:
            ConfigError: If there is no such mode.
        """
        super().__init__(env)
        self.mode = member(AutoresetMode, "mode", mode)
        self._renewal = {
            AutoresetMode.disabled: None,
            AutoresetMode.next_step: Renewal(lambda before, _: before.done, lambda after: after, self.env.restart),
            AutoresetMode.same_step: Renewal(lambda _, after: after.done, self._ended, self._begun),
        }[self.mode]
        self._wholes: dict[Any, WholeStep | str] = {}

    def reset(self, key: Array) -> EnvState:
        """Return all worlds at the beginning of an episode."""
        state = self.env.reset(key)
        return self._ended(state) if self.mode == AutoresetMode.same_step else state

    def step(self, state: EnvState, action: Array) -> EnvState:
        """Return the state one step later, new episodes begun."""
        whole = self.whole(state, action)
        if not isinstance(whole, str):
            return whole(state, fitting(action, state, self.actions))
        after = self.env.step(state, action)
        if self._renewal is None:
            return after
        return self._renewal.begin(self._renewal.prepare(after), self._renewal.over(state, after))

    def explain(self, state: EnvState) -> str:
        """Return in a line whether a step is one kernel, and why not."""
        whole = self.whole(state, state.action)
        return f"a step is not one kernel: {whole}" if isinstance(whole, str) else "a step is one kernel"

    def whole(self, state: EnvState, action: Any, laid: bool = False) -> WholeStep | str:
        """Return the step in one kernel, or why there is none; ``laid`` as in ``WholeStep``."""
        base = base_of(self.env)
        if (why := base.unfused) is not None:
            return why
        leaves, treedef = jax.tree.flatten((state, action))
        key = (laid, treedef, tuple([(jnp.shape(x), jnp.result_type(x)) for x in leaves]))
        if key not in self._wholes:
            try:
                self._wholes[key] = WholeStep(self.env, self._renewal, state, action, laid)
            except (UnsupportedError, TypeError, ValueError) as error:
                self._wholes[key] = str(error)
        return self._wholes[key]

    @staticmethod
    def _ended(state: EnvState) -> EnvState:
        """Return a state that tells its observations apart from those of an episode that begins."""
        return state.replace(info=state.info | {"final_obs": state.obs})

    def _begun(self, state: EnvState, mask: Array) -> EnvState:
        """Return new episodes' observations, and what the last step gave: reward, ends, and what is told of it."""
        kept = {name: getattr(state, name) for name in ("reward", "terminated", "truncated", "info")}
        return self.env.restart(state, mask).replace(**kept)


class EpisodeStatistics(Wrapper):
    """Tell return and length of the episodes that end: ``info["episode_return"]``, ``info["episode_length"]``.

    Both are zero in worlds whose episode goes on.
    """

    def reset(self, key: Array) -> EnvState:
        """Return all worlds at the beginning of an episode."""
        state = self.env.reset(key)
        sums = {"return": jnp.zeros_like(state.reward), "length": jnp.zeros_like(state.truncated, jnp.int32)}
        info = {"episode_return": sums["return"], "episode_length": sums["length"]}
        return self.remember(state, sums, info=state.info | info)

    def restart(self, state: EnvState, mask: Array) -> EnvState:
        """Return the state with new episodes in the worlds of a mask. (n_worlds,)"""
        ended = {name: state.info[name] for name in ("episode_return", "episode_length")}
        old = (self.recall(state), ended)
        sums, ended = jax.tree.map(lambda x: select_worlds(mask, jnp.zeros((), x.dtype), x), old)
        state = self.env.restart(state, mask)
        return self.remember(state, sums, info=state.info | ended)

    def step(self, state: EnvState, action: Array) -> EnvState:
        """Return the state one step later."""
        before = self.recall(state)
        state = self.env.step(state, action)
        sums = {"return": before["return"] + state.reward, "length": before["length"] + 1}
        ended = jax.tree.map(lambda x: select_worlds(state.done, x, jnp.zeros((), x.dtype)), sums)
        info = {"episode_return": ended["return"], "episode_length": ended["length"]}
        left = jax.tree.map(lambda x: select_worlds(state.done, jnp.zeros((), x.dtype), x), sums)
        return self.remember(state, left, info=state.info | info)


class Observe(Wrapper):
    """Change what is observed: ``fn(obs, data) -> obs``, a pure function without a memory.

    ``Observe(env, lambda obs, data: {"vector": flatten(obs)})`` makes one array of all.
    """

    def __init__(self, env: Env, fn: Callable[[Obs, SimData], Obs]):
        """Take the environment, and what becomes of its observations."""
        super().__init__(env)
        self.fn = fn

    def reset(self, key: Array) -> EnvState:
        """Return all worlds at the beginning of an episode."""
        return self._changed(self.env.reset(key))

    def restart(self, state: EnvState, mask: Array) -> EnvState:
        """Return the state with new episodes in the worlds of a mask. (n_worlds,)"""
        return self._changed(self.env.restart(state, mask))

    def step(self, state: EnvState, action: Array) -> EnvState:
        """Return the state one step later."""
        return self._changed(self.env.step(state, action))

    def _changed(self, state: EnvState) -> EnvState:
        return state.replace(obs=self.fn(state.obs, state.data))


class ObservationNoise(Observe):
    """Add normal noise to observations, other in every step, the same for the same seed and world."""

    def __init__(self, env: Env, std: dict[str, float]):
        """Take the environment, and standard deviations by name of what is observed, in its unit.

        Raises:
            ConfigError: If nothing of that name is observed, when the environment is first reset.
        """
        super().__init__(env, self._noisy)
        self.std = dict(std)

    def _noisy(self, obs: Obs, data: SimData) -> Obs:
        if missing := set(self.std) - set(obs):
            raise ConfigError(f"nothing observed is called {', '.join(sorted(missing))}; there are {', '.join(obs)}")
        keys = drone_keys(data, "observation noise")
        noisy = dict(obs)
        for i, (name, std) in enumerate(sorted(self.std.items())):
            own = jax.vmap(jax.vmap(lambda key, i=i: jax.random.fold_in(key, i)))(keys)
            shape, dtype = obs[name].shape[2:], obs[name].dtype
            noise = jax.vmap(jax.vmap(lambda key, s=shape, d=dtype: jax.random.normal(key, s, d)))(own)
            noisy[name] = obs[name] + std * noise
        return noisy


class Normalize(Wrapper):
    """Observe what has mean zero and variance one over all that worlds and drones have seen so far, at most ten.

    ``state.memory["Normalize"]`` holds the statistics, by name of what is observed. To fly a policy as it was trained,
    give them back: ``Normalize(env, stats)`` changes them no more.
    """

    def __init__(self, env: Env, stats: dict[str, RunningStats] | None = None):
        """Take the environment, and statistics that stay as they are; without any they are those of this run."""
        super().__init__(env)
        self.stats = stats

    def reset(self, key: Array) -> EnvState:
        """Return all worlds at the beginning of an episode.

        Raises:
            ConfigError: If the statistics that were given are of other observations.
        """
        state = self.env.reset(key)
        stats = self.stats or {name: RunningStats.create(x.shape[-1]) for name, x in state.obs.items()}
        if missing := set(state.obs) ^ set(stats):
            raise ConfigError(
                f"statistics and observations do not go together: {', '.join(sorted(missing))} is in one of them only"
            )
        return self._seen(state, stats)

    def restart(self, state: EnvState, mask: Array) -> EnvState:
        """Return the state with new episodes in the worlds of a mask. (n_worlds,)"""
        stats = self.recall(state)
        return self._normalized(self.env.restart(state, mask), stats)

    def step(self, state: EnvState, action: Array) -> EnvState:
        """Return the state one step later."""
        stats = self.recall(state)
        return self._seen(self.env.step(state, action), stats)

    def _seen(self, state: EnvState, stats: dict[str, RunningStats]) -> EnvState:
        if self.stats is None:
            stats = {name: stats[name].update(x) for name, x in state.obs.items()}
        return self._normalized(state, stats)

    def _normalized(self, state: EnvState, stats: dict[str, RunningStats]) -> EnvState:
        return self.remember(state, stats, obs={name: stats[name].normalize(x) for name, x in state.obs.items()})


class FrameStack(Wrapper):
    """Observe the last few observations, the oldest first, one behind the other in the last axis."""

    def __init__(self, env: Env, n: int):
        """Take the environment, and how many observations are seen at once."""
        super().__init__(env)
        self.n = positive("n", n)

    def reset(self, key: Array) -> EnvState:
        """Return all worlds at the beginning of an episode, its first observation seen as often as needed."""
        state = self.env.reset(key)
        return self._stacked(state, jax.tree.map(self._repeated, state.obs))

    def restart(self, state: EnvState, mask: Array) -> EnvState:
        """Return the state with new episodes in the worlds of a mask. (n_worlds,)"""
        old = self.recall(state)
        state = self.env.restart(state, mask)
        new = jax.tree.map(self._repeated, state.obs)
        return self._stacked(state, jax.tree.map(lambda x, y: select_worlds(mask, x, y), new, old))

    def step(self, state: EnvState, action: Array) -> EnvState:
        """Return the state one step later."""
        old = self.recall(state)
        state = self.env.step(state, action)
        frames = jax.tree.map(lambda x, y: jnp.concatenate([y[..., 1:, :], x[..., None, :]], axis=-2), state.obs, old)
        return self._stacked(state, frames)

    def _repeated(self, x: Array) -> Array:
        return jnp.repeat(x[..., None, :], self.n, axis=-2)

    def _stacked(self, state: EnvState, frames: Obs) -> EnvState:
        return self.remember(state, frames, obs=jax.tree.map(lambda x: x.reshape(*x.shape[:-2], -1), frames))


class ActionDelay(Wrapper):
    """Have actions take effect some environment steps late; until the first arrives, hover (action zero)."""

    def __init__(self, env: Env, n: int):
        """Take the environment, and by how many steps."""
        super().__init__(env)
        self.n = positive("n", n)

    def reset(self, key: Array) -> EnvState:
        """Return all worlds at the beginning of an episode."""
        state = self.env.reset(key)
        return self.remember(state, jnp.repeat(jnp.zeros_like(state.action)[:, None], self.n, axis=1))

    def restart(self, state: EnvState, mask: Array) -> EnvState:
        """Return the state with new episodes in the worlds of a mask. (n_worlds,)"""
        queue = select_worlds(mask, jnp.zeros((), state.action.dtype), self.recall(state))
        return self.remember(self.env.restart(state, mask), queue)

    def step(self, state: EnvState, action: Array) -> EnvState:
        """Return the state one step later."""
        queue, action = self.recall(state), fitting(action, state, self.actions)
        state = self.env.step(state, queue[:, 0])
        return self.remember(state, jnp.concatenate([queue[:, 1:], action[:, None]], axis=1))


class Randomize(Wrapper):
    """Begin every episode with other data: masses, motors, whatever a function draws.

    ``fn(data, keys) -> data`` is given one key per world, (n_worlds,). Parameters that it changes are one per drone:
    they are named in ``params``. It goes directly around the environment.
    """

    def __init__(self, env: Env, fn: Callable[[SimData, Array], SimData], params: tuple[str, ...] = ()):
        """Take the environment, what randomises it, and the parameters that it randomises.

        Raises:
            ConfigError: If the model has no such parameter, or there is another wrapper in between.
        """
        super().__init__(env)
        if isinstance(env, Wrapper):
            raise ConfigError(f"Randomize goes directly around the environment, not around {type(env).__name__}")
        known = vars(env.sim.data.params)
        if missing := [name for name in params if known.get(name) is None]:
            raise ConfigError(
                f"{env.sim.dynamics.value} has no parameter {', '.join(missing)}; it has {', '.join(known)}"
            )
        self.fn, self.params = fn, tuple(params)

    def reset(self, key: Array) -> EnvState:
        """Return all worlds at the beginning of an episode."""
        state = self.env.reset(key)
        data, shape = state.data, (self.sim.n_worlds, self.sim.n_drones)
        shared = {name: getattr(data.params, name) for name in self.params}
        shared = {k: x for k, x in shared.items() if getattr(scopes(data.params), k) == "shared"}
        params = data.params.replace(**{k: jnp.broadcast_to(x, (*shape, *x.shape)) for k, x in shared.items()})
        return self._randomized(state.replace(data=data.replace(params=params)), None)

    def restart(self, state: EnvState, mask: Array) -> EnvState:
        """Return the state with new episodes in the worlds of a mask. (n_worlds,)"""
        return self._randomized(self.env.restart(state, mask), mask)

    def _randomized(self, state: EnvState, mask: Array | None) -> EnvState:
        drawn = self.fn(state.data, episode_keys(state.data, "randomize"))
        self._check(state.data, drawn)
        data = map_batched(lambda x, new: select_worlds(mask, jnp.asarray(new, x.dtype), x), state.data, drawn)
        return state.replace(data=data, obs=observed(self.task, data), info=state.info | told(self.task, data))

    def _check(self, data: SimData, drawn: SimData) -> None:
        """Check that nothing was drawn that all worlds share, and that would be lost.

        Raises:
            ConfigError: If so, with its name.
        """
        axes = Axes(data)
        leaves = zip(axes.names, axes.scopes, jax.tree.leaves(data), jax.tree.leaves(drawn), strict=True)
        shared = [name for name, scope, x, new in leaves if scope in ("shared", "opaque") and new is not x]
        if shared:
            raise ConfigError(
                f"{', '.join(shared)} cannot be randomised: all worlds share it. Name parameters that are to be one "
                f"per drone in params=, as in Randomize(env, fn, params=('mass',))"
            )
