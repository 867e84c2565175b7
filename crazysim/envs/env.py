"""An environment: a simulation, a task, and what an action means, as pure functions of one state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.settings import positive
from crazysim.core.sharding import shard
from crazysim.core.stage import Stage
from crazysim.engine import fused
from crazysim.engine.rollout import COMMANDS
from crazysim.envs.actions import Actions, actions_of
from crazysim.envs.random import episode_keys
from crazysim.errors import ConfigError
from crazysim.pytree import PyTree, map_batched, scopes, select_worlds
from crazysim.sim.sim import Sim

Obs = dict[str, Array]
"""Named observations. (n_worlds, n_drones, k) each"""


@dataclass(frozen=True)
class Task:
    """What is to be done: plain functions of the data of all worlds, each exchanged with ``dataclasses.replace``."""

    name: str
    """What messages and files call it."""
    spawn: Callable[[SimData, Array], SimData]
    """``spawn(data, keys)``: where an episode begins, goals included, from one key per world, (n_worlds,)."""
    observe: Callable[[SimData], Obs]
    """What a policy is told. (n_worlds, n_drones, k) each"""
    reward: Callable[[SimData, Array, Array], Array]
    """``reward(data, action, last_action)`` of an environment step. (n_worlds, n_drones)"""
    terminated: Callable[[SimData], Array]
    """Whether an episode is over because of what happened in it. (n_worlds,)"""
    error: Callable[[SimData], Array]
    """How far a drone is from what it is asked to do, m unless the task says otherwise. (n_worlds, n_drones)"""
    info: Callable[[SimData], dict[str, Array]] = lambda data: {}  # noqa: ARG005
    """What else is told of an episode. (n_worlds,) or (n_worlds, n_drones, ...) each"""
    target: Callable[[SimData], Array] | None = None
    """Where a drone is to be, for pictures, m. (n_worlds, n_drones, 3)"""
    camera: Mapping[str, Any] | None = None
    """From where pictures are taken: lookat, distance, azimuth, elevation."""
    mark: Callable[[SimData], SimData] = lambda data: data
    """What is noted where an environment step begins, for rewards of what changes in it."""
    succeeded: Callable[[SimData], Array] | None = None
    """Whether it is done, for tasks that end with that; None where the error must stay small. (n_worlds, n_drones)"""
    seconds: float = 5.0
    """Length of an episode, s."""
    tolerance: float = 0.05
    """Error below which the task counts as done, m."""
    hold: float = 1.0
    """Time at the end of an episode for which the error must stay below the tolerance, s."""
    settings: dict[str, Any] = field(default_factory=dict)
    """What the task was made with, as it is written into checkpoints."""


class EnvState(PyTree):
    """An environment at one moment: what ``step`` takes and returns."""

    data: SimData
    """The simulation."""
    obs: Obs
    """What a policy is told. (n_worlds, n_drones, k) each"""
    reward: Array
    """Reward of the step that led here. (n_worlds, n_drones)"""
    terminated: Array
    """Whether the episode is over because of what happened. (n_worlds,)"""
    truncated: Array
    """Whether its time is over. (n_worlds,)"""
    action: Array
    """The action that led here; zeros where an episode begins. (n_worlds, n_drones, k)"""
    info: dict[str, Any]
    """What else there is to tell. (n_worlds,) or (n_worlds, n_drones, ...) each"""
    memory: dict[str, Any]
    """What wrappers remember, each under its name."""

    @property
    def done(self) -> Array:
        """Whether the episode is over. (n_worlds,)"""
        return self.terminated | self.truncated


class Env(Protocol):
    """What every environment offers, wrapped or not. All three functions are pure, for jit, scan, vmap and grad."""

    @property
    def sim(self) -> Sim:
        """The simulation it was made from; it is drawn with, and does not advance."""
        ...

    @property
    def task(self) -> Task:
        """What is to be done."""
        ...

    @property
    def actions(self) -> Actions:
        """What an action means."""
        ...

    @property
    def n_substeps(self) -> int:
        """Physics steps in one environment step."""
        ...

    @property
    def max_steps(self) -> int:
        """Environment steps in one episode."""
        ...

    def reset(self, key: Array) -> EnvState:
        """Return all worlds at the beginning of an episode."""
        ...

    def restart(self, state: EnvState, mask: Array) -> EnvState:
        """Return the state with new episodes in the worlds of a mask, and the others as they are. (n_worlds,)"""
        ...

    def step(self, state: EnvState, action: Array) -> EnvState:
        """Return the state one environment step later. (n_worlds, n_drones, k)"""
        ...


class DroneEnv:
    """Many worlds of one task. Episodes that are over go on; ``wrappers.AutoReset`` begins new ones."""

    def __init__(self, sim: Sim, task: Task, freq: int = 50, actions: Actions | None = None):
        """Take a simulation as the task's maker has furnished it.

        Args:
            sim: The simulation; ``sim.default_data`` is what episodes begin from, before ``task.spawn``.
            task: What is to be done.
            freq: Environment steps per second, Hz; divides the simulation's.
            actions: What an action means; None for ``actions_of``.

        Raises:
            ConfigError: If a rate does not divide, or commands would be taken over less often than they come.
        """
        freq = positive("freq", freq)
        if sim.freq % freq:
            raise ConfigError(f"the environment's freq of {freq} Hz does not divide the simulation's {sim.freq} Hz")
        if sim.control_freq % freq:
            raise ConfigError(
                f"actions come at {freq} Hz and {sim.control.value} commands are taken over at {sim.control_freq} Hz, "
                f"so not every action would be heeded; choose a freq that divides {sim.control_freq}"
            )
        self.sim, self.task, self.freq = sim, task, freq
        self.actions = actions_of(sim.airframe, sim.data.params, sim.control) if actions is None else actions
        self.n_substeps = sim.freq // freq
        self.max_steps = round(task.seconds * freq)
        self._step, self._reset = sim.build_step_fn(), sim.build_reset_fn().__wrapped__
        self.zeros = self._step.zeros(sim.data)
        self._default = _compact(sim.default_data)

    def reset(self, key: Array) -> EnvState:
        """Return all worlds at the beginning of an episode; the same key, the same episodes.

        Args:
            key: Random key, as ``jax.random.key`` makes. ()
        """
        shape = (self.sim.n_worlds, self.sim.n_drones)
        if not isinstance(key, jax.core.Tracer):
            key = jax.device_put(key, self.sim.device)
        data = _spread(self._default, *shape)
        data = data.replace(core=data.core.replace(rng_key=key))
        data = self._begin(data, None)
        zeros = jnp.zeros(shape, data.states.pos.dtype)
        over = jnp.zeros(shape[:1], bool)
        action = jnp.zeros((*shape, self.actions.size), zeros.dtype)
        if self.sim.mesh is not None:
            data = shard(data, self.sim.mesh)
        return EnvState(data, observed(self.task, data), zeros, over, over, action, told(self.task, data), {})

    def restart(self, state: EnvState, mask: Array) -> EnvState:
        """Return the state with new episodes in some worlds.

        Args:
            state: Where all worlds are.
            mask: Which begin anew. (n_worlds,)
        """
        data = self._begin(state.data, mask)
        over = state.terminated & ~mask
        return state.replace(
            data=data,
            obs=observed(self.task, data),
            reward=select_worlds(mask, jnp.zeros((), state.reward.dtype), state.reward),
            terminated=over,
            truncated=state.truncated & ~mask,
            action=select_worlds(mask, jnp.zeros((), state.action.dtype), state.action),
            info=state.info | told(self.task, data),
        )

    def step(self, state: EnvState, action: Array) -> EnvState:
        """Return the state after one action in every world.

        A world that turns non-finite terminates, says so in ``info["nonfinite"]``, and is observed as zeros.

        Args:
            state: Where all worlds are.
            action: What every drone does, clipped to [-1, 1]. (n_worlds, n_drones, k)

        Raises:
            ValueError: If the action has another shape.
        """
        action = fitting(action, state, self.actions)
        data = COMMANDS[self.actions.control](self.task.mark(state.data), self.actions.command(action))
        data = self.fly(data)
        lost = data.core.nonfinite[:, 0]
        reward = jnp.asarray(self.task.reward(data, action, state.action), action.dtype)
        return state.replace(
            data=data,
            obs=observed(self.task, data),
            reward=select_worlds(lost, jnp.zeros((), reward.dtype), reward),
            terminated=self.task.terminated(data) | lost,
            truncated=data.core.steps[:, 0] >= self.max_steps * self.n_substeps,
            action=action,
            info=state.info | told(self.task, data),
        )

    def fly(self, data: SimData) -> SimData:
        """Return the data after the physics of an environment step."""
        return self._step(data, self.n_substeps, self.zeros)

    @property
    def unfused(self) -> str | None:
        """Why its physics runs in no kernel, as far as that is known before it is read; None if it may."""
        if self._step.engine not in ("auto", "fused"):
            return f"the engine is {self._step.engine!r}"
        return fused.missing(self._step.platform)

    @property
    def stages(self) -> list[Stage]:
        """Stages of its physics."""
        return self._step.stages

    def _begin(self, data: SimData, mask: Array | None) -> SimData:
        default = _like(self._default, data)
        data = self._reset(data, default, mask)
        spawned = self.task.spawn(data, episode_keys(data, f"spawn {self.task.name}"))
        # Numbers of Python's are weakly typed; a state of another type would have the next step compiled anew.
        return map_batched(lambda x, new: select_worlds(mask, jnp.asarray(new, x.dtype), x), data, spawned)


def observed(task: Task, data: SimData) -> Obs:
    """Return what a policy is told: zeros in worlds that are not finite. (n_worlds, n_drones, k) each"""
    lost = data.core.nonfinite[:, 0]
    return jax.tree.map(lambda x: select_worlds(lost, jnp.zeros((), x.dtype), x), task.observe(data))


def told(task: Task, data: SimData) -> dict[str, Array]:
    """Return what else is told: which worlds are not finite, the error, and what the task adds."""
    return {"nonfinite": data.core.nonfinite[:, 0], "error": task.error(data)} | task.info(data)


def flatten(obs: Obs) -> Array:
    """Return named observations one behind the other, by name. (..., n_obs)"""
    return jnp.concatenate([obs[name] for name in sorted(obs)], axis=-1)


def from_host(actions: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return actions of the host for all worlds, checked. (n_worlds, ...)

    Raises:
        ConfigError: If they are not finite, with the first few worlds where.
        ValueError: If they have another shape.
    """
    actions = np.asarray(actions, np.float32)
    if actions.shape != shape:
        raise ValueError(f"actions have shape {actions.shape}; needed is {shape}")
    if not np.all(np.isfinite(actions)):
        worlds = np.unique(np.nonzero(~np.isfinite(actions))[0])[:8]
        raise ConfigError(f"the action is NaN or infinite in world(s) {worlds.tolist()}")
    return actions


