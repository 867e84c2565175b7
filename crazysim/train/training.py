"""Training in a folder, with checkpoint, learning curve and policy."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import crazysim
from crazysim.core.settings import positive_integer
from crazysim.engine.backends.native import compiling_threads
from crazysim.engine.cache import announce_if_slow, keep_programs
from crazysim.engine.sharding import distribute, fetch_arrays
from crazysim.envs.env import Env
from crazysim.envs.references import code_digest, is_reference, split_reference
from crazysim.envs.statistics import RunningStats
from crazysim.envs.task_check import require_finite_start
from crazysim.envs.wrappers import AutoReset, PrivilegedObservation, RewardTerms
from crazysim.errors import ConfigError, DivergedError, require, require_callable
from crazysim.progress import progress_bar
from crazysim.storage import MAX_TEXT_BYTES, as_path, make_folder, read_text, write_file
from crazysim.tables import POSITIVE, read_number
from crazysim.train import apg, checkpoint, dagger, ppo
from crazysim.train.config import ALGORITHMS, ALTERABLE_HYPERPARAMETERS, TrainConfig, find_recipe
from crazysim.train.convolution import find_images
from crazysim.train.critic import PRIVILEGED_CRITICS
from crazysim.train.devices import exchanged_bytes, learner_shardings, replicated_sharding
from crazysim.train.evaluation import describe_outcome, evaluate_blocks
from crazysim.train.export import describe
from crazysim.train.hosts import broadcast_decision, is_first_host, must_stop, require_same_settings
from crazysim.train.hyperparameters import SWEEPABLE
from crazysim.train.interface import Interface
from crazysim.train.networks import Network, Policies, Policy, choose_network, init_weights
from crazysim.train.seeds import take_seed

CHECKPOINT_FILE, POLICY_FILE, CURVE_FILE, TABLE_FILE = "checkpoint.npz", "policy.npz", "curve.json", "seeds.json"
"""Names of the files of a run: checkpoint, kept policy, learning curve, and table of all seeds."""

TEACHER_FOLDER, STUDENTS_FILE = "teacher", "students.npz"
"""Names of the subfolder of a run for the teacher that the recipe of the task trains first, and of the file with the
settings of the students, which have no checkpoint yet."""

CHECK_SEED = 0xC4EC
"""Seed of the initial states of the check set, which differ from the held-out states of ``EVALUATION_SEED``."""
Learner = ppo.Learner | apg.Learner | dagger.Learner
"""State of a training run."""


@dataclass
class TrainResult:
    """Outcome of a run."""

    folder: Path
    """Folder of the files of the run."""
    metrics: dict[str, float]
    """Metrics of the kept policy: the metrics of ``evaluate`` on held-out initial states; ``iteration``, the number of
    iterations that trained it; ``check``, its success on the check set. Metrics of the whole run: ``seconds``,
    duration, s; ``compile_seconds``, the part for compilation, s; ``env_steps``, environment steps of all drones."""
    policy: Policy
    """Kept policy: the latest evaluated policy with a success on the check set within two standard errors of the
    best; with opponents the latest one."""
    env: Env
    """Environment in which all trainings of the program are evaluated, without automatic resets."""


def train(
    config: TrainConfig,
    folder: str | Path,
    resume: bool = False,
    evaluation_worlds: int = 1000,
    log: Callable[[str], None] = print,
    progress: bool = True,
    checkpoint_every: float | None = None,
    on_iteration: Callable[[int, dict[str, Any]], None] | None = None,
) -> TrainResult:
    """Train a policy and write checkpoint, learning curve and policy into a folder, as ``train_many`` for one training.

    Raises:
        ConfigError, DivergedError, KeyboardInterrupt, SystemExit: As ``train_many``.
    """
    return train_many({"": config}, folder, resume, evaluation_worlds, log, progress, checkpoint_every, on_iteration)[
        ""
    ]


def train_many(
    configs: Mapping[str, TrainConfig],
    folder: str | Path,
    resume: bool = False,
    evaluation_worlds: int = 1000,
    log: Callable[[str], None] = print,
    progress: bool = True,
    checkpoint_every: float | None = None,
    on_iteration: Callable[[int, dict[str, Any]], None] | None = None,
) -> dict[str, TrainResult]:
    """Train policies in one program and write their files.

    Each training has a block of worlds, and a folder for its learning curve and policy. The parent folder holds one
    checkpoint of all trainings. Every evaluation flies from two sets of initial states that are not used for training.
    The success on the check set decides which policy is kept; the held-out set is only used for the reported figures.

    Each evaluation writes a checkpoint. An interrupt (Ctrl-C), or a ``SystemExit`` from a signal handler, also writes a
    checkpoint before it is raised again. A resumed run is bit for bit the same as an uninterrupted run on the same
    machine. If a training diverges, its kept policy stays and the other trainings continue.

    Args:
        configs: Configuration of each training, by the name of its folder. Only the seed and the ``SWEEPABLE``
            hyperparameters may differ. A single training may have an empty name.
        folder: Folder of the run.
        resume: Whether to continue from the checkpoint in the folder, also with another number of devices.
        evaluation_worlds: Number of initial states of the held-out set, and of the check set.
        log: Function that is called with each line of output.
        progress: Whether to show a progress bar if tqdm is installed, or lines where stderr is no terminal.
        checkpoint_every: Time after which a checkpoint is also written between evaluations, s; None to write none.
        on_iteration: Function, or None, that is called after each iteration with its number, from 1, and its metrics by
            name. After an evaluation it also gets the metrics of the evaluation, with names that begin with
            ``"evaluation "``. A metric is a number, or an array with one number for each training if there are several.
            Each call waits for the device.

    Raises:
        ConfigError: If the folder holds a run and ``resume`` is False, or the run has another configuration or is
            damaged; if files cannot be written.
        DivergedError: If weights or losses of all trainings become non-finite; the last checkpoint stays.
        KeyboardInterrupt, SystemExit: After the checkpoint of an interrupted run has been written.
    """
    require_callable("on_iteration", on_iteration)
    run = _Run(
        configs,
        as_path(folder),
        resume,
        positive_integer("evaluation_worlds", evaluation_worlds),
        None if checkpoint_every is None else read_number("checkpoint_every", checkpoint_every, POSITIVE),
        log if is_first_host() else lambda _: None,
    )
    run.compile()
    run.log_start()
    n_done, n_iterations = int(run.learner.iteration), run.n_iterations
    try:
        if not resume or n_done >= n_iterations:
            run.evaluate()
        with _iteration_bar(n_iterations, n_done, progress, run) as show_progress:
            for i in range(n_done + 1, n_iterations + 1):
                run.iterate(i)
                show_progress(run.metrics if i % 5 == 1 else {})
                evaluation: dict[str, np.ndarray] = {}
                if i % run.evaluation_period == 0 or i == n_iterations:
                    evaluation = run.evaluate()
                    show_progress(evaluation, 0)
                else:
                    run.save_if_due()
                if on_iteration is not None:
                    on_iteration(i, _host_metrics(run.metrics, evaluation))
                if must_stop(i):
                    raise SystemExit(128 + signal.SIGTERM)
    except (KeyboardInterrupt, SystemExit) as error:
        if jax.process_count() == 1 or isinstance(error, SystemExit):  # else the other hosts would not join
            run.evaluate()
            run.log(
                f"interrupted after iteration {int(run.learner.iteration)}; wrote {run.path}; continue with --resume"
            )
        raise
    return run.results()


class _Run:
    """The trainings of a program: their learner, compiled functions, evaluations and files."""

    def __init__(
        self,
        configs: Mapping[str, TrainConfig],
        folder: Path,
        resume: bool,
        n_starts: int,
        checkpoint_every: float | None,
        log: Callable[[str], None],
    ):
        self.folder, self.path, self.log = folder, folder / CHECKPOINT_FILE, log
        self.n_starts, self.checkpoint_every = n_starts, checkpoint_every
        self.start_time = time.perf_counter()
        metadata = {name: _run_metadata(config) for name, config in configs.items()}
        self.code_hash = next(iter(metadata.values()))["code"]  # of the task
        runs: dict[str, Any] = {name: {"curve": [], "diverged": None} for name in configs}
        self.stored_arrays, runs, self.stored_hash, self.seconds_before = (
            _read_run(self.path, metadata) if resume else (None, runs, self.code_hash, 0.0)
        )
        self.trainings = [
            _Training(name, config, folder / name, metadata[name], list(runs[name]["curve"]), runs[name]["diverged"])
            for name, config in configs.items()
        ]
        self.config = self.trainings[0].config
        _require_same_on_hosts(
            metadata,
            devices=self.config.devices,
            evaluation_worlds=n_starts,
            checkpoint_every=checkpoint_every,
            resume=resume,
            seconds_of_checkpoint=self.seconds_before,
        )
        if not resume:
            require_no_run(folder)
        self.evaluation_period = find_recipe(self.config.task, self.config.algorithm).evaluate_every
        self.hyperparameters = tuple([training.config.algorithm_config() for training in self.trainings])
        self.n_iterations = self.hyperparameters[0].iterations
        self.env = self.config.make_training_env(len(configs))
        self.eval_env = self.config.make_env(len(configs) * n_starts)
        self.description = describe(self.env)
        n_steps = self.hyperparameters[0].n_steps
        self.steps_per_iteration = self.config.n_worlds * self.env.sim.n_drones * n_steps

    def compile(self) -> None:
        n_trainings, sim = len(self.trainings), self.env.sim
        algorithm, network = ALGORITHMS[self.config.algorithm], self.config.network
        arguments = wrap_env(self.env, self.hyperparameters[0]), self.hyperparameters
        seed_keys = [jax.random.key(training.config.seed) for training in self.trainings]
        keys = jax.jit(lambda keys: jnp.stack([jax.random.fold_in(key, 1) for key in keys]))(seed_keys)
        init_fn = algorithm.init if network is None else partial(algorithm.init, network=network)
        shapes = jax.eval_shape(partial(init_fn, *arguments), keys)
        shardings, replicated = learner_shardings(shapes, sim, n_trainings), replicated_sharding(sim)
        init = jax.jit(init_fn, static_argnums=(0, 1), out_shardings=shardings)
        attach = partial(jax.tree.map, lambda x, sharding: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding))
        iterate = jax.jit(algorithm.iterate, static_argnums=(1, 2), out_shardings=(shardings, replicated))
        policies = jax.eval_shape(self._policies_of, shapes)
        kept_shapes = [jax.eval_shape(lambda policies: take_seed(policies, 0), policies)] * n_trainings
        for training in self.trainings if is_first_host() else ():
            make_folder(training.folder)

        @keep_programs()
        def load_or_init() -> tuple[Learner, list[Policy]]:
            if self.stored_arrays is not None:
                template = {"learner": shapes, "kept": kept_shapes}
                files = checkpoint.restore(self.path, self.stored_arrays, template)
                return distribute(files["learner"], shardings), files["kept"]
            learner = init(*arguments, distribute(keys, replicated))
            require_finite_start(self.env.task, learner.env)
            policies = fetch_arrays(self._policies_of(learner))
            return learner, [take_seed(policies, i) for i in range(n_trainings)]

        @keep_programs()
        def compile_evaluation() -> str:
            self._evaluate_policies(jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), policies), None)
            return sim.explain().splitlines()[0]

        @keep_programs()
        def compile_iteration() -> tuple[Any, float]:
            start_time = time.perf_counter()
            compiled = iterate.lower(attach(shapes, shardings), *arguments).compile()
            return compiled, time.perf_counter() - start_time

        # Each compilation takes seconds, mostly on one core, so they run in parallel.
        with announce_if_slow("compiling the training", "5 to 20 s"), compiling_threads(3) as executor:
            iteration, start = executor.submit(compile_iteration), executor.submit(load_or_init)
            evaluation = executor.submit(compile_evaluation)
            (self.learner, kept_policies), self.engine = start.result(), evaluation.result()
            self._iterate, self.compile_seconds = iteration.result()
        for training, policy in zip(self.trainings, kept_policies, strict=True):
            training.kept_policy = policy
        self.metrics: dict[str, Array] = {}
        self.saved_iteration, self.save_time = int(self.learner.iteration), time.perf_counter()

    @property
    def seconds(self) -> float:
        return self.seconds_before + time.perf_counter() - self.start_time

    def _policies_of(self, learner: Learner) -> Policy:
        return learner.as_policy().replace(interface=Interface.read(self.description))

    def _evaluate_policies(self, policies: Policy, key: Array | None) -> list[dict[str, float]]:
        n_trainings, device = len(self.trainings), self.eval_env.sim.device
        policy = take_seed(policies, 0) if n_trainings == 1 else Policies(policies)
        return evaluate_blocks(self.eval_env, jax.device_put(policy, device), key, n_trainings)

    def iterate(self, iteration: int) -> None:
        metrics_before = self.metrics
        self.learner, self.metrics = self._iterate(self.learner)  # no signal is handled between the two
        self._mark_diverged(metrics_before, iteration - 1)

    def evaluate(self) -> dict[str, np.ndarray]:
        iteration, policies = int(self.learner.iteration), fetch_arrays(self._policies_of(self.learner))
        self._mark_diverged(self.metrics, iteration)
        is_planned = iteration % self.evaluation_period == 0 or iteration == self.n_iterations
        results = self._evaluate_policies(policies, None)
        checks = self._evaluate_policies(policies, jax.random.key(CHECK_SEED))
        env_steps = iteration * self.steps_per_iteration
        counters = {"iteration": iteration, "env_steps": env_steps, "seconds": self.seconds}
        for i, training in enumerate(self.trainings):
            if training.divergence_iteration is None:
                check = {"compile_seconds": self.compile_seconds, "check": checks[i]["success"]}
                point, policy = counters | results[i] | check, take_seed(policies, i)
                training.add_evaluation(point, policy, self.n_starts, self.description, is_planned)
        if self.trainings[0].name and is_first_host():
            write_table(self.folder, [training.row for training in self.trainings])
        self.save()
        points = [training.curve[-1] for training in self.trainings]
        return {name: np.array([float(point[name]) for point in points]) for name in points[0]}

    def save_if_due(self) -> None:
        every = self.checkpoint_every
        if every is not None and broadcast_decision(time.perf_counter() - self.save_time > every):
            self._mark_diverged(self.metrics, int(self.learner.iteration))
            self.save()

    def save(self) -> None:
        runs = {x.name: x.meta | {"curve": x.curve, "diverged": x.divergence_iteration} for x in self.trainings}
        meta = {"crazysim": crazysim.__version__, "code": self.code_hash, "runs": runs, "seconds": self.seconds}
        files = fetch_arrays({"learner": self.learner, "kept": [training.kept_policy for training in self.trainings]})
        if is_first_host():
            checkpoint.save(self.path, files, meta)
        broadcast_decision(True)  # no host reads the checkpoint before it is whole
        self.saved_iteration, self.save_time = int(self.learner.iteration), time.perf_counter()

    def _mark_diverged(self, metrics: dict[str, Array], iteration: int) -> None:
        finite = np.asarray(metrics.get("finite", np.full(len(self.trainings), True)))
        for training, is_finite in zip(self.trainings, finite, strict=True):
            if not is_finite and training.divergence_iteration is None:
                training.divergence_iteration = iteration
                if training.name:
                    self.log(f"{training.name} diverged: NaN or infinity in iteration {iteration}; the others go on")
        if all(training.divergence_iteration is not None for training in self.trainings):
            is_taught = np.all(metrics.get("taught", True))
            remedy = (
                "Use a smaller learning_rate or max_grad_norm"
                if is_taught
                else "The teacher's actions are NaN: use another"
            )
            names = [training.name and f" ({training.name})" for training in self.trainings]
            diverged = [f"{x.divergence_iteration}{name}" for x, name in zip(self.trainings, names, strict=True)]
            kept = [f"{kept_point(x.curve)['iteration']}{name}" for x, name in zip(self.trainings, names, strict=True)]
            raise DivergedError(
                f"expected finite weights and losses, got NaN or infinity in iteration {', '.join(diverged)} of "
                f"{self.config.title} by {self.config.algorithm}; {self.path} is of iteration {self.saved_iteration}, "
                f"{POLICY_FILE} of iteration {', '.join(kept)}. {remedy}, with another --out."
            )

    def log_start(self) -> None:
        config, sim, n_done = self.config, self.env.sim, int(self.learner.iteration)
        names = [training.name or f"seed {config.seed}" for training in self.trainings]
        devices = ""
        if sim.mesh is not None:
            n, n_bytes = sim.mesh.size, sum(exchanged_bytes(self._iterate.as_text()).values())
            devices = f"{sim.n_worlds // n:,} on each of {n} devices, which exchange {n_bytes:,} bytes an iteration, "
        repetition = "" if len(names) == 1 else f"{len(names)} times "
        self.log(
            f"{config.title} by {config.algorithm}, {', '.join(names)}: "
            f"{self.n_iterations} iteration{'s' * (self.n_iterations != 1)} of {repetition}"
            f"{self.steps_per_iteration:,} steps in {repetition}{config.n_worlds:,} worlds, {devices}"
            f"{sim.control.value} commands, {self.engine}" + (f"; continues after iteration {n_done}" if n_done else "")
        )
        if start := self.config.config.get("start"):
            self.log(f"starts from the policy of {start}")
        for name, what in (
            ("value_iterations", "train the value function alone"),
            ("demonstrations", "learn from demonstrate(obs)"),
        ):
            if (n := self.config.config.get(name, 0)) > n_done:
                self.log(f"iterations 1 to {n} {what}; leave out: --config {name}=0")
        if self.stored_hash != self.code_hash:
            self.log("the file of the task has changed since the checkpoint was written; it is used as it is now")
        if n_done >= self.n_iterations:
            self.log(
                f"nothing is left to train after {n_done} iteration{'s' * (n_done != 1)}; "
                f"continue with more: --iterations {2 * n_done or 100}"
            )

    def results(self) -> dict[str, TrainResult]:
        task, results = self.env.task, {}
        for training in self.trainings:
            best, latest, name = kept_point(training.curve), training.curve[-1], training.name and f"{training.name}: "
            if best is not latest:
                self.log(
                    f"{name}kept the policy of iteration {best['iteration']}: later ones succeeded less often on "
                    f"{self.n_starts:,} other starts, by more than two standard errors"
                )
            point = best | {name: latest[name] for name in ("env_steps", "seconds", "compile_seconds")}
            self.log(
                f"{name}success {point['success']:.1%} of {self.n_starts:,} held-out starts ({task.criterion}), "
                f"{describe_outcome(point, task.unit)}; {point['env_steps']:,} steps in {point['seconds']:.1f} s, "
                f"including {self.compile_seconds:.1f} s of compilation"
            )
            policy = jax.device_put(training.kept_policy, self.eval_env.sim.device)
            results[training.name] = TrainResult(training.folder, point, policy, self.eval_env)
        return results


def wrap_env(env: Env, config: Any) -> Env:
    """Return the training environment of an algorithm with the wrappers that its ``Config`` needs."""
    if isinstance(config, dagger.Config):
        return AutoReset(dagger.wrap_with_teacher(env, config))
    if config.critic in PRIVILEGED_CRITICS:
        env = PrivilegedObservation(env)
    env = RewardTerms(env) if config.rewards else env
    return env if isinstance(config, apg.Config) else AutoReset(env)


def require_no_run(folder: Path) -> None:
    """Raise ``ConfigError`` if a folder holds the checkpoint of a run."""
    require(
        not (folder / CHECKPOINT_FILE).exists(),
        f"expected a folder without a run, got {folder}; continue the run with --resume, or choose another folder "
        f"with --out",
    )


@dataclass
class _Training:
    """One of the trainings of a program."""

    name: str
    """Name in messages and of its folder; empty for a single training."""
    config: TrainConfig
    """Configuration."""
    folder: Path
    """Folder of the learning curve and the policy."""
    meta: dict[str, Any]
    """Metadata of the files."""
    curve: list[dict[str, Any]] = field(default_factory=list)
    """Evaluations so far."""
    divergence_iteration: int | None = None
    """Iteration in which weights or losses became non-finite; None if they are finite."""
    kept_policy: Any = None
    """The kept policy."""

    def add_evaluation(
        self, point: dict[str, Any], policy: Policy, n_starts: int, description: dict[str, Any], is_planned: bool
    ) -> None:
        # A run that is resumed at its end repeats its last evaluation, which was planned.
        is_planned |= any(
            earlier_point["iteration"] == point["iteration"] and earlier_point["kept"] for earlier_point in self.curve
        )
        self.curve[:] = [earlier for earlier in self.curve if earlier["iteration"] < point["iteration"]]
        best_check = max((earlier["check"] for earlier in self.curve if earlier["kept"]), default=0.0)
        # Success against itself does not say how strong a policy is, so that the latest one of a league is kept.
        is_league = bool(self.config.config.get("opponents"))
        point["kept"] = is_league or point["check"] >= least_kept_success(best_check, n_starts)
        best_policy = policy if point["kept"] else self.kept_policy
        if is_first_host():
            checkpoint.save(self.folder / POLICY_FILE, best_policy, self.meta | description)
            write_file(self.folder / CURVE_FILE, json.dumps([*self.curve, point], indent=1))
        self.kept_policy, point["kept"] = (best_policy, point["kept"]) if is_planned else (self.kept_policy, False)
        self.curve.append(point)

    @property
    def row(self) -> dict[str, Any]:
        best, latest = kept_point(self.curve), self.curve[-1]
        swept = {name: self.config.config[name] for name in SWEEPABLE if name in self.config.config}
        names = ("success", "crashed", "error", "reward", "check", "iteration")
        return (
            {"name": self.name, "seed": self.config.seed}
            | swept
            | {name: best[name] for name in names}
            | {name: latest[name] for name in ("env_steps", "seconds")}
            | {"diverged": self.divergence_iteration}
        )


def write_table(folder: Path, rows: list[dict[str, Any]]) -> None:
    """Write the table of all trainings as JSON and CSV, with null or an empty cell for a missing value."""
    rows = [{name: None if x != x else x for name, x in row.items()} for row in rows]
    write_file(folder / TABLE_FILE, json.dumps(rows, indent=1))
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_file((folder / TABLE_FILE).with_suffix(".csv"), text.getvalue())


def _host_metrics(metrics: dict[str, Array], evaluation: dict[str, np.ndarray]) -> dict[str, Any]:
    numbers = {name: x for name, x in jax.device_get(metrics).items() if x.dtype != bool}
    numbers |= {f"evaluation {name}": x for name, x in evaluation.items() if name != "iteration"}
    return {name: float(x[0]) if len(x) == 1 else x for name, x in numbers.items()}


def least_kept_success(success: float, n_worlds: int) -> float:
    """Return the lowest success rate with which a later policy is kept: two standard errors below the best.

    The standard error is computed with two more successes and two more failures (Agresti and Coull 1998, "Approximate
    is better than exact"), so that it is not zero where all have succeeded.

    Args:
        success: Best success rate so far.
        n_worlds: Number of starts of the check set.
    """
    n = n_worlds + 4
    rate = (success * n_worlds + 2) / n
    return success - 2 * math.sqrt(rate * (1 - rate) / n)


def kept_point(curve: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the last point of a learning curve whose policy was kept."""
    return next(point for point in reversed(curve) if point["kept"])


def load_policy(
    folder: str | Path, task: str | None = None, network: Network | None = None
) -> tuple[Policy, TrainConfig, dict[str, Any]]:
    """Load the policy of a run, its configuration, and the description of its inputs and outputs.

    Args:
        folder: Folder of the run.
        task: Reference of the task's class, ``FILE.py:NAME`` or ``MODULE:NAME``, if the class has moved since the
            training, or if this user has never named it on this machine. Its code is executed. None for the reference
            in the run; ``config.make_env`` loads it only if this user has named it before.
        network: Custom network with which the policy was trained; None for the built-in one.

    Raises:
        ConfigError: If the folder holds no policy that this version can read, or its policy has another network.
    """
    folder = as_path(folder)
    require(
        not folder.is_file(), f"expected the folder of a run, got the file {str(folder)!r}. Use {str(folder.parent)!r}."
    )
    path = folder / POLICY_FILE
    if not path.exists() and (folder / TABLE_FILE).exists():
        names = [row["name"] for row in json.loads(read_text(folder / TABLE_FILE, MAX_TEXT_BYTES))]
        raise ConfigError(
            f"expected the folder of one training, got {str(folder)!r} with several. Use one of its folders: "
            f"{', '.join(names)}."
        )
    arrays, meta = checkpoint.read(path)
    with checkpoint.wrap_checkpoint_errors(path):
        config = TrainConfig(**meta["settings"])
        if task is not None:
            config = dataclasses.replace(config, task=TrainConfig.create(task).task)
        interface = Interface.read(meta)
        n_obs, n_actions = sum(interface.sizes.values()), len(interface.ranges)
        convolution = config.config.get("convolution", ())
        images = find_images(meta["observations"], meta["images"]) if convolution else ()
    if config.own_network != (network is not None):
        expected = "the custom network" if config.own_network else "no network besides the built-in one"
        raise ConfigError(
            f"expected {expected} with which {path} was trained, got {network}. Use crazysim.train.load_policy(folder, "
            f"network={'network' if config.own_network else None})."
        )
    shape = config.config.get("shape", "default")
    used_network = choose_network(config.config.get("memory", 0), network, convolution, images, shape)
    hidden = () if config.own_network or not used_network.is_built_in else config.config["hidden"]

    def make_policy() -> Policy:
        weights = init_weights(used_network, jax.random.key(0), n_obs, (*hidden, n_actions), 1.0)
        return Policy(RunningStats.create(n_obs, used_network.pixels), weights.layers, weights.body, used_network)

    interface = interface if task is None else dataclasses.replace(interface, task=None)  # the caller names the task
    policy = checkpoint.restore(path, arrays, jax.eval_shape(make_policy)).replace(interface=interface)
    return policy, config, meta


def _run_metadata(config: TrainConfig) -> dict[str, Any]:
    stored_fields = [f.name for f in dataclasses.fields(config) if f.name not in ("network", "devices")]
    settings = {name: getattr(config, name) for name in stored_fields}
    meta = {"crazysim": crazysim.__version__, "settings": settings, "code": code_digest(config.task)}
    try:
        return json.loads(json.dumps(meta))
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"expected options that a checkpoint can hold, got {config.options!r}: {error}. Use numbers, texts and "
            f"lists, and add plugins in install of a custom task."
        ) from error


