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
"""Each a module with ``Config``, ``init`` and ``iterate``."""
CHECKPOINT, POLICY, CURVE = "checkpoint.npz", "policy.npz", "curve.json"
"""Files of a run."""


@dataclass(frozen=True)
class Recipe:
    """Settings with which a task is learnt."""

    algorithm: str = "ppo"
    """One of ``ALGORITHMS``."""
    n_worlds: int = 1024
    """Worlds that are flown at once."""
    config: dict[str, Any] = field(default_factory=dict)
    """What differs from the algorithm's own settings."""
    practice: dict[str, Any] = field(default_factory=dict)
    """Options of the environment that is learnt in, beyond those of the one that is judged in."""
    evaluate_every: int = 20
    """Rounds from one evaluation, and checkpoint, to the next."""


RECIPES: dict[str, Recipe] = {
    "hover": Recipe(config={"iterations": 80}),
    "recover": Recipe(config={"iterations": 150}),
    "race": Recipe(
        n_worlds=4096,
        config={"iterations": 150, "entropy": 0.01, "init_std": 0.7},
        practice={"practice": True},
    ),
    "track": Recipe("apg", n_worlds=64, config={"iterations": 100}),
}
"""What is known to work, by task; every other task begins with ``Recipe()``."""


@dataclass(frozen=True)
class Settings:
    """What a run is made with; a checkpoint goes on only with the same."""

    task: str
    """Name of the task."""
    algorithm: str
    """Name of the algorithm."""
    seed: int
    """Seed of everything random."""
    n_worlds: int
    """Worlds that are flown at once."""
    options: dict[str, Any]
    """Options of ``crazysim.envs.make``."""
    config: dict[str, Any]
    """Settings of the algorithm."""

    @staticmethod
    def create(
        task: str,
        algorithm: str | None = None,
        seed: int = 0,
        n_worlds: int | None = None,
        options: dict[str, Any] | None = None,
        config: dict[str, Any] | None = None,
    ) -> Settings:
        """Return the settings of a run, from the task's recipe where nothing else is said.

        Raises:
            ConfigError: If the algorithm has no such setting.
            UnknownNameError: If there is no such task or algorithm.
        """
        entry_of(task)
        recipe = RECIPES.get(task, Recipe())
        if algorithm not in (None, recipe.algorithm):
            recipe = Recipe(algorithm)
        algorithm = recipe.algorithm
        if algorithm not in ALGORITHMS:
            raise UnknownNameError(f"algorithm {algorithm!r} does not exist; there are {', '.join(ALGORITHMS)}")
        known = {f.name: f for f in dataclasses.fields(ALGORITHMS[algorithm].Config)}
        chosen = recipe.config | (config or {})
        if wrong := [name for name in chosen if name not in known]:
            raise ConfigError(f"{algorithm} has no setting {', '.join(wrong)}; it has {', '.join(known)}")
        full = dataclasses.asdict(ALGORITHMS[algorithm].Config(**chosen))
        full["hidden"] = list(full["hidden"])
        return Settings(task, algorithm, seed, n_worlds or recipe.n_worlds, dict(options or {}), full)

    def environment(self, n_worlds: int | None = None, **options: Any) -> DroneEnv:
        """Return the environment of the run, or one like it with other worlds, and options that the run leaves open."""
        return make(self.task, n_worlds or self.n_worlds, **options | self.options)

    def on(self, device: str | None) -> Settings:
        """Return the same for another device, such as ``"cpu"``; None for that of the run."""
        return self if device is None else dataclasses.replace(self, options=self.options | {"device": device})

    def practice(self) -> dict[str, Any]:
        """Return options of the environment that is learnt in, as the task's recipe has them."""
        return dict(RECIPES.get(self.task, Recipe()).practice)

    def algorithm_config(self) -> Any:
        """Return the settings of the algorithm, as it wants them."""
        return ALGORITHMS[self.algorithm].Config(**self.config | {"hidden": tuple(self.config["hidden"])})


