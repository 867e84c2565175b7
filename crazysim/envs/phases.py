"""Phases of an environment step: act, (physics), observe, and begin, which starts an episode.

Each is written for one world, and becomes a stage of the step: ``act`` before the physics, ``observe`` after it, and
``begin`` where an episode is over. Resets by the user call ``begin`` for all worlds. Tasks and hooks of wrappers are
called here and nowhere else.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.tree_util import keystr, tree_leaves_with_path

from crazysim.core.data import SimData
from crazysim.core.functional import stage_command
from crazysim.core.stage import Phase, Stage, vmap_worlds
from crazysim.core.stages import nonfinite_worlds
from crazysim.envs.actions import Actions
from crazysim.envs.hooks import Hooks
from crazysim.envs.random import episode_key
from crazysim.envs.reset_policy import ResetPolicy
from crazysim.envs.resets import Resets
from crazysim.envs.state import NAME, EnvState, Obs
from crazysim.envs.task import Task, total
from crazysim.errors import ConfigError
from crazysim.pytree import map_batched, select_worlds

Apply = Callable[[Callable[..., Any], bool], Callable[..., Any]]
"""``apply(fn, batched)``: the function as a phase calls it; ``batched`` for functions that take all worlds anyway."""


def one_world(fn: Callable[..., Any], batched: bool) -> Callable[..., Any]:
    """Return the function unchanged: the phase runs in one world."""
    del batched
    return fn


def all_worlds(fn: Callable[..., Any], batched: bool) -> Callable[..., Any]:
    """Return a function of all worlds."""
    return fn if batched else vmap_worlds(fn)


@dataclass(frozen=True)
class Phases:
    """The phases of an environment with its wrappers."""

    task: Task
    """The task."""
    actions: Actions
    """Meaning of an action."""
    wrappers: tuple[Hooks, ...]
    """Hooks of the wrappers, the innermost first."""
    n_drones: int
    """Drones in a world."""
    last_step: int
    """Physics steps of an episode."""
    resets: Resets
    """Resets of data at the start of an episode."""
    reset_policy: ResetPolicy | None = None
    """Rule by which new episodes begin within a step; None if none do."""
    measured: Callable[[SimData], SimData] | None = None
    """``measured(data)``: the data that the task observes, of one world, or of all if it is batched; None for the true
    ones."""

    def stages(self, physics: Sequence[Stage], batched: str | None) -> list[Stage]:
        """Return the stages of an environment step.

        Args:
            physics: Stages of a physics step.
            batched: Reason why all phases need all worlds at once; None if each is of one world.
        """

        def stage(name: str, fn: Callable[..., SimData], phase: Phase, why: str | None, when: Any = None) -> Stage:
            if why is None:
                return Stage(functools.partial(fn, apply=one_world), "world", when, name=name, phase=phase)
            return Stage(functools.partial(fn, apply=all_worlds), "batch", name=name, phase=phase, why=why)

        def over(data: SimData) -> Array:
            return data.plugins[NAME].over

        # Flagged first, so that the task can read it, and a new episode clears it.
        stages = [
            stage("act", self._act, "before", batched),
            *physics,
            stage("flag nonfinite", _flag_nonfinite, "after", batched),
            stage("observe", self._observe, "after", batched),
        ]
        if self.reset_policy is not None:
            stages.append(stage("begin", self._begin, "after", batched or self.resets.batched, over))
        return stages

    def _act(self, data: SimData, apply: Apply) -> SimData:
        state = EnvState(data)
        state, action = self.act(state, state.record.next_action, apply)
        return _as_before(data, state.replace(next_action=action))

    def _observe(self, data: SimData, apply: Apply) -> SimData:
        before = EnvState(data)
        return _as_before(data, self.after_physics(before, before.record.next_action, apply))

    def _begin(self, data: SimData, apply: Apply) -> SimData:
        ended, batched = EnvState(data), apply is all_worlds
        default = self.resets.default_of(ended.data) if batched else self.resets.default_of_world(ended.data)
        new = self.begin(ended, default, apply)
        new = new if self.reset_policy is None else self.reset_policy.begin(ended, new)
        return _as_before(data, select_states(data.plugins[NAME].over[:, 0], new, ended) if batched else new)

    def outline(self, state: EnvState) -> EnvState:
        """Return a state of all worlds with the structure, shapes and types that a step returns."""
        state, action = self.act(state, state.record.next_action, all_worlds)
        return self.after_physics(state, action, all_worlds)

    def after_physics(self, state: EnvState, action: Array, apply: Apply) -> EnvState:
        """Return the result of ``observe``, noting where a new episode begins."""
        was_done = state.done
        state = self.observe(state, action, apply)
        if self.reset_policy is None:
            return state
        return self.reset_policy.end(state).replace(over=self.reset_policy.is_over(was_done, state))

    def act(self, state: EnvState, action: Array, apply: Apply) -> tuple[EnvState, Array]:
        """Return the state with the action's command staged, and the action as the wrappers pass it on.

        Args:
            state: The state before the step.
            action: Action. (n_drones, k)
            apply: Caller of functions of one world.
        """
        for wrapper in reversed(self.wrappers):
            state, action = apply(wrapper.before_step, wrapper.batched)(state, action)
        data = apply(self.task.before_step, self.task.batched)(state.data)
        return state.replace(data=stage_command(data, self.actions.command(action))), action

    def observe(self, state: EnvState, action: Array, apply: Apply) -> EnvState:
        """Return the state after the physics: observations, reward and the end of the episode.

        Args:
            state: Result of ``act``, with the data after the physics.
            action: The action that ``act`` returned. (n_drones, k)
            apply: Caller of functions of one world.
        """
        task, last_step = self.task, self.last_step

        def evaluate(data: SimData, action: Array, last_action: Array) -> Any:
            reward = jnp.asarray(total(task.rewards(data, action, last_action)), action.dtype)
            return self._observed(data), reward, task.terminated(data), _step_info(task, data)

        def conclude(state: EnvState, action: Array, results: Any) -> EnvState:
            obs, reward, terminated, info = results
            nonfinite = state.data.core.nonfinite
            return state.replace(
                obs=jax.tree.map(lambda x: jnp.where(nonfinite, jnp.zeros((), x.dtype), x), obs),
                reward=jnp.where(nonfinite, jnp.zeros((), reward.dtype), reward),
                terminated=terminated | nonfinite,
                truncated=state.data.core.steps >= last_step,
                action=action,
                info=state.info | {"nonfinite": nonfinite} | info,
            )

        results = apply(evaluate, task.batched)(state.data, action, state.action)
        state = apply(conclude, False)(state, action, results)
        for wrapper in self.wrappers:
            state = apply(wrapper.after_step, wrapper.batched)(state)
        return state

    def begin(self, state: EnvState, default: SimData, apply: Apply) -> EnvState:
        """Return the state at the start of an episode; of the state before, only data, info and memory are read.

        Args:
            state: The state before.
            default: Data that the world is reset to.
            apply: Caller of functions of one world.
        """
        task, shape = self.task, (self.n_drones, self.actions.size)
        before = apply(self.resets.data, self.resets.batched_pipeline)(state.data, default)
        key = apply(lambda data: episode_key(data, f"spawn {task.name}"), False)(before)
        data = apply(task.spawn, task.batched)(before, key)
        for wrapper in self.wrappers:
            data = apply(wrapper.after_spawn, wrapper.batched)(data)
        data = _like(task, before, data)

        def start(state: EnvState, obs: Obs, info: dict[str, Array]) -> EnvState:
            dtype = state.data.states.pos.dtype
            over = jnp.zeros((), bool)
            return state.replace(
                obs=obs,
                reward=jnp.zeros(shape[:1], dtype),
                terminated=over,
                truncated=over,
                action=jnp.zeros(shape, dtype),
                info=state.info | {"nonfinite": state.data.core.nonfinite} | info,
            )

        seen = apply(lambda data: (self._observed(data), _step_info(task, data)), task.batched)(data)
        state = apply(start, False)(state.replace(data=data), *seen)
        for wrapper in self.wrappers:
            state = apply(wrapper.after_reset, wrapper.batched)(state)
        return state

    def _observed(self, data: SimData) -> Obs:
        """Return the observations of the task, of measured states if it is to get these."""
        return self.task.observe(data if self.measured is None else self.measured(data))


def _flag_nonfinite(data: SimData, apply: Apply) -> SimData:
    """Return the data with worlds flagged that are not finite, which holds for one world and for all."""
    del apply
    return data.replace(core=data.core.replace(nonfinite=nonfinite_worlds(data)))


def _as_before(data: SimData, state: EnvState) -> SimData:
    """Return the data of a state with the types of the data before."""
    if jax.tree.structure(state.whole) != jax.tree.structure(data):
        return state.whole  # the engine refuses it, and says what has changed

    def cast(new: Any, old: Array) -> Array:
        return new if getattr(new, "dtype", None) == old.dtype else jnp.asarray(new, old.dtype)

    return jax.tree.map(cast, state.whole, data)


def select_states(mask: Array | None, new: EnvState, old: EnvState) -> EnvState:
    """Return one state in the worlds of a mask, and another elsewhere; leaves that worlds share are the new ones.

    Args:
        mask: True where the new state is taken; None for all. (n_worlds,)
        new: State of the worlds in the mask.
        old: State of the others.
    """
    return map_batched(functools.partial(select_worlds, mask), new, old)


def _step_info(task: Task, data: SimData) -> dict[str, Array]:
    return {"error": task.error(data)} | task.info(data)


def _like(task: Task, old: SimData, new: Any) -> SimData:
    """Return the data of a start with the shapes and types of before: of another type, a step would compile again.

    Raises:
        ConfigError: If it has other leaves.
    """
    if jax.tree.structure(new) != jax.tree.structure(old):
        had, has = ({keystr(path) for path, _ in tree_leaves_with_path(data)} for data in (old, new))
        what = ", ".join([f"without {x}" for x in sorted(had - has)] + [f"with {x}" for x in sorted(has - had)])
        raise ConfigError(
            f"task {task.name!r}: expected spawn to return the data that it is given with other values, got a "
            f"{type(new).__name__} {what or 'of another structure'}. The task's record is data.plugins['task']; "
            f"docs/guides/tasks.md has an example."
        )
    return jax.tree.map(lambda x, y: y if y is x else jnp.broadcast_to(jnp.asarray(y, x.dtype), x.shape), old, new)
