"""Environments: a simulation, a task and the meaning of actions, as pure functions of one state."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable
from operator import is_
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from crazysim.arguments import check_flag
from crazysim.core.data import SimCore, SimData
from crazysim.core.plugin import Plugin
from crazysim.core.settings import as_mask, positive_integer
from crazysim.eager import is_traced
from crazysim.engine.jaxcompat import require_unforked_process
from crazysim.engine.pytree import leaf_indices
from crazysim.engine.sharding import put_on_device, shard, use_device_of
from crazysim.engine.stage import vmap_worlds
from crazysim.engine.step import FlatData, Step
from crazysim.engine.tools.explain import explain
from crazysim.envs.actions import Actions
from crazysim.envs.episode_reset import EpisodeReset
from crazysim.envs.hooks import Hooks
from crazysim.envs.phases import Phases, select_states, vectorize_over_worlds
from crazysim.envs.random import check_key
from crazysim.envs.reset_policy import ResetPolicy
from crazysim.envs.state import ENV_RECORD_NAME, RESULT_FIELDS, EnvState, state_of_data, validate_action, validate_goals
from crazysim.envs.task import Task
from crazysim.envs.task_check import check_record, check_task, require_finite_start, require_installed
from crazysim.errors import ConfigError, expect, require
from crazysim.sim.configuration import describe_data
from crazysim.sim.sim import Sim


class Env(ABC):
    """A batched environment of many worlds, wrapped or not. Its functions are pure, for jit, scan, vmap and grad.

    A step has these phases: ``act`` stages the command of an action, the physics advances the simulation, ``observe``
    evaluates the task, ``reset_episode`` starts a new episode where one is over (only inside ``AutoReset``), and
    ``look`` takes images if a wrapper needs them.
    """

    @property
    @abstractmethod
    def base(self) -> DroneEnv:
        """The environment without wrappers."""

    @property
    @abstractmethod
    def wrappers(self) -> tuple[Hooks, ...]:
        """All wrappers of the environment, the innermost first; a wrapper is the last of its own ``wrappers``."""

    @property
    def sim(self) -> Sim:
        """The simulation from which the environment was made. It renders states; ``step`` does not advance it."""
        return self.base._sim

    @property
    def task(self) -> Task:
        """The task."""
        return self.base._task

    @property
    def actions(self) -> Actions:
        """Meaning of an action."""
        return self.base._actions

    @property
    def n_substeps(self) -> int:
        """Physics steps in one environment step."""
        return self.base._n_substeps

    @property
    def max_steps(self) -> int:
        """Environment steps in one episode."""
        return self.base._max_steps

    def image_formats(self) -> dict[str, dict[str, Any]]:
        """Return the formats of observations that are images, by name; see ``Hooks.describe_images``."""
        return {name: entries for wrapper in self.wrappers for name, entries in wrapper.describe_images().items()}

    @functools.cached_property
    def observation_sizes(self) -> dict[str, int]:
        """Sizes of the observations by name, in alphabetical order."""
        shapes = jax.eval_shape(self.reset, jax.random.key(0)).obs
        return {name: shapes[name].shape[-1] for name in sorted(shapes)}

    @property
    def reset_policy(self) -> ResetPolicy | None:
        """Rule by which new episodes begin within a step; None if steps begin no episodes."""
        return None

    @functools.cached_property
    def phases(self) -> Phases:
        """The phases of an environment step."""
        base = self.base
        return Phases(
            self.task,
            self.actions,
            self.wrappers,
            base.sim.n_drones,
            self.max_steps * self.n_substeps,
            base.episode_reset,
            self.reset_policy,
            base.measure_states,
        )

    @functools.cached_property
    def step_fn(self) -> Step:
        """The engine's step that ``step`` calls: the stages of the physics and of the phases."""
        batched_parts = [f"wrapper {wrapper.name!r}" for wrapper in self.wrappers if wrapper.batched]
        batched_parts += [f"task {self.task.name!r}"] if self.task.batched else []
        batched_reason = f"{', '.join(batched_parts)} is declared to need all worlds at once" if batched_parts else None
        if self.base.episode_reset.has_foreign_record:
            batched_reason = "a record in data.plugins is of another library and is not divided among worlds"
        # No parameter is known to be zero: a later episode may have other parameters.
        stages = self.phases.stages(self.base.physics.stages, batched_reason)
        return self.base.physics.with_stages(stages).with_zeros_of(None)

    def reset(self, key: Array) -> EnvState:
        """Start an episode in all worlds; the same key gives the same episodes.

        Args:
            key: Random key of ``jax.random.key`` for all worlds, (), or one key for each of several blocks of worlds,
                (n_blocks,). All blocks have the same number of worlds. A block gets the same episodes as an environment
                of that number of worlds that is reset with the block's key.

        Raises:
            ConfigError: If the number of keys does not divide the number of worlds, or if the task begins in a state
                that is not finite. A compiled reset, such as ``jax.jit(env.reset)``, cannot raise an error for such a
                state: the episode then ends at its first step, with ``info["nonfinite"]``.
        """
        require_unforked_process()
        check_key(key)
        key = put_on_device(key, self.sim.device) if self.sim.mesh is None else key
        with use_device_of(key):
            data = self.base.initial_data(key)
            for wrapper in self.wrappers:
                data = wrapper.prepare(data)
            state = self._add_step_results(self._reset_episodes(state_of_data(data, self.task.name)))
        self._known_structures.add(jax.tree.structure(state))
        if not is_traced([state.full_data.states.pos]):
            state = EnvState(put_on_device(state.full_data, self.sim.device)) if self.sim.mesh is None else state
            require_finite_start(self.task, state)
        return state

    def restart(self, state: EnvState, mask: Array | None) -> EnvState:
        """Start new episodes in some worlds.

        Args:
            mask: True where a new episode begins; None for all worlds. (n_worlds,)
        """
        steps = state.full_data.core.steps
        with use_device_of(steps):
            mask = as_mask(mask, steps.shape[:1])
            new_state = self._reset_episodes(state)
            new_state = new_state if self.reset_policy is None else self.reset_policy.after_step(new_state)
            return select_states(mask, new_state, state)

    def set_goal(self, state: EnvState, pos: ArrayLike) -> EnvState:
        """Return the state with new goals, which apply from the next step until the end of the episode.

        The observations in the returned state are unchanged; the next step observes the new goals.

        Args:
            pos: Goals, world frame, m: one for all drones (3,), one per world (n_worlds, 3), or one per drone
                (n_worlds, n_drones, 3); an axis of worlds or drones may have length 1.
        """
        with use_device_of(state.full_data.core.steps):
            pos = validate_goals(pos, state)
            state = state.replace(data=vectorize_over_worlds(self.task.set_goal, self.task.batched)(state.data, pos))
        return state if self.sim.mesh is None else EnvState(shard(state.full_data, self.sim.mesh))

    def step(self, state: EnvState, action: Array) -> EnvState:
        """Advance all worlds by one environment step. With ``AutoReset``, worlds that are done begin a new episode.

        A world that becomes non-finite, also in an observation or its reward, terminates, sets ``info["nonfinite"]``,
        and is observed as zeros.

        Args:
            action: Action of every drone. Its command is limited to [-1, 1]; rewards see it as it is passed.
                (n_worlds, n_drones, k)
        """
        self._check_state(state)
        with use_device_of(state.full_data.core.steps):
            action = validate_action(action, self._action_format, self.actions)
            data = self.step_fn(state.replace(next_action=action).full_data, self.n_substeps)
            return EnvState(data).replace(next_action=state.record.next_action)

    def flatten(self, state: EnvState) -> FlatData:
        """Flatten the state for ``advance``, which is faster in a loop than ``step``."""
        self._check_state(state)
        record = leaf_indices(state.full_data).plugins[ENV_RECORD_NAME]
        outputs = jax.tree.leaves([getattr(record, name) for name in RESULT_FIELDS])
        return self.step_fn.flatten(state.full_data, self.n_substeps, frozenset(outputs))

    def advance(self, flat: FlatData, action: Array) -> FlatData:
        """Advance flat data by one environment step; ``EnvState(flat.data())`` is the state of flat data.

        Args:
            flat: Result of ``flatten`` or ``advance``.
            action: Action of every drone, as in ``step``. (n_worlds, n_drones, k)
        """
        self.step_fn.require_own(flat)
        i = flat.plan.leaf_indices.plugins[ENV_RECORD_NAME].next_action
        action = validate_action(action, self._action_format, self.actions)
        return self.step_fn.advance(flat.replace([i], [action]), self.n_substeps)

    def _check_state(self, state: EnvState) -> None:
        expect(isinstance(state, EnvState), "a state of this environment", state, "Use env.reset(key).")
        structure = jax.tree.structure(state)
        if structure in self._known_structures:
            return
        expected = jax.eval_shape(self.reset, jax.random.key(0))
        require(
            structure in self._known_structures,
            f"expected a state of this environment, {_describe_state(expected)}, got one of "
            f"{_describe_state(state)}. Use the reset of this environment.",
        )

    @functools.cached_property
    def _action_format(self) -> jax.ShapeDtypeStruct:
        shape = self.sim.n_worlds, self.sim.n_drones, self.actions.size
        return jax.ShapeDtypeStruct(shape, self.sim.default_data.states.pos.dtype)

    @functools.cached_property
    def _known_structures(self) -> set[Any]:
        return set()

    def _reset_episodes(self, state: EnvState) -> EnvState:
        state = self.phases.reset_episode(
            state, self.base.episode_reset.make_default(state.data), vectorize_over_worlds
        )
        if self.phases.takes_images:
            state = self.phases.look(state)
            state = state.replace(info={name: x for name, x in state.info.items() if name != "final_obs"})
        return state if self.sim.mesh is None else EnvState(shard(state.full_data, self.sim.mesh))

    def _add_step_results(self, state: EnvState) -> EnvState:
        state = state if self.reset_policy is None else self.reset_policy.after_step(state)
        state = state.replace(next_action=jnp.zeros_like(state.action), must_reset=jnp.zeros_like(state.terminated))
        leaves, treedef = jax.tree.flatten(state)
        key = (treedef, tuple([(x.shape, x.dtype) for x in leaves]))
        if key not in self._stepped_shapes:
            self._stepped_shapes[key] = jax.eval_shape(self.phases.step_without_physics, state)
        stepped = self._stepped_shapes[key]
        added_info = {k: x for k, x in stepped.info.items() if k not in state.info}
        state = state.replace(info=state.info | jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), added_info))
        check_record(state, stepped)
        return state

    @functools.cached_property
    def _stepped_shapes(self) -> dict[Any, EnvState]:
        return {}

    def explain(self) -> str:
        """Explain how a step is executed, as ``Sim.explain`` does for a step of the physics."""
        state = jax.eval_shape(self.reset, jax.random.key(0))
        step, rays = explain(self.step_fn, state.full_data), self.sim.scene.ray_kernels.last_used
        return f"{step}\nrays: {rays}" if rays else step

    def target(self, state: EnvState) -> Array | None:
        """Return the target position of each drone, or several marks per drone, to draw in images, m; None if none.

        Returns:
            (n_worlds, n_drones, 3) or (n_worlds, n_drones, n_marks, 3)
        """
        return self._evaluate_task(self.task.target, state)

    def rings(self, state: EnvState) -> Array | None:
        """Return rings to draw in images: middle, m, axis, and radius, m; None if the task has none.

        Returns:
            (n_worlds, n_rings, 7)
        """
        return self._evaluate_task(self.task.rings, state)

    def subjects(self, state: EnvState) -> Array | None:
        """Return points that films keep in view besides drones and marks, m; None if the task has none.

        Returns:
            (n_worlds, n_points, 3)
        """
        return self._evaluate_task(self.task.subjects, state)

    def succeeded(self, state: EnvState) -> Array | None:
        """Whether a drone has succeeded; None if the task defines success by an error that stays small.

        Returns:
            (n_worlds, n_drones)
        """
        return self._evaluate_task(self.task.succeeded, state)

    def _evaluate_task(self, fn: Callable[[SimData], Any], state: EnvState) -> Any:
        return vectorize_over_worlds(fn, self.task.batched)(state.data)