@dataclass
class Result:
    """How a run went."""

    folder: Path
    """Where its files are."""
    figures: dict[str, float]
    """``success``, ``crashed``, ``error``, ``reward`` over held-out starts; ``seconds``, and ``compile_seconds`` of
    these; ``env_steps``, steps of drones."""
    policy: Policy
    """What was learnt."""


def train(
    settings: Settings,
    folder: str | Path,
    resume: bool = False,
    evaluation_worlds: int = 1000,
    say: Callable[[str], None] = print,
    progress: bool = True,
) -> Result:
    """Train a policy, and keep a checkpoint, a learning curve and the policy in a folder.

    An interrupt (Ctrl-C) writes a checkpoint first. What is learnt after a checkpoint was loaded is bit for bit what
    would have been learnt without the interruption, on the same machine.

    Args:
        settings: What is learnt, and how.
        folder: Where the files go.
        resume: Whether to go on from the checkpoint that is there.
        evaluation_worlds: Held-out starts of each evaluation.
        say: Prints a line.
        progress: Whether to show a bar, where tqdm is installed.

    Raises:
        ConfigError: If there is a run in the folder already and ``resume`` is not said, or it is of other settings.
        KeyboardInterrupt: After the checkpoint of an interrupted run was written.
    """
    folder = Path(folder)
    path = folder / CHECKPOINT
    begin = time.perf_counter()
    algorithm, config = ALGORITHMS[settings.algorithm], settings.algorithm_config()
    # A gradient runs on lanes in any case; a kernel for the way forward would take longer to compile than it saves.
    engine = {"engine": "lanes"} if algorithm is apg else {}
    base = settings.environment(settings.n_worlds, **engine | settings.practice())
    env = base if algorithm is apg else AutoReset(base)
    judge = settings.environment(evaluation_worlds)
    key = jax.random.fold_in(jax.random.key(settings.seed), 1)
    curve = []
    if resume:
        _require_same(path, settings)
        curve = json.loads((folder / CURVE).read_text())
    elif path.exists():
        raise ConfigError(
            f"there is a run in {folder} already; go on with it with --resume, or choose another folder with --out"
        )
    shapes = jax.eval_shape(lambda k: algorithm.init(env, config, k), key)

    def start() -> tuple[Any, dict[str, float]]:
        if resume:
            learner = jax.device_put(checkpoint.load(path, shapes), base.sim.device)
        else:
            learner = jax.jit(lambda k: algorithm.init(env, config, k))(jax.device_put(key, base.sim.device))
        return learner, evaluate(judge, learner.as_policy())

    def compile_round() -> tuple[Any, float]:
        compiling = time.perf_counter()
        return algorithm.iterate.lower(_placed(shapes, base.sim.device), env, config).compile(), (
            time.perf_counter() - compiling
        )

    with ThreadPoolExecutor(2) as pool:  # each compiles for seconds, mostly on one core
        starting, rounds = pool.submit(start), pool.submit(compile_round)
        (learner, figures), (step, compile_s) = starting.result(), rounds.result()
    done, before = int(learner.iteration), curve[-1]["seconds"] if curve else 0.0
    per_round = settings.n_worlds * base.sim.n_drones * config.n_steps
    say(
        f"{settings.task} by {settings.algorithm}, seed {settings.seed}: {config.iterations} rounds of {per_round:,} "
        f"steps in {settings.n_worlds:,} worlds, {base.sim.control.value} commands, "
        f"{base.sim.explain().splitlines()[0]}" + (f"; goes on after round {done}" if done else "")
    )

    def keep(learner: Any, figures: dict[str, float] | None = None) -> dict[str, float]:
        figures = figures or evaluate(judge, learner.as_policy())
        rounds = int(learner.iteration)
        seconds = before + time.perf_counter() - begin
        point = {"round": rounds, "env_steps": rounds * per_round, "seconds": seconds, **figures}
        point["compile_seconds"] = compile_s
        curve.append(point)
        save_policy(folder / POLICY, learner.as_policy(), base, settings)
        (folder / CURVE).write_text(json.dumps(curve, indent=1))
        checkpoint.save(path, learner, _meta(settings))
        return point

    if not resume:
        keep(learner, figures)
    every = RECIPES.get(settings.task, Recipe()).evaluate_every
    try:
        with _bar(config.iterations, done, progress) as show:
            for i in range(done, config.iterations):
                learner, figures = step(learner)
                show(figures if i % 5 == 0 else None)
                if (i + 1) % every == 0 and i + 1 < config.iterations:
                    show(keep(learner), 0)
    except KeyboardInterrupt:
        jax.block_until_ready(learner)
        keep(learner)
        say(f"interrupted after round {int(learner.iteration)}; its checkpoint is {path}; --resume goes on from there")
        raise
    point = keep(learner)
    say(
        f"success {point['success']:.1%} of {evaluation_worlds:,} held-out starts (error below "
        f"{base.task.tolerance:g} for the last {base.task.hold:g} s), mean error {point['error']:.4f}, crashed "
        f"{point['crashed']:.1%}; {point['env_steps']:,} steps in {point['seconds']:.1f} s, {compile_s:.1f} s of it "
        f"compiling"
    )
    return Result(folder, point, learner.as_policy())


