"""Phases of an environment step: act, (physics), observe, reset episode, look.

The phases become stages of the step: ``act`` before the physics, ``observe`` after it, and ``reset_episode`` where a
new episode begins. These three are written for one world; ``look`` takes the images of all worlds. ``Env.reset`` and
``Env.restart`` also call ``reset_episode`` and ``look``, for all worlds.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.tree_util import DictKey, keystr, tree_leaves_with_path, tree_map_with_path

from crazysim.core.data import SimData
from crazysim.core.functional import stage_command
from crazysim.engine.pytree import map_batched, select_worlds
from crazysim.engine.record import nonfinite_worlds
from crazysim.engine.stage import Phase, Stage, vmap_worlds
from crazysim.envs.actions import Actions
from crazysim.envs.episode_reset import EpisodeReset
from crazysim.envs.hooks import Hooks
from crazysim.envs.random import episode_key
from crazysim.envs.references import GUIDE
from crazysim.envs.reset_policy import ResetPolicy
from crazysim.envs.state import ENV_RECORD_NAME, EnvState, Obs
from crazysim.envs.task import TASK_RECORD_NAME, Task, sum_terms
from crazysim.errors import ConfigError, require

Vectorize = Callable[[Callable[..., Any], bool], Callable[..., Any]]
"""``vectorize(fn, batched)``: the function that a phase calls. This is ``fn`` itself if the phase runs in one world or
if ``batched`` is True (``fn`` takes all worlds), and otherwise ``fn`` mapped over all worlds."""


def skip_vectorization(fn: Callable[..., Any], batched: bool) -> Callable[..., Any]:
    """Return the function unchanged: the phase runs in one world."""
    del batched
    return fn


def vectorize_over_worlds(fn: Callable[..., Any], batched: bool) -> Callable[..., Any]:
    """Return the function mapped over all worlds, or unchanged if it already takes all worlds."""
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
    episode_length: int
    """Physics steps of an episode."""
    episode_reset: EpisodeReset
    """Resets of data at the start of an episode."""
    reset_policy: ResetPolicy | None = None
    """Rule by which new episodes begin within a step; None if steps begin no episodes."""
    measure_states: Callable[[SimData], SimData] | None = None
    """``measure_states(data)``: the data with measured states that the task observes, for one world, or for all worlds
    if the task is batched; None if the task observes the true states."""

    def stages(self, physics: Sequence[Stage], batched_reason: str | None) -> list[Stage]:
        """Return the stages of an environment step.

        Args:
            physics: Stages of a physics step.
            batched_reason: Reason why all phases need all worlds at once; None if phases run in one world.
        """

        def make_stage(
            name: str, fn: Callable[..., SimData], phase: Phase, unfused_reason: str | None, condition: Any = None
        ) -> Stage:
            if unfused_reason is None:
                return Stage(
                    functools.partial(fn, vectorize=skip_vectorization), "world", condition, name=name, phase=phase
                )
            return Stage(
                functools.partial(fn, vectorize=vectorize_over_worlds),
                "batch",
                name=name,
                phase=phase,
                unfused_reason=unfused_reason,
            )

        def must_reset(data: SimData) -> Array:
            return data.plugins[ENV_RECORD_NAME].must_reset

        # The flag of non-finite worlds is set before ``observe`` reads it and a new episode clears it.
        stages = [
            make_stage("act", self._act, "before", batched_reason),
            *physics,
            make_stage("flag nonfinite", _flag_nonfinite, "after", batched_reason),
            make_stage("observe", self._observe, "after", batched_reason),
        ]
        if self.reset_policy is not None:
            stages.append(
                make_stage(
                    "reset episode",
                    self._reset_episode,
                    "after",
                    batched_reason or self.episode_reset.batched_reason,
                    must_reset,
                )
            )
        if self.takes_images:
            reason = "images are taken by kernels with a lane for each ray"
            stages.append(Stage(self._look, "batch", name="look", phase="after", unfused_reason=reason))
        return stages

    @property
    def takes_images(self) -> bool:
        return any(type(wrapper).look is not Hooks.look for wrapper in self.wrappers)

    def _look(self, data: SimData) -> SimData:
        state_before, state = EnvState(data), self.look(EnvState(data))
        if "final_obs" in state.info:
            is_over = state_before.done[:, None, None]
            images = {name: jnp.where(is_over, state_before.obs[name], x) for name, x in state.record.images.items()}
            state = state.replace(info=state.info | {"final_obs": state.info["final_obs"] | images})
        return _restore_types(data, state)

    def look(self, state: EnvState) -> EnvState:
        """Return the state of all worlds with new images."""
        for wrapper in self.wrappers:
            state = wrapper.look(state)
        images = state.record.images
        if duplicates := images.keys() & state.record.obs.keys():
            raise ConfigError(
                f"expected different names for images and other observations, got {min(duplicates)!r} for both"
            )
        nonfinite = state.full_data.core.nonfinite[..., None]
        images = {name: jnp.where(nonfinite, jnp.zeros((), x.dtype), x) for name, x in images.items()}
        return state.replace(images=images)

    def _act(self, data: SimData, vectorize: Vectorize) -> SimData:
        state = EnvState(data)
        state, action = self.act(state, state.record.next_action, vectorize)
        return _restore_types(data, state.replace(next_action=action))

    def _observe(self, data: SimData, vectorize: Vectorize) -> SimData:
        state = EnvState(data)
        return _restore_types(data, self.after_physics(state, state.record.next_action, vectorize))

    def _reset_episode(self, data: SimData, vectorize: Vectorize) -> SimData:
        final_state, batched = EnvState(data), vectorize is vectorize_over_worlds
        default = (
            self.episode_reset.make_default(final_state.data)
            if batched
            else self.episode_reset.make_world_default(final_state.data)
        )
        new_state = self.reset_episode(final_state, default, vectorize)
        new_state = new_state if self.reset_policy is None else self.reset_policy.after_reset(final_state, new_state)
        return _restore_types(
            data,
            select_states(data.plugins[ENV_RECORD_NAME].must_reset[:, 0], new_state, final_state)
            if batched
            else new_state,
        )

    def step_without_physics(self, state: EnvState) -> EnvState:
        """Return the state of all worlds after a step without physics; it has the shapes and types of a full step."""
        state, action = self.act(state, state.record.next_action, vectorize_over_worlds)
        return self.after_physics(state, action, vectorize_over_worlds)

    def after_physics(self, state: EnvState, action: Array, vectorize: Vectorize) -> EnvState:
        """Return the result of ``observe``, with ``must_reset`` set where a new episode begins."""
        was_done = state.done
        state = self.observe(state, action, vectorize)
        if self.reset_policy is None:
            return state
        return self.reset_policy.after_step(state).replace(must_reset=self.reset_policy.must_reset(was_done, state))

    def act(self, state: EnvState, action: Array, vectorize: Vectorize) -> tuple[EnvState, Array]:
        """Return the state with the action's command staged, and the action as changed by the wrappers.

        Args:
            action: Action. (n_drones, k)
            vectorize: ``skip_vectorization`` or ``vectorize_over_worlds``.
        """
        for wrapper in reversed(self.wrappers):
            state, action = vectorize(wrapper.before_step, wrapper.batched)(state, action)
        data = self._apply(self.task, "before_step", vectorize)(state.data)
        return state.replace(data=stage_command(data, self.actions.command(action))), action

    def observe(self, state: EnvState, action: Array, vectorize: Vectorize) -> EnvState:
        """Return the state with observations, reward, ``terminated``, ``truncated`` and info of the step.

        Args:
            state: Result of ``act``, with the data after the physics.
            action: The action that ``act`` returned. (n_drones, k)
            vectorize: ``skip_vectorization`` or ``vectorize_over_worlds``.
        """
        task, episode_length = self.task, self.episode_length

        def evaluate(data: SimData, action: Array, last_action: Array) -> Any:
            reward = jnp.asarray(sum_terms(task.rewards(data, action, last_action)), action.dtype)
            return self._observe_task(data), reward, task.terminated(data), _step_info(task, data)

        def fill_results(state: EnvState, action: Array, results: Any) -> EnvState:
            obs, reward, terminated, info = results
            nonfinite = state.data.core.nonfinite
            return state.replace(
                obs=jax.tree.map(lambda x: jnp.where(nonfinite, jnp.zeros((), x.dtype), x), obs),
                reward=jnp.where(nonfinite, jnp.zeros((), reward.dtype), reward),
                terminated=terminated | nonfinite,
                truncated=state.data.core.steps >= episode_length,
                action=action,
                info=state.info | {"nonfinite": nonfinite} | info,
            )

        # Results of the task, zeros in worlds that are not finite.
        results = vectorize(evaluate, task.batched)(state.data, action, state.action)
        state = vectorize(fill_results, False)(state, action, results)
        state = vectorize(_end_bad_world, False)(state)
        # Changes of the results by wrappers.
        wrappers = [wrapper for wrapper in self.wrappers if type(wrapper).after_step is not Hooks.after_step]
        for wrapper in wrappers:
            state = vectorize(wrapper.after_step, wrapper.batched)(state)
        return vectorize(_end_bad_world, False)(state) if wrappers else state

    def reset_episode(self, state: EnvState, default: SimData, vectorize: Vectorize) -> EnvState:
        """Return the state at the start of an episode. Only data, info and memory of the earlier state are read.

        Args:
            default: Data that the world is reset to.
            vectorize: ``skip_vectorization`` or ``vectorize_over_worlds``.
        """
        task, shape = self.task, (self.n_drones, self.actions.size)
        # Data after the reset, with drones, goals and what wrappers place.
        reset_data = vectorize(self.episode_reset.reset_data, self.episode_reset.takes_all_worlds)(state.data, default)
        key = vectorize(lambda data: episode_key(data, f"spawn {task.name}"), False)(reset_data)
        data = self._apply(task, "spawn", vectorize)(reset_data, key)
        for wrapper in self.wrappers:
            data = self._apply(wrapper, "after_spawn", vectorize)(data)

        def fill_state(state: EnvState, obs: Obs, info: dict[str, Array]) -> EnvState:
            dtype = state.data.states.pos.dtype
            false = jnp.zeros((), bool)
            return state.replace(
                obs=obs,
                reward=jnp.zeros(shape[:1], dtype),
                terminated=false,
                truncated=false,
                action=jnp.zeros(shape, dtype),
                info=state.info | {"nonfinite": state.data.core.nonfinite} | info,
            )

        # Observations and info at the start.
        results = vectorize(lambda data: (self._observe_task(data), _step_info(task, data)), task.batched)(data)
        state = vectorize(fill_state, False)(state.replace(data=data), *results)
        for wrapper in self.wrappers:
            state = vectorize(wrapper.after_reset, wrapper.batched)(state)
        return state

    @staticmethod
    def _apply(owner: Task | Hooks, method: str, vectorize: Vectorize) -> Callable[..., SimData]:
        title = f"{'task' if isinstance(owner, Task) else 'wrapper'} {owner.name!r}: expected {method}"

        # Checked and broadcast before worlds are joined: a leaf without the axis of drones is of its own world.
        def apply(data: SimData, *args: Array) -> SimData:
            return _check_data(title, owner.batched, data, getattr(owner, method)(data, *args))

        return vectorize(apply, owner.batched)

    def _observe_task(self, data: SimData) -> Obs:
        return self.task.observe(data if self.measure_states is None else self.measure_states(data))


def _end_bad_world(state: EnvState) -> EnvState:
    obs, reward, core = state.record.obs, state.reward, state.data.core
    numbers = [reward, *(x for x in obs.values() if jnp.issubdtype(x.dtype, jnp.floating))]
    is_bad = functools.reduce(jnp.logical_or, [~jnp.isfinite(x).all() for x in numbers])
    nonfinite = core.nonfinite | is_bad
    return state.replace(
        data=state.data.replace(core=core.replace(nonfinite=nonfinite)),
        obs=jax.tree.map(lambda x: jnp.where(is_bad, jnp.zeros((), x.dtype), x), obs),
        reward=jnp.where(is_bad, jnp.zeros((), reward.dtype), reward),
        terminated=state.terminated | is_bad,
        info=state.info | {"nonfinite": nonfinite},
    )


def _flag_nonfinite(data: SimData, vectorize: Vectorize) -> SimData:
    del vectorize
    return data.replace(core=data.core.replace(nonfinite=nonfinite_worlds(data)))


def _restore_types(data: SimData, state: EnvState) -> SimData:
    if jax.tree.structure(state.full_data) != jax.tree.structure(data):
        return state.full_data  # the engine raises an error that names the change

    def cast(x: Any, template: Array) -> Array:
        return x if getattr(x, "dtype", None) == template.dtype else jnp.asarray(x, template.dtype)

    return jax.tree.map(cast, state.full_data, data)


def select_states(mask: Array | None, new_state: EnvState, old_state: EnvState) -> EnvState:
    """Return the new state in the worlds of a mask and the old state elsewhere. Shared leaves are of the new state.

    Args:
        mask: True where the new state is taken; None for all worlds. (n_worlds,)
        new_state: The new state of all worlds.
    """
    return map_batched(functools.partial(select_worlds, mask), new_state, old_state)


def _step_info(task: Task, data: SimData) -> dict[str, Array]:
    return {"error": task.error(data)} | task.info(data)


def _check_data(title: str, batched: bool, before: SimData, after: Any) -> SimData:
    # No step is compiled again then. Arrays of fewer axes are those of all drones, unless ``batched`` is True.
    require(
        isinstance(after, SimData),
        f"{title} to return the data that it gets with other values, got a {type(after).__name__}. End it with return "
        f"data.replace(...); {GUIDE} has an example.",
    )
    # The record must keep its structure.
    if jax.tree.structure(after) != jax.tree.structure(before):
        old_paths, new_paths = ({keystr(path) for path, _ in tree_leaves_with_path(data)} for data in (before, after))
        changes = ", ".join(
            [f"without {x}" for x in sorted(old_paths - new_paths)]
            + [f"with {x}" for x in sorted(new_paths - old_paths)]
        )
        raise ConfigError(
            f"{title} to return the data that it gets with other values, got a SimData "
            f"{changes or 'of another structure'}. The task's record is data.plugins['task'], which install adds; "
            f"{GUIDE} has an example."
        )

    # Arrays are broadcast to the shapes that they had.
    def fit(path: Any, x: Array, y: Any) -> Array:
        y = y if y is x else jnp.asarray(y, x.dtype)
        shape = jnp.shape(y)
        ends = zip(reversed(shape), reversed(x.shape), strict=False)
        remedy = (
            "Use x[..., None] for one number of each drone."
            if shape and shape == x.shape[:-1]
            else "Return one row for each drone, or one for all of them."
            if path[1:2] == (DictKey(TASK_RECORD_NAME),)
            else "A number that all drones share cannot differ between them there: add its plugin with one value for "
            "each drone."
        )
        require(
            (len(shape) in (0, x.ndim) if batched else len(shape) <= x.ndim) and all(m in (1, n) for m, n in ends),
            f"{title} to return {keystr(path)} of shape {x.shape}, got shape {shape}. {remedy}",
        )
        return y if y is x else jnp.broadcast_to(y, x.shape)

    return tree_map_with_path(fit, before, after)