def store_configs(configs: Mapping[str, TrainConfig], folder: Path, resume: bool) -> None:
    """Write the configurations of trainings that begin after that of their teacher, for ``stored_configs``.

    Raises:
        ConfigError: If the trainings are resumed, and the folder holds others or other settings.
    """
    runs = {name: _run_metadata(x) for name, x in configs.items()}
    if resume:
        _require_same_runs(folder, checkpoint.read(folder / STUDENTS_FILE)[1]["runs"], runs)
    if is_first_host():
        make_folder(folder)
        checkpoint.save(folder / STUDENTS_FILE, {}, {"runs": runs})


def stored_configs(folder: str | Path) -> dict[str, TrainConfig]:
    """Return the configurations of the trainings in a folder, by name: of its checkpoint, or by ``store_configs``.

    Raises:
        ConfigError: If there is no intact file.
    """
    paths = [as_path(folder) / name for name in (CHECKPOINT_FILE, STUDENTS_FILE)]
    path = next((path for path in paths if path.exists()), paths[0])
    meta = checkpoint.read(path)[1]
    with checkpoint.wrap_checkpoint_errors(path):
        return {name: TrainConfig(**run["settings"]) for name, run in meta["runs"].items()}


def _read_run(
    path: Path, metadata: Mapping[str, dict[str, Any]]
) -> tuple[dict[str, Any], dict[str, dict[str, Any]], str, float]:
    arrays, meta = checkpoint.read(path)
    with checkpoint.wrap_checkpoint_errors(path):
        require(
            meta["crazysim"] == crazysim.__version__,
            f"expected a checkpoint of crazysim {crazysim.__version__}, got {path} of {meta['crazysim']}; start a new "
            f"run in another folder with --out",
        )
        runs = meta["runs"]
        _require_same_runs(path, runs, metadata)
        return arrays, runs, meta["code"], float(meta["seconds"])


