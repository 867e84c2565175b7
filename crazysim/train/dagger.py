"""DAgger (Ross, Gordon and Bagnell 2011): a student learns a teacher's actions from other observations.

The student flies, so that it learns in the states to which its own errors lead. The label of each state is the
teacher's action. The paper's algorithm fits all samples so far. This one takes gradient steps on each rollout and then
discards it; the paper's bounds hold for any no-regret learner. A rollout of hundreds of worlds has enough samples for
these steps, and the images of all iterations would not fit in memory.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

from crazysim.core.data import SimData
from crazysim.engine.pytree import PyTree, static
from crazysim.envs.env import Env
from crazysim.envs.registry import entry_of
from crazysim.envs.state import EnvState, Obs, flatten
from crazysim.envs.statistics import RunningStats
from crazysim.envs.wrappers import AutoReset, Wrapper
from crazysim.errors import ConfigError, DivergedError, require, require_callable
from crazysim.train.convolution import images_of
from crazysim.train.hyperparameters import check_hyperparameters, check_seed
from crazysim.train.interface import Interface, check_callable, describe_env, sizes_of
from crazysim.train.networks import Network, Policy, Weights, choose_network, forward, init_weights
from crazysim.train.optimizer import all_finite, build_optimizer, check_minibatches, run_epochs
from crazysim.train.policies import as_tree
from crazysim.train.seeds import (
    Step,
    for_each_seed,
    rollout_seeds,
    split_blocks,
    split_keys,
    stack_configs,
    take_seed,
)

TEACHER_PREFIX = "teacher "
"""Prefix of the names of the teacher's observations."""
NAN_TEACHER = (
    "expected a teacher whose actions are numbers, got NaN in the states of the rollouts. Check teacher(obs) with "
    "observations of the environment, or use another teacher."
)


@dataclass(frozen=True)
class Config:
    """Hyperparameters of DAgger."""

    teacher: str = ""
    """Folder of the run whose policy is the teacher; empty in ``imitate``, which gets the teacher itself."""
    iterations: int = 100
    """Number of iterations, each a rollout and the updates on its samples."""
    n_steps: int = 16
    """Environment steps per world in one rollout."""
    epochs: int = 2
    """Passes over the samples of a rollout."""
    minibatches: int = 4
    """Minibatches, and hence updates, per epoch; each contains all samples of a subset of the worlds."""
    hidden: tuple[int, ...] = (64, 64)
    """Sizes of the hidden layers of the student."""
    convolution: tuple[int, ...] = ()
    """Channels of the layers of a convolution over each image, as in PPO; empty to use the pixels without
    convolution."""
    learning_rate: float = 3e-3
    """Initial learning rate of Adam, annealed linearly to zero."""
    teacher_decay: float = 0.8
    """Factor per iteration of the probability that the teacher acts in a step; the probability begins at 1."""
    max_grad_norm: float = 1.0
    """Largest global norm of a gradient; larger ones are scaled down to it."""

    def __post_init__(self) -> None:
        check_hyperparameters(self)

    @property
    def n_updates(self) -> int:
        return self.iterations * self.epochs * self.minibatches


class Agent(PyTree):
    """Network, optimiser and statistics of one student; in a ``Learner``, the arrays of all seeds are stacked."""

    student: Weights
    """Weights from normalised observations to the action before tanh."""
    optimizer: optax.OptState
    """State of the optimiser."""
    stats: RunningStats
    """Mean and variance with which observations are normalised."""
    key: Array
    """Random key. ()"""
    network: Network = static()
    """Network of the student, without memory."""

    def act(self, obs: Array) -> Array:
        """Return the student's action for normalised observations. (..., n_obs) -> (..., n_actions)"""
        return jnp.tanh(forward(self.network, self.student, obs, ())[0])


