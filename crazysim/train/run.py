"""A training run: a folder with a checkpoint, a learning curve, a policy and a film."""

from __future__ import annotations

import dataclasses
import itertools
import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import crazysim
from crazysim.deprecation import renamed, warn_renamed
from crazysim.envs.env import DroneEnv
from crazysim.envs.registry import entry_of, make
from crazysim.envs.statistics import RunningStats
from crazysim.envs.wrappers import AutoReset
from crazysim.errors import ConfigError, UnknownNameError
from crazysim.train import apg, checkpoint, ppo
from crazysim.train.evaluate import evaluate
from crazysim.train.export import describe
from crazysim.train.networks import Policy

ALGORITHMS: dict[str, Any] = {"ppo": ppo, "apg": apg}
"""Algorithms by name: modules with ``Config``, ``init`` and ``iterate``."""
CHECKPOINT, POLICY, CURVE = "checkpoint.npz", "policy.npz", "curve.json"
"""Names of the files of a run."""


@dataclass(frozen=True)
class Recipe:
    """Algorithm and hyperparameters that are known to solve a task."""

    algorithm: str = "ppo"
    """Name of the algorithm, a key of ``ALGORITHMS``."""
    n_worlds: int = 1024
    """Number of parallel worlds."""
    config: dict[str, Any] = field(default_factory=dict)
    """Hyperparameters that differ from the defaults of the algorithm."""
    practice: dict[str, Any] = field(default_factory=dict)
    """Options of the training environment that the evaluation environment does not have."""
    evaluate_every: int = 20
    """Iterations between evaluations; a checkpoint is written at each."""


RECIPES: dict[str, Recipe] = {
    "hover": Recipe(config={"iterations": 80}),
    "recover": Recipe(config={"iterations": 150}),
    "race": Recipe(
        n_worlds=4096,
        config={"iterations": 150, "entropy": 0.01, "init_std": 0.7},
        practice={"practice": True},
    ),
    "transport": Recipe(n_worlds=4096, config={"iterations": 400, "discount": 0.99}),
    "chase": Recipe(config={"iterations": 200, "discount": 0.99}),
    "deliver": Recipe(n_worlds=4096, config={"iterations": 1000, "discount": 0.99}),
    "track": Recipe("apg", n_worlds=64, config={"iterations": 100}),
}
"""Recipes by task; the default of other tasks is ``Recipe()``."""


@dataclass(frozen=True)
class TrainConfig:
    """Complete configuration of a run; a checkpoint resumes only with the same one."""

    task: str
    """Name of the task."""
    algorithm: str
    """Name of the algorithm, a key of ``ALGORITHMS``."""
    seed: int
    """Random seed."""
    n_worlds: int
    """Number of parallel worlds."""
    options: dict[str, Any]
    """Options of ``crazysim.envs.make``."""
    config: dict[str, Any]
    """Hyperparameters of the algorithm."""

    @staticmethod
    def create(
        task: str,
        algorithm: str | None = None,
        seed: int = 0,
        n_worlds: int | None = None,
        options: dict[str, Any] | None = None,
        config: dict[str, Any] | None = None,
    ) -> TrainConfig:
        """Return the configuration of a run; omitted values come from the recipe of the task.

        Args:
            task: Name of the task.
            algorithm: Name of the algorithm, a key of ``ALGORITHMS``.
            seed: Random seed.
            n_worlds: Number of parallel worlds.
            options: Options of ``crazysim.envs.make``.
            config: Hyperparameters of the algorithm.

        Raises:
            ConfigError: If the algorithm has no such hyperparameter.
            UnknownNameError: If there is no such task or algorithm.
        """
        entry_of(task)
        recipe = RECIPES.get(task, Recipe())
        if algorithm not in (None, recipe.algorithm):
            recipe = Recipe(algorithm)
        algorithm = recipe.algorithm
        if algorithm not in ALGORITHMS:
            raise UnknownNameError(f"expected an algorithm of {', '.join(ALGORITHMS)}, got {algorithm!r}")
        known = {f.name: f for f in dataclasses.fields(ALGORITHMS[algorithm].Config)}
        chosen = recipe.config | _with_new_names(algorithm, config or {})
        if wrong := [name for name in chosen if name not in known]:
            raise ConfigError(
                f"expected hyperparameters of {algorithm}, got {', '.join(wrong)}; use {', '.join(known)}"
            )
        full = dataclasses.asdict(ALGORITHMS[algorithm].Config(**chosen))
        full["hidden"] = list(full["hidden"])
        return TrainConfig(task, algorithm, seed, n_worlds or recipe.n_worlds, dict(options or {}), full)

    @staticmethod
    def from_meta(meta: dict[str, Any]) -> TrainConfig:
        """Return the configuration stored in the metadata of a checkpoint."""
        stored = meta["settings"]
        return TrainConfig(**stored | {"config": _with_new_names(stored["algorithm"], stored["config"])})

    def make_env(self, n_worlds: int | None = None, **defaults: Any) -> DroneEnv:
        """Return an environment of the run.

        Args:
            n_worlds: Number of worlds; None for that of the run.
            **defaults: Options of ``crazysim.envs.make`` where the run does not set them.
        """
        return make(self.task, n_worlds or self.n_worlds, **defaults | self.options)

    def with_device(self, device: str | None) -> TrainConfig:
        """Return the same configuration on another device, such as ``"cpu"``; None keeps the device."""
        return self if device is None else dataclasses.replace(self, options=self.options | {"device": device})

    def practice_options(self) -> dict[str, Any]:
        """Return the options of the training environment that the recipe of the task adds."""
        return dict(RECIPES.get(self.task, Recipe()).practice)

    def algorithm_config(self) -> Any:
        """Return the ``Config`` of the algorithm."""
        return ALGORITHMS[self.algorithm].Config(**self.config | {"hidden": tuple(self.config["hidden"])})