def _require_same_runs(path: Path, stored: Mapping[str, Any], requested: Mapping[str, Any]) -> None:
    require(
        list(stored) == list(requested),
        f"expected the seeds and the sweep of {path}, {', '.join(stored) or 'none'}, got "
        f"{', '.join(requested) or 'none'}; resume with the same ones, or start a new run in another folder with "
        f"--out",
    )
    for name, run in requested.items():
        _require_same_settings(path, stored[name]["settings"], run["settings"])


def _require_same_settings(path: Path, stored: dict[str, Any], requested: dict[str, Any]) -> None:
    has_own_network = stored.get("own_network", False)
    require(
        has_own_network == requested["own_network"],
        f"expected {path} to be resumed with {'its custom network' if has_own_network else 'the built-in network'}. "
        f"Use network={'network' if has_own_network else None}, or start a new run in another folder with --out.",
    )
    stored_values, values = _fixed_settings(stored), _fixed_settings(requested)
    alterable = [x for x in ALTERABLE_HYPERPARAMETERS if x in requested["config"]]
    for name in {**stored_values, **values}:
        expected, got = (x.get(name, "its default") for x in (stored_values, values))
        require(
            expected == got,
            f"expected {name} = {expected!r} as in {path}, got {got!r}; resume with the same value, or start a new run "
            f"in another folder with --out. A resumed run may change {', '.join(alterable)}, device and devices.",
        )