class Learner(PyTree):
    """Complete state of a training run; saving and loading it resumes the run bit for bit."""

    agents: Agent
    """The students of all seeds. (n_seeds, ...) each"""
    teacher: Any
    """Policy of the teacher, which does not change."""
    env: EnvState
    """State of the environments: a block of worlds for each seed, of equal size."""
    iteration: Array
    """Number of completed iterations. ()"""

    def as_policy(self) -> Policy:
        """Return the students' policies. (n_seeds, ...) each"""
        agents = self.agents
        return Policy(agents.stats, agents.student.layers, agents.student.body, agents.network)


class TeacherObservation(Wrapper):
    """Add the teacher's observations, ``teacher NAME``, to the student's."""

    def __init__(self, env: Env, observe: Callable[[SimData], Obs]):
        super().__init__(env)
        self.observe, self.batched = observe, env.task.batched

    def after_reset(self, state: EnvState) -> EnvState:
        return self._add_teacher_obs(state)

    def after_step(self, state: EnvState) -> EnvState:
        return self._add_teacher_obs(state)

    def _add_teacher_obs(self, state: EnvState) -> EnvState:
        teacher_obs = self.observe(state.data)
        sizes_of(teacher_obs)  # raises an error for anything but arrays by name
        return state.replace(obs=state.obs | {TEACHER_PREFIX + name: x for name, x in teacher_obs.items()})


def wrap_with_teacher(env: Env, config: Config) -> TeacherObservation:
    """Return an environment that adds the observations of the teacher in ``config.teacher``."""
    require(config.teacher, "expected the folder of a teacher, got none. Use --teacher out/hover, for example.")
    _, teacher_config, _ = _load_teacher_run(config.teacher)
    entry = entry_of(teacher_config.task, is_named=False)
    task = entry.task(**{name: x for name, x in teacher_config.options.items() if name in entry.options})
    teacher_record, student_record = type(task).Record, type(env.task).Record
    require(
        teacher_record is None or (student_record is not None and issubclass(student_record, teacher_record)),
        f"expected a teacher whose task has the same record as {env.task.name!r}, got {config.teacher} of "
        f"{teacher_config.title!r}. Train the teacher with the same task, or with the base class of its class.",
    )
    return TeacherObservation(env, task.observe)