def _with_new_names(algorithm: str, config: dict[str, Any]) -> dict[str, Any]:
    """Return hyperparameters with those of 0.1 under their present names."""
    renamed = getattr(ALGORITHMS[algorithm], "RENAMED", {})
    for name in config:
        if name in renamed:
            warn_renamed(f"{algorithm} hyperparameter {name}", renamed[name])
    return {renamed.get(name, name): value for name, value in config.items()}


@dataclass
class TrainResult:
    """Outcome of a run."""

    folder: Path
    """Folder of the files of the run."""
    metrics: dict[str, float]
    """``success``, ``crashed``, ``error`` and ``reward`` on held-out initial states; ``seconds`` in all and
    ``compile_seconds`` of them, s; ``env_steps``, environment steps of all drones."""
    policy: Policy
    """Trained policy."""


def train(
    config: TrainConfig,
    folder: str | Path,
    resume: bool = False,
    evaluation_worlds: int = 1000,
    log: Callable[[str], None] = print,
    progress: bool = True,
) -> TrainResult:
    """Train a policy and write checkpoint, learning curve and policy into a folder.

    An interrupt (Ctrl-C) writes a checkpoint first. A resumed run is bit for bit the same as an uninterrupted one on
    the same machine.

    Args:
        config: Configuration of the run.
        folder: Folder of the run.
        resume: True to continue from the checkpoint in the folder.
        evaluation_worlds: Number of held-out initial states of each evaluation.
        log: Function that is called with each line of output.
        progress: True to show a progress bar, if tqdm is installed.

    Raises:
        ConfigError: If the folder holds a run and ``resume`` is False, or the run has another configuration.
        KeyboardInterrupt: After the checkpoint of an interrupted run has been written.
    """
    folder = Path(folder)
    path = folder / CHECKPOINT
    started = time.perf_counter()
    algorithm, hyperparameters = ALGORITHMS[config.algorithm], config.algorithm_config()
    # A gradient runs on lanes in any case; a kernel for the forward pass would take longer to compile than it saves.
    engine = {"engine": "lanes"} if algorithm is apg else {}
    base = config.make_env(config.n_worlds, **engine | config.practice_options())
    env = base if algorithm is apg else AutoReset(base)
    eval_env = config.make_env(evaluation_worlds)
    key = jax.random.fold_in(jax.random.key(config.seed), 1)
    curve = []
    if resume:
        _require_same(path, config)
        curve = json.loads((folder / CURVE).read_text())
    elif path.exists():
        raise ConfigError(
            f"expected a folder without a run, got {folder}; continue the run with --resume, or choose another folder "
            f"with --out"
        )
    init = jax.jit(algorithm.init, static_argnums=(0, 1))
    shapes = init.eval_shape(env, hyperparameters, key)

    def start() -> tuple[Any, dict[str, float]]:
        if resume:
            learner = jax.device_put(checkpoint.load(path, shapes), base.sim.device)
        else:
            learner = init(env, hyperparameters, jax.device_put(key, base.sim.device))
        return learner, evaluate(eval_env, learner.as_policy())

    def compile_iteration() -> tuple[Any, float]:
        compiling = time.perf_counter()
        compiled = algorithm.iterate.lower(_placed(shapes, base.sim.device), env, hyperparameters).compile()
        return compiled, time.perf_counter() - compiling

    with ThreadPoolExecutor(2) as pool:  # each compiles for seconds, mostly on one core
        starting, compiling = pool.submit(start), pool.submit(compile_iteration)
        (learner, metrics), (iterate, compile_s) = starting.result(), compiling.result()
    done, seconds_before = int(learner.iteration), curve[-1]["seconds"] if curve else 0.0
    steps_per_iteration = config.n_worlds * base.sim.n_drones * hyperparameters.n_steps
    log(
        f"{config.task} by {config.algorithm}, seed {config.seed}: {hyperparameters.iterations} iterations of "
        f"{steps_per_iteration:,} steps in {config.n_worlds:,} worlds, {base.sim.control.value} commands, "
        f"{base.sim.explain().splitlines()[0]}" + (f"; continues after iteration {done}" if done else "")
    )

    def record(learner: Any, metrics: dict[str, float] | None = None) -> dict[str, float]:
        """Evaluate the policy, and write policy, learning curve and checkpoint."""
        metrics = metrics or evaluate(eval_env, learner.as_policy())
        iteration = int(learner.iteration)
        seconds = seconds_before + time.perf_counter() - started
        point = {"round": iteration, "env_steps": iteration * steps_per_iteration, "seconds": seconds, **metrics}
        point["compile_seconds"] = compile_s
        curve.append(point)
        save_policy(folder / POLICY, learner.as_policy(), base, config)
        (folder / CURVE).write_text(json.dumps(curve, indent=1))
        checkpoint.save(path, learner, _meta(config))
        return point

    if not resume:
        record(learner, metrics)
    every = RECIPES.get(config.task, Recipe()).evaluate_every
    try:
        with _bar(hyperparameters.iterations, done, progress) as show:
            for i in range(done, hyperparameters.iterations):
                learner, metrics = iterate(learner)
                show(metrics if i % 5 == 0 else None)
                if (i + 1) % every == 0 and i + 1 < hyperparameters.iterations:
                    show(record(learner), 0)
    except KeyboardInterrupt:
        jax.block_until_ready(learner)
        record(learner)
        log(f"interrupted after iteration {int(learner.iteration)}; wrote {path}; continue with --resume")
        raise
    point = record(learner)
    log(
        f"success {point['success']:.1%} of {evaluation_worlds:,} held-out starts (error below "
        f"{base.task.tolerance:g} for the last {base.task.hold:g} s), mean error {point['error']:.4f}, crashed "
        f"{point['crashed']:.1%}; {point['env_steps']:,} steps in {point['seconds']:.1f} s, including "
        f"{compile_s:.1f} s of compilation"
    )
    return TrainResult(folder, point, learner.as_policy())