def fitting(action: Array, state: EnvState, actions: Actions) -> Array:
    """Return an action in the type of the state's, or say which shape it must have.

    Raises:
        ValueError: If it has another shape.
    """
    if jnp.shape(action) != state.action.shape:
        raise ValueError(
            f"action has shape {jnp.shape(action)}; this environment needs {state.action.shape} = "
            f"(n_worlds, n_drones, {actions.size}): {actions}"
        )
    return jnp.asarray(action, state.action.dtype)


def _compact(data: SimData) -> SimData:
    """Return the data with one world and drone in place of all where they are alike, as arrays of the host."""

    def one(scope: str, x: Any) -> Any:
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            return x
        x = np.asarray(x)
        for axis in range({"drone": 2, "world": 1}.get(scope, 0)):
            first = x.take([0], axis)
            if np.array_equal(x, np.broadcast_to(first, x.shape)):
                x = first
        return x

    return jax.tree.map(one, scopes(data), data)


def _spread(data: SimData, n_worlds: int, n_drones: int) -> SimData:
    """Return the data with all worlds and drones again."""
    shapes = {"drone": (n_worlds, n_drones), "world": (n_worlds, 1)}

    def all_of(scope: str, x: Any) -> Any:
        shape = shapes.get(scope, ())
        return jnp.broadcast_to(x, (*shape, *x.shape[len(shape) :])) if shape else x

    return jax.tree.map(all_of, scopes(data), data)


def _like(default: SimData, data: SimData) -> SimData:
    """Return the default data, whatever is no number of a world exchanged for what the data has."""
    own = {name: getattr(data.core, name) for name in ("rng_key", "world_id", "drone_id", "n_worlds")}
    return default.replace(core=default.core.replace(**own))