def init(
    env: Env,
    configs: Sequence[Config],
    keys: Array,
    teacher: Callable[[Obs], Array] | None = None,
    network: Network | None = None,
) -> Learner:
    """Return an untrained learner.

    Args:
        env: Environment of the training, with a block of worlds for each seed: ``TeacherObservation`` inside
            ``AutoReset``.
        configs: Hyperparameters of each seed; only ``SWEEPABLE`` ones may differ between seeds.
        keys: Random keys of the seeds. (n_seeds,)
        teacher: Policy of the teacher; None to load it from the folder ``teacher`` of the hyperparameters.
        network: Custom network of the student; None for the built-in one.
    """
    config, hidden = configs[0], configs[0].hidden if network is None else ()
    check_minibatches(config.minibatches, env.sim.n_worlds // len(configs))
    k_student, k_env, k_agent = split_keys(keys, 3)
    state = env.reset(k_env)
    obs, teacher_obs = split_obs(state.obs)
    teacher = _load_teacher_run(config.teacher)[0] if teacher is None else teacher
    _check_teacher(teacher, env, teacher_obs, config.teacher)

    images = images_of(env, obs) if config.convolution else ()
    network = choose_network(0, network, config.convolution, images)

    def init_agent(k_student: Array, key: Array, obs: Array) -> Agent:
        student: Any = init_weights(network, k_student, obs.shape[-1], (*hidden, env.actions.size), 0.01)
        optimizer = build_optimizer(config.learning_rate, config.max_grad_norm, config.n_updates).init(student)
        stats = RunningStats.create(obs.shape[-1], network.pixels).update(obs)
        return Agent(student, optimizer, stats, key, network)

    agents = for_each_seed(init_agent, k_student, k_agent, split_blocks(flatten(obs), len(configs)))
    return Learner(agents, as_tree(teacher), state, jnp.int32(0))


@functools.partial(jax.jit, static_argnames=("env", "configs"))
def iterate(learner: Learner, env: Env, configs: tuple[Config, ...]) -> tuple[Learner, dict[str, Array]]:
    """Return the learner after one rollout and its updates, and the metrics of the iteration. (n_seeds,) each

    The metric ``difference`` is the root mean square of the difference between the actions of student and teacher in
    the states of the rollout; ``finite`` is True if weights, optimiser state, statistics and losses are finite, and
    ``taught`` if the teacher's actions are.
    """
    key, k_fly, k_learn = split_keys(learner.agents.key, 3)
    agents, config = learner.agents.replace(key=key), configs[0]
    teacher_probability = config.teacher_decay**learner.iteration

    def act(agent: Agent, obs: Obs, memory: Any, key: Array) -> tuple[Array, Any, Any]:
        obs, teacher_obs = split_obs(obs)
        raw_obs, label = flatten(obs), jnp.clip(learner.teacher(teacher_obs), -1.0, 1.0)
        action = agent.act(agent.stats.normalize(raw_obs))
        is_teacher_acting = jax.random.bernoulli(key, teacher_probability, (len(action), 1, 1))
        return jnp.where(is_teacher_acting, label, action), memory, (raw_obs, label, jnp.square(action - label).mean())

    state, _, records = rollout_seeds(env, learner.env, act, record, (agents,), k_fly, config.n_steps)
    agents, metrics = for_each_seed(learn, agents, stack_configs(configs), records, k_learn, axes=(0, 0, 1, 0))
    return Learner(agents, learner.teacher, state, learner.iteration + 1), metrics


def record(agent: Agent, step: Step, extras: Any) -> Any:
    """Return the results of ``act`` for a step, and what metrics are made of."""
    del agent
    outcome = step.reward.mean(), step.error.mean(), step.terminated.sum(), step.done.sum()
    return extras, outcome


def learn(agent: Agent, config: Config, records: Any, key: Array) -> tuple[Agent, dict[str, Array]]:
    """Update the student with the records of its rollout, and return it with the metrics of the iteration."""
    (raw_obs, labels, difference), (reward, error, terminated, done) = records

    def loss(student: Weights, minibatch: Any) -> tuple[Array, Array]:
        obs, label = minibatch
        value = jnp.square(agent.replace(student=student).act(obs) - label).mean()
        return value, value

    samples = agent.stats.normalize(raw_obs), labels
    student, optimizer, losses = run_epochs(loss, agent.student, agent.optimizer, samples, config, key)
    stats = agent.stats.update(raw_obs)
    metrics = {
        "reward": reward.mean(),
        "crashed": terminated.sum() / jnp.maximum(done.sum(), 1),
        "error": error.mean(),
        "difference": jnp.sqrt(difference.mean()),
        "finite": all_finite((student, optimizer, stats, losses)),
        "taught": jnp.isfinite(labels).all(),
    }
    return agent.replace(student=student, optimizer=optimizer, stats=stats), metrics


def imitate(
    env: Env,
    teacher: Callable[[Obs], Array],
    config: Mapping[str, Any] | None = None,
    seed: int = 0,
    observe: Callable[[SimData], Obs] | None = None,
    on_iteration: Callable[[int, dict[str, float]], None] | None = None,
    network: Network | None = None,
) -> Policy:
    """Train a student in an environment, with its wrappers and sensors, and return its policy.

    The policy takes the observations of ``env``. It works with ``evaluate(env, policy)`` and ``film``, and can be
    exported with ``describe(env)``.

    Args:
        env: Environment of the student without automatic resets.
        teacher: Trained policy, or any function from the teacher's observations to actions.
        config: Hyperparameters of ``Config`` by name, except ``teacher``; omitted ones have their defaults.
        seed: Random seed.
        observe: Function from the true data of one world to the teacher's observations, or from the data of all
            worlds if the task is batched; None for the observations of the task.
        on_iteration: Function that is called after each iteration with its number, from 1, and its metrics by name.
        network: Custom network of the student, without memory; None for the built-in one.

    Raises:
        DivergedError: If weights or losses become non-finite, or the teacher's actions are NaN.
    """
    require(isinstance(config, (Mapping, type(None))), f"expected config as a dict of values by name, got {config!r}")
    names = [field.name for field in dataclasses.fields(Config) if field.name != "teacher"]
    if unknown := [name for name in config or {} if name not in names]:
        raise ConfigError(f"expected hyperparameters of dagger, got {', '.join(unknown)}; use {', '.join(names)}")
    hyperparameters = Config(**config or {})
    check_callable(teacher, env)
    check_seed(seed)
    require_callable("observe", observe)
    require_callable("on_iteration", on_iteration)
    interface = Interface.read(describe_env(env))
    env = AutoReset(TeacherObservation(env, env.task.observe if observe is None else observe))
    learner = jax.jit(functools.partial(init, env, (hyperparameters,), teacher=teacher, network=network))(
        jax.random.key(seed)[None]
    )
    metrics: dict[str, Array] = {}
    taught: Any = True
    for i in range(hyperparameters.iterations):
        learner, metrics = iterate(learner, env, (hyperparameters,))
        taught &= metrics["taught"].all()
        if on_iteration is not None:
            numbers = jax.device_get(metrics)
            on_iteration(i + 1, {name: float(x[0]) for name, x in numbers.items() if x.dtype != bool})
    require(taught, NAN_TEACHER, DivergedError)
    require(
        metrics["finite"].all(),
        "expected finite weights and losses, got NaN or infinity. Use a smaller learning_rate.",
        DivergedError,
    )
    return take_seed(learner.as_policy(), 0).replace(interface=interface)


def split_obs(obs: Obs) -> tuple[Obs, Obs]:
    """Return the observations of the student and the observations of the teacher."""
    teacher_obs = {name.removeprefix(TEACHER_PREFIX): x for name, x in obs.items() if name.startswith(TEACHER_PREFIX)}
    return {name: x for name, x in obs.items() if not name.startswith(TEACHER_PREFIX)}, teacher_obs


def _load_teacher_run(folder: str) -> tuple[Policy, Any, dict[str, Any]]:
    from crazysim.train.training import load_policy

    require(
        Path(folder).exists(),
        f"expected the run of the teacher in {folder!r}, got no such folder. Use the folder of a run; if you "
        f"resume a student, move its teacher back there.",
    )
    return load_policy(folder)


def _check_teacher(teacher: Any, env: Env, teacher_obs: Obs, folder: str) -> None:
    require(
        not isinstance(teacher, Policy) or not teacher.has_memory,
        "expected a teacher without memory, got one with a memory. Train the teacher with memory=0.",
    )
    interface = getattr(teacher, "interface", None)
    if isinstance(interface, Interface):
        description = describe_env(env, sizes_of(teacher_obs)) | {"task": None, "task_code": None, "images": {}}
        student = Interface.read(description)
        require(
            interface.level != student.level or interface.has_ranges_of(student),
            f"expected a teacher whose actions have the meaning of the student's, {env.actions}, got "
            f"{folder or 'a policy'} with centre and scale {interface.ranges}. Use the same drone for both.",
        )
        interface.require(student, f"a student of the teacher {folder}".rstrip())
    action, shape = jax.eval_shape(teacher, teacher_obs), (env.sim.n_worlds, env.sim.n_drones, env.actions.size)
    require(
        getattr(action, "shape", None) == shape,
        f"expected actions of the teacher of shape {shape} = (n_worlds, n_drones, {shape[-1]}), got {action}. "
        f"Use a function from the observations of all worlds to actions.",
    )
