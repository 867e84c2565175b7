"""Environments: a simulation, a task and the meaning of actions, as pure functions of one state."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from operator import is_
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from crazysim.core.data import SimData
from crazysim.core.plugin import Plugin
from crazysim.core.settings import as_mask, positive
from crazysim.core.sharding import beside, commit, put, shard
from crazysim.core.stage import Axes, Stage, of_world, over_worlds
from crazysim.core.stages import reset
from crazysim.eager import is_traced
from crazysim.engine.backends import fused
from crazysim.envs.actions import Actions, actions_of
from crazysim.envs.default_data import compact, reset_world, spread, with_own
from crazysim.envs.hooks import Hooks
from crazysim.envs.phases import Phases, all_worlds
from crazysim.envs.state import EnvState, state_of_data, validate_action
from crazysim.envs.task import Task
from crazysim.envs.task_check import check_task, require_finite_start, require_installed
from crazysim.errors import ConfigError
from crazysim.pytree import n_batch_axes, n_world_axes, numbered, scopes, select_worlds
from crazysim.sim.sim import Sim


class Env(ABC):
    """An environment of all worlds, wrapped or not. Its functions are pure, for jit, scan, vmap and grad.

    A step has four phases: ``act`` stages the command of an action, ``physics`` advances the simulation, ``observe``
    evaluates the task, and ``restart`` begins new episodes where one is over.
    """

    auto_resets: ClassVar[bool] = False
    """True if new episodes begin within ``step``."""

    @property
    @abstractmethod
    def base(self) -> DroneEnv:
        """The environment inside all wrappers."""

    @property
    @abstractmethod
    def wrappers(self) -> tuple[Hooks, ...]:
        """Wrappers around it, the innermost first."""

    @property
    def sim(self) -> Sim:
        """The simulation it was made from; it is used for drawing, and does not advance."""
        return self.base.sim

    @property
    def task(self) -> Task:
        """The task."""
        return self.base.task

    @property
    def actions(self) -> Actions:
        """Meaning of an action."""
        return self.base.actions

    @property
    def n_substeps(self) -> int:
        """Physics steps in one environment step."""
        return self.base.n_substeps

    @property
    def max_steps(self) -> int:
        """Environment steps in one episode."""
        return self.base.max_steps

    @functools.cached_property
    def phases(self) -> Phases:
        """The phases of its step."""
        base, last_step = self.base, self.max_steps * self.n_substeps
        reset_data, batched = base.reset_data, base.batched_reset
        return Phases(
            self.task, self.actions, self.wrappers, base.sim.n_drones, last_step, reset_data, batched, base.measured
        )

    def reset(self, key: Array) -> EnvState:
        """Return all worlds at the start of an episode; the same key gives the same episodes.

        Args:
            key: Random key, as ``jax.random.key`` makes. ()

        Raises:
            ConfigError: If the task begins in a state that is not finite. A compiled reset, such as
                ``jax.jit(env.reset)``, cannot raise: there such a world ends at its first step, with
                ``info["nonfinite"]``.
        """
        key = commit(key, self.sim.device) if self.sim.mesh is None else key
        with beside(key):
            data = self.base.initial_data(key)
            for wrapper in self.wrappers:
                data = wrapper.prepare(data)
            state = self.begin(state_of_data(data))
        if not is_traced([state.data.states.pos]):
            require_finite_start(self.task, state)
        return state

    def restart(self, state: EnvState, mask: Array | None) -> EnvState:
        """Return the state with new episodes in some worlds.

        Args:
            state: The state of all worlds.
            mask: True where a new episode begins; None for all. (n_worlds,)

        Raises:
            ConfigError: If the mask has another shape or type.
        """
        with beside(state.data.core.steps):
            mask = as_mask(mask, state.data.core.steps.shape[:1])
            return select_states(mask, self.begin(state), state)

    def step(self, state: EnvState, action: Array) -> EnvState:
        """Return the state one environment step later.

        A world that becomes non-finite terminates, sets ``info["nonfinite"]``, and is observed as zeros.

        Args:
            state: The state of all worlds.
            action: Action of every drone, clipped to [-1, 1]. (n_worlds, n_drones, k)

        Raises:
            ValueError: If the action has another shape.
        """
        with beside(state.data.core.steps):
            action = validate_action(action, state, self.actions)
            state, action = self.phases.act(state, action, all_worlds)
            state = state.replace(data=self.base.physics(state.data))
            return self.phases.observe(state, action, all_worlds)

    def begin(self, state: EnvState) -> EnvState:
        """Return the state with new episodes in all worlds."""
        state = self.phases.begin(state, self.base.default_of(state.data), all_worlds)
        data = state.data.replace(core=state.data.core.replace(mjx_synced=jnp.asarray(False)))
        return state.replace(data=data if self.sim.mesh is None else shard(data, self.sim.mesh))

    def explain(self) -> str:
        """Return how a step is executed: whether it is one kernel, and if not, why; then the physics in it."""
        return f"a step is {self._kind_of_step()}\nits physics, as in sim.explain():\n{self.sim.explain()}"

    def _kind_of_step(self) -> str:
        """Return the part of ``explain`` about the step: that it is one kernel, or that it is not, with the reason."""
        return "not one kernel: it begins no new episodes. AutoReset(env), which training and Gymnasium use, does"

    def target(self, state: EnvState) -> Array | None:
        """Return the place where each drone should be, or several marks, for images, m; None if the task has none.

        Returns:
            (n_worlds, n_drones, 3) or (n_worlds, n_drones, n_marks, 3)
        """
        return self._of_task(self.task.target, state)

    def subjects(self, state: EnvState) -> Array | None:
        """Return points that films hold in view besides drones and marks, m; None if the task has none.

        Returns:
            (n_worlds, n_points, 3)
        """
        return self._of_task(self.task.subjects, state)

    def succeeded(self, state: EnvState) -> Array | None:
        """Return true where a drone has succeeded; None if success is an error that stays small.

        Returns:
            (n_worlds, n_drones)
        """
        return self._of_task(self.task.succeeded, state)

    def _of_task(self, fn: Callable[[SimData], Any], state: EnvState) -> Any:
        return all_worlds(fn, self.task.batched)(state.data)


class DroneEnv(Env):
    """Many worlds of one task. Episodes that are over continue; ``AutoReset`` begins new ones."""

    def __init__(self, sim: Sim, task: Task, freq: int = 50, actions: Actions | None = None, measured: bool = False):
        """Take a simulation in which the task is installed.

        Args:
            sim: The simulation, after ``task.install(sim)``; episodes begin from ``sim.default_data``.
            task: The task.
            freq: Environment steps per second, Hz; divides the simulation's.
            actions: Meaning of an action; None for ``actions_of``.
            measured: True for observations of the states as the sensors of the simulation measure them. Rewards and
                ends of episodes are of the true states.

        Raises:
            ConfigError: If the task is not installed, lacks a method, or observes or rewards in a wrong shape; if a
                rate does not divide, or the controller runs less often than actions come; if no plugin measures states
                although ``measured`` is true.
        """
        freq = positive("freq", freq)
        require_installed(sim, task)
        if sim.freq % freq:
            raise ConfigError(
                f"expected an environment freq that divides the simulation's {sim.freq} Hz, got {freq} Hz. Use a "
                f"divisor."
            )
        if sim.control_freq % freq:
            raise ConfigError(
                f"expected a freq that divides the rate of {sim.control.value} commands, {sim.control_freq} Hz, got "
                f"{freq} Hz: some actions would never reach the controller. Use a divisor."
            )
        self._sim, self._task, self.freq = sim, task, freq
        self._actions = actions_of(sim.airframes, sim.default_data.params, sim.control) if actions is None else actions
        check_task(task, sim.default_data, self._actions.size)
        self.measured: Callable[[SimData], SimData] | None = None
        """``measured(data)``: the data with measured states, of one world, or of all worlds for a task that is batched;
        None if the task observes the true ones."""
        if measured:
            if not any(type(plugin).measured_states is not Plugin.measured_states for plugin in sim.plugins.values()):
                raise ConfigError(
                    "expected a sensor of states where measured=True, got a simulation without one. Use "
                    "sim.add(MotionCapture()) before the environment is made, or make(..., sensors=[MotionCapture()])."
                )
            of_world = sim.plugins.measured_states
            self.measured = over_worlds(of_world) if task.batched else of_world
        self._n_substeps = sim.freq // freq
        self._max_steps = round(task.seconds * freq)
        if self._max_steps < 1:
            raise ConfigError(
                f"expected an episode of at least one environment step, got seconds={task.seconds} at {freq} Hz. Use "
                f"seconds={1 / freq:g} or more."
            )
        sim.plugins.check()
        self._step = sim.build_step_fn().without(sim.plugins.reset_stages)  # every episode begins by a reset
        self._foreign = "batched" in jax.tree.leaves(scopes(sim.default_data))
        first, *others = sim.reset_pipeline.values()
        self.batched_reset = self._foreign or first is not reset or not all(isinstance(fn, Stage) for fn in others)
        """True if the reset pipeline has functions of all worlds, or a record of another library is reset."""
        self.reset_data = self._reset_all() if self.batched_reset else self._reset_world(others)
        """``reset_data(data, default)``: data of one world after a reset, or of all worlds if ``batched_reset``."""
        self._plugins, self._beginning = tuple(sim.plugins.values()), _beginning(sim)
        self._default = default = compact(sim.default_data)
        rows = zip(*map(jax.tree.leaves, (scopes(default), default, numbered(default))), strict=True)
        world_id = numbered(default).core.world_id
        self.default_varies = any(n_batch_axes(kind) == 2 and x.shape[0] > 1 and i != world_id for kind, x, i in rows)
        """True if episodes begin from different data in different worlds."""

    def _reset_all(self) -> Callable[[SimData, SimData], SimData]:
        reset_all, worlds = self.sim.build_reset_fn().plain, np.ones(self.sim.n_worlds, bool)
        return lambda data, default: reset_all(data, default, worlds)

    def _reset_world(self, stages: Sequence[Any]) -> Callable[[SimData, SimData], SimData]:
        """Return a function that resets one world and applies stages of the reset pipeline to it."""
        axes = Axes(self.sim.data)

        def reset_one(data: SimData, default: SimData) -> SimData:
            data = reset_world(data, default)
            for stage in stages:
                data = of_world(stage, axes)(data)
            return data

        return reset_one

    @property
    def base(self) -> DroneEnv:
        """The environment itself."""
        return self

    @property
    def wrappers(self) -> tuple[Hooks, ...]:
        """None."""
        return ()

    @property
    def sim(self) -> Sim:
        """The simulation it was made from; it is used for drawing, and does not advance."""
        return self._sim

    @property
    def task(self) -> Task:
        """The task."""
        return self._task

    @property
    def actions(self) -> Actions:
        """Meaning of an action."""
        return self._actions

    @property
    def n_substeps(self) -> int:
        """Physics steps in one environment step."""
        return self._n_substeps

    @property
    def max_steps(self) -> int:
        """Environment steps in one episode."""
        return self._max_steps

    def physics(self, data: SimData) -> SimData:
        """Return the data of all worlds after the physics of an environment step."""
        return self._step(data, self.n_substeps)

    @property
    def stages(self) -> list[Stage]:
        """Stages of a physics step."""
        return self._step.stages

    @property
    def strict(self) -> bool:
        """True to raise an error where a step runs unfused for another reason than a documented limit."""
        return self._step.strict

    @property
    def unfused(self) -> str | None:
        """Reason why its steps cannot be one kernel, as far as it is known without tracing; None if there is none."""
        if self._step.engine not in ("auto", "fused"):
            return f"the engine is {self._step.engine!r}"
        if (missing := fused.missing(self._step.platform)) is not None:
            return missing
        if self.sim.mesh is not None:
            return "the worlds are sharded over several devices"
        if self.task.batched:
            return f"task {self.task.name!r} is declared to need all worlds at once"
        if self._foreign:
            return "a record in data.plugins is of another library, and is not divided among worlds"
        if self.batched_reset:
            others = [
                name for name, fn in self.sim.reset_pipeline.items() if not (fn is reset or isinstance(fn, Stage))
            ]
            own = ", ".join(map(repr, others))
            return f"{own} of the reset pipeline takes all worlds at once"
        return "episodes begin from different data in different worlds" if self.default_varies else None

    def initial_data(self, key: Array) -> SimData:
        """Return the data of all worlds before their first episode. The key is that of ``reset``. ()

        Raises:
            ConfigError: If the simulation has other plugins or default data than those with which the environment was
                made.
        """
        now = tuple(self._sim.plugins.values())
        if [*map(id, now)] != [*map(id, self._plugins)]:
            known = ", ".join(plugin.name for plugin in self._plugins)
            raise ConfigError(
                f"expected the plugins with which the environment was made ({known or 'none'}), got "
                f"{', '.join(plugin.name for plugin in now) or 'none'}: an environment does not follow its simulation. "
                f"Use make(..., effects=[...]), or a new environment."
            )
        if len(now := _beginning(self._sim)) != len(self._beginning) or not all(map(is_, now, self._beginning)):
            raise ConfigError(
                "expected the default data with which the environment was made, got others: an environment does not "
                "follow its simulation. Set sim.default_data before DroneEnv(sim, ...), or change the data of a state."
            )
        data, mesh = spread(self._default, self.sim.n_worlds, self.sim.n_drones), self.sim.mesh
        data = data.replace(core=data.core.replace(rng_key=key))
        if mesh is not None:
            return shard(data, mesh)
        return data if is_traced([key]) else put(data, self.sim.device)

    def default_of(self, data: SimData) -> SimData:
        """Return the data of all worlds that an episode begins from; seed and numbers are those of the data given."""
        n_worlds, n_drones = data.states.pos.shape[:2]
        return with_own(spread(self._default, n_worlds, n_drones), data)

    def default_of_world(self, data: SimData) -> SimData:
        """Return the data of one world that an episode begins from, where worlds do not differ in that."""

        def one(scope: str, x: Array) -> Array:
            return x[(0,) * n_world_axes(scope)] if n_batch_axes(scope) == 2 else x

        return with_own(jax.tree.map(one, scopes(self._default), self._default), data)


def _beginning(sim: Sim) -> list[Any]:
    """Return the arrays that episodes begin from, besides those of the scene, which change when it is compiled."""
    data = sim.default_data
    return jax.tree.leaves((data.states, data.controls, data.params, data.plugins))


def select_states(mask: Array | None, new: EnvState, old: EnvState) -> EnvState:
    """Return one state in the worlds of a mask, and another elsewhere; leaves that worlds share are the new ones.

    Args:
        mask: True where the new state is taken; None for all. (n_worlds,)
        new: State of the worlds in the mask. Its reward and info may hold more than the old state's.
        old: State of the others.
    """
    old = old.replace(reward=new.reward if old.reward is None else old.reward, info=new.info | old.info)
    kinds = jax.tree.leaves(scopes(new))
    pairs = zip(kinds, jax.tree.leaves(new), jax.tree.leaves(old), strict=True)
    leaves = [select_worlds(mask, x, y) if n_batch_axes(kind) else x for kind, x, y in pairs]
    return jax.tree.structure(new).unflatten(leaves)