def _placed(shapes: Any, device: jax.Device) -> Any:
    """Return shapes of arrays that are on a device."""
    place = jax.sharding.SingleDeviceSharding(device)
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place), shapes)


def save_policy(path: Path, policy: Policy, env: DroneEnv, settings: Settings) -> None:
    """Write a policy, with what its inputs and outputs mean."""
    checkpoint.save(path, policy, _meta(settings) | describe(env))


def load_policy(folder: str | Path) -> tuple[Policy, Settings, dict[str, Any]]:
    """Return a run's policy, its settings, and what its inputs and outputs mean.

    Raises:
        ConfigError: If there is none, or it is of another version.
    """
    path = Path(folder) / POLICY
    meta = checkpoint.read_meta(path)
    settings = Settings(**meta["settings"])
    n_obs, n_actions = sum(meta["observations"].values()), len(meta["actions"]["centre"])
    sizes = (n_obs, *settings.config["hidden"], n_actions)
    dtype = jnp.zeros(()).dtype
    layers = [
        (jax.ShapeDtypeStruct((a, b), dtype), jax.ShapeDtypeStruct((b,), dtype)) for a, b in itertools.pairwise(sizes)
    ]
    stats = jax.eval_shape(lambda: RunningStats.create(n_obs))
    return checkpoint.load(path, Policy(stats, layers)), settings, meta


def _meta(settings: Settings) -> dict[str, Any]:
    return {"crazysim": crazysim.__version__, "settings": dataclasses.asdict(settings)}


def _require_same(path: Path, settings: Settings) -> None:
    """Check that a checkpoint is of a run with these settings.

    Raises:
        ConfigError: With what differs.
    """
    meta = checkpoint.read_meta(path)
    if meta["crazysim"] != crazysim.__version__:
        raise ConfigError(f"{path} is of crazysim {meta['crazysim']}, and this is {crazysim.__version__}")
    now = json.loads(json.dumps(dataclasses.asdict(settings)))
    for name, value in now.items():
        if meta["settings"][name] != value:
            raise ConfigError(
                f"{path} was made with {name} = {meta['settings'][name]!r}, and now it is {value!r}; go on with the "
                f"same, or begin in another folder with --out"
            )


@contextmanager
def _bar(total: int, done: int, wanted: bool) -> Iterator[Callable[..., None]]:
    """Give a function that shows a round's figures on a bar, where there is to be one and tqdm is installed."""
    try:
        if not wanted:
            raise ImportError
        from tqdm import tqdm
    except ImportError:
        yield lambda *_: None
        return
    with tqdm(total=total, initial=done, unit="round", ncols=100) as bar:
        shown: dict[str, str] = {}

        def show(figures: dict[str, Any] | None, rounds: int = 1) -> None:
            if figures is not None:
                wanted = {k: figures[k] for k in ("success", "error", "reward") if k in figures}
                shown.update({k: f"{float(np.asarray(v)):.3f}" for k, v in wanted.items()})
                bar.set_postfix(shown, refresh=False)
            bar.update(rounds)

        yield show