def _placed(shapes: Any, device: jax.Device) -> Any:
    """Return the shapes with a device attached."""
    place = jax.sharding.SingleDeviceSharding(device)
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place), shapes)


def save_policy(path: Path, policy: Policy, env: DroneEnv, config: TrainConfig) -> None:
    """Write a policy with the description of its inputs and outputs."""
    checkpoint.save(path, policy, _meta(config) | describe(env))


def load_policy(folder: str | Path) -> tuple[Policy, TrainConfig, dict[str, Any]]:
    """Return the policy of a run, its configuration, and the description of its inputs and outputs.

    Raises:
        ConfigError: If the folder holds no policy that this version can read.
    """
    path = Path(folder) / POLICY
    meta = checkpoint.read_meta(path)
    config = TrainConfig.from_meta(meta)
    n_obs, n_actions = sum(meta["observations"].values()), len(meta["actions"]["centre"])
    sizes = (n_obs, *config.config["hidden"], n_actions)
    dtype = jnp.zeros(()).dtype
    layers = [
        (jax.ShapeDtypeStruct((a, b), dtype), jax.ShapeDtypeStruct((b,), dtype)) for a, b in itertools.pairwise(sizes)
    ]
    stats = jax.eval_shape(lambda: RunningStats.create(n_obs))
    return checkpoint.load(path, Policy(stats, layers)), config, meta


def _meta(config: TrainConfig) -> dict[str, Any]:
    return {"crazysim": crazysim.__version__, "settings": dataclasses.asdict(config)}


def _require_same(path: Path, config: TrainConfig) -> None:
    """Check that a checkpoint belongs to a run with this configuration.

    Raises:
        ConfigError: With the first difference.
    """
    meta = checkpoint.read_meta(path)
    if meta["crazysim"] != crazysim.__version__:
        raise ConfigError(
            f"expected a checkpoint of crazysim {crazysim.__version__}, got {path} of {meta['crazysim']}; start a new "
            f"run in another folder with --out"
        )
    stored = dataclasses.asdict(TrainConfig.from_meta(meta))
    for name, value in json.loads(json.dumps(dataclasses.asdict(config))).items():
        if stored[name] != value:
            raise ConfigError(
                f"expected {name} = {stored[name]!r} as in {path}, got {value!r}; resume with the same value, or start "
                f"a new run in another folder with --out"
            )


@contextmanager
def _bar(total: int, done: int, wanted: bool) -> Iterator[Callable[..., None]]:
    """Yield a function that shows metrics on a progress bar; without ``wanted`` or tqdm it does nothing."""
    try:
        if not wanted:
            raise ImportError
        from tqdm import tqdm
    except ImportError:
        yield lambda *_: None
        return
    with tqdm(total=total, initial=done, unit="iteration", ncols=100) as bar:
        shown: dict[str, str] = {}

        def show(metrics: dict[str, Any] | None, iterations: int = 1) -> None:
            if metrics is not None:
                known = {k: metrics[k] for k in ("success", "error", "reward") if k in metrics}
                shown.update({k: f"{float(np.asarray(v)):.3f}" for k, v in known.items()})
                bar.set_postfix(shown, refresh=False)
            bar.update(iterations)

        yield show


__getattr__ = renamed(
    __name__,
    {"Settings": "crazysim.train.run:TrainConfig", "Result": "crazysim.train.run:TrainResult"},
)