def _fixed_settings(settings: dict[str, Any]) -> dict[str, Any]:
    location, name = split_reference(settings["task"]) if is_reference(settings["task"]) else ("", settings["task"])
    run_settings = {k: x for k, x in settings.items() if k not in ("options", "config")}
    hyperparameters = {k: x for k, x in settings["config"].items() if k not in ALTERABLE_HYPERPARAMETERS}
    options = {k: x for k, x in settings["options"].items() if k != "device"}
    return run_settings | {"task": f"{Path(location).name}:{name}" if location else name} | options | hyperparameters


def _require_same_on_hosts(metadata: Mapping[str, dict[str, Any]], **other_settings: Any) -> None:
    runs = {
        name: _fixed_settings(x["settings"]) | x["settings"]["config"] | {"code": x["code"]}
        for name, x in metadata.items()
    }
    settings = {f"{name} {key}".strip(): x for name, run in runs.items() for key, x in run.items()}
    require_same_settings({"trainings": list(metadata)} | other_settings | settings)


@contextmanager
def _iteration_bar(total: int, n_done: int, enabled: bool, run: _Run) -> Iterator[Callable[..., None]]:
    bar = progress_bar(unit="iteration", total=total, initial=n_done, ncols=100) if enabled else None
    if bar is None:
        yield lambda *_: None
        return
    with bar:
        shown: dict[str, str] = {}

        def show(metrics: dict[str, Any], iterations: int = 1) -> None:
            numbers = {k: float(np.median(metrics[k])) for k in ("success", "error", "reward") if k in metrics}
            shown.update({k: "none" if math.isnan(x) else f"{x:.3f}" for k, x in numbers.items()})
            bar.set_postfix(shown, refresh=False)
            bar.update(iterations)
            if bar.disable and not iterations:  # no terminal: a line at each evaluation
                text = ", ".join(f"{name} {value}" for name, value in shown.items())
                run.log(f"iteration {int(run.learner.iteration)} of {total}: {text}; {run.seconds:.0f} s")

        yield show