class DroneEnv(Env):
    """Environment of many worlds with one task. Without ``AutoReset``, an episode that is over continues."""

    def __init__(self, sim: Sim, task: Task, freq: int = 50, actions: Actions | None = None, measured: bool = False):
        # Rates that divide each other.
        freq = positive_integer("freq", freq)
        require_installed(sim, task)
        require(
            sim.freq % freq == 0,
            f"expected an environment freq that divides the simulation's {sim.freq} Hz, got {freq} Hz. Use a divisor.",
        )
        require(
            sim.control_freq % freq == 0,
            f"expected a freq that divides the rate of {sim.control.value} commands, {sim.control_freq} Hz, got "
            f"{freq} Hz: some actions would never reach the controller. Use a divisor.",
        )
        expect(
            actions is None or isinstance(actions, Actions),
            "actions as Actions",
            actions,
            "Use None for the usual ones of the command level.",
        )
        self._sim, self._task, self.freq = sim, task, freq
        self._actions = task.actions(sim) if actions is None else actions
        check_task(task, sim.default_data, self._actions.size)
        self.measure_states: Callable[[SimData], SimData] | None = None
        """``measure_states(data)``: the data with measured states, for one world, or for all worlds if the task is
        batched; None if the task observes the true states."""
        # Measured states in place of the true ones.
        if check_flag("measured", measured):
            require(
                any(type(plugin).measured_states is not Plugin.measured_states for plugin in sim.plugins.values()),
                "expected a simulation with a sensor of states for measured=True, got none. Use "
                "sim.add(MotionCapture()) before the environment is made, or make(..., sensors=[MotionCapture()]).",
            )
            measure_world = sim.plugins.measured_states
            self.measure_states = vmap_worlds(measure_world) if task.batched else measure_world
        # Length of a step and of an episode.
        self._n_substeps = sim.freq // freq
        self._max_steps = round(task.seconds * freq)
        require(
            self._max_steps >= 1,
            f"expected an episode of at least one environment step, got seconds={task.seconds} at {freq} Hz. Use "
            f"seconds={1 / freq:g} or more.",
        )
        sim.plugins.check()
        require(
            ENV_RECORD_NAME not in sim.plugins,
            f"expected no plugin of the name {ENV_RECORD_NAME!r}, which is the name of the environment's record",
        )
        self.physics = sim.build_step_fn().without_stages(sim.plugins.reset_stages)  # every episode begins with a reset
        """The step of the physics."""
        self.episode_reset = EpisodeReset(sim)
        """Resets of data at the start of an episode."""
        self._plugins, self._default_arrays = tuple(sim.plugins.values()), _default_arrays(sim)
        sim.scene.environment = task.name

    @property
    def base(self) -> DroneEnv:
        return self

    @property
    def wrappers(self) -> tuple[Hooks, ...]:
        return ()

    def initial_data(self, key: Array) -> SimData:
        """Return the data of all worlds before their first episode, with the random key or keys of ``reset``."""
        plugins, arrays = tuple(self._sim.plugins.values()), _default_arrays(self._sim)
        if [*map(id, plugins)] != [*map(id, self._plugins)]:
            names = ", ".join(plugin.name for plugin in self._plugins)
            raise ConfigError(
                f"expected the plugins with which the environment was made ({names or 'none'}), got "
                f"{', '.join(plugin.name for plugin in plugins) or 'none'}: an environment does not follow "
                f"changes of its simulation. Use make(..., effects=[...]), or a new environment."
            )
        require(
            len(arrays) == len(self._default_arrays) and all(map(is_, arrays, self._default_arrays)),
            "expected the default data with which the environment was made, got others: an environment does not "
            "follow changes of its simulation. Set sim.default_data before DroneEnv(sim, ...), or change the data "
            "of a state.",
        )
        data, mesh = self.episode_reset.broadcast_default(self.sim.n_worlds, self.sim.n_drones), self.sim.mesh
        data = data.replace(core=_set_keys(data.core, key))
        if mesh is not None:
            return shard(data, mesh)
        return data if is_traced([key]) else put_on_device(data, self.sim.device)


def _describe_state(state: EnvState) -> str:
    names = {"observations": state.obs, "info": state.info, "memory": state.memory}
    task = f"task {state.record.task!r}"
    return ", ".join([task, describe_data(state.data), *(f"{key} {', '.join(names[key]) or 'none'}" for key in names)])


def _set_keys(core: SimCore, key: Array) -> SimCore:
    if key.size == 1:
        return core.replace(rng_key=key.reshape(()))
    block_size, remainder = divmod(core.n_worlds, key.size)
    require(
        key.ndim == 1 and not remainder,
        f"expected one key, or keys of blocks that divide the {core.n_worlds} worlds, got keys of shape "
        f"{key.shape}. Use for example jax.random.key(0).",
    )
    rng_key = jnp.broadcast_to(jnp.repeat(key, block_size)[:, None], (core.n_worlds, core.n_drones))
    return core.replace(rng_key=rng_key, world_id=core.world_id % block_size)


def _default_arrays(sim: Sim) -> list[Any]:
    data = sim.default_data
    return jax.tree.leaves((data.states, data.controls, data.params, data.plugins))
