"""Search for hyperparameters with which PPO learns a task: many trainings in one program, and more seeds for the best.

A round trains as many policies as the program has places. The first round compares settings with one seed each, the
second gives the four best other seeds, and later rounds compare the best with new settings near it.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array

from crazysim.core.settings import find_device
from crazysim.engine.cache import announce_if_slow, keep_programs
from crazysim.envs.registry import entry_of
from crazysim.envs.state import terms_of
from crazysim.envs.task import Task
from crazysim.envs.wrappers import RewardTerms
from crazysim.errors import require
from crazysim.storage import as_path, make_folder, write_file
from crazysim.train import ppo
from crazysim.train.config import TrainConfig
from crazysim.train.evaluation import evaluate_blocks, held_out_key
from crazysim.train.networks import Policies
from crazysim.train.seeds import stack_configs
from crazysim.train.show import plot_search
from crazysim.train.training import wrap_env

TUNE_FILE = "tune.json"
"""Name of the file of a run with the recipe that was found, and with all that were tried."""
SEARCHES = ("hyperparameters", "rewards")
"""What to search: hyperparameters, or also factors of the terms of the reward."""
RANGES = {
    "discount": (0.003, 0.03),
    "gae_lambda": (0.01, 0.1),
    "entropy": (0.001, 0.05),
    "learning_rate": (3e-4, 2e-3),
    "clip": (0.1, 0.3),
}
"""Ranges of hyperparameters, in which their logarithms are drawn; of ``COMPLEMENTS``, those of 1 - x."""
COMPLEMENTS = ("discount", "gae_lambda")
"""Hyperparameters whose distance from 1 is drawn."""
FACTORS = (0.1, 3.0)
"""Range of factors of the terms of the reward."""


@dataclass(frozen=True)
class Size:
    """Size of the program that searches."""

    seconds: float
    """Default time for the search, s."""
    n_places: int
    """Number of policies that a round trains."""
    n_worlds: int
    """Number of worlds of each."""
    iterations: int = 100
    """Number of iterations of a round; fewer if the training has fewer."""


SIZES = {"cpu": Size(300.0, 4, 512), "gpu": Size(60.0, 16, 2048)}
"""Sizes by platform."""
MAX_ROUNDS = 20
"""Largest number of rounds."""
N_EVALUATIONS, N_STARTS = 5, 200
"""Number of evaluations in a round, and of the initial states of each."""


@dataclass
class Candidate:
    """Settings that are tried."""

    settings: dict[str, Any]
    """Hyperparameters, and ``rewards``, that differ from those with which the search began."""
    curves: list[list[float]] = field(default_factory=list)
    """Successes of the evaluations with each seed."""
    errors: list[float] = field(default_factory=list)
    """Least error with each seed, in the unit of the task."""

    @property
    def score(self) -> tuple[float, float, float]:
        """Best success of the curve in %, a mean over seeds without digits; mean success; negated mean error."""
        best = 100 * np.mean([max(curve) for curve in self.curves])
        return round(float(best)), float(np.mean(self.curves)), -float(np.mean(self.errors))


def tune(
    task: str | Task,
    folder: str | Path | None = None,
    *,
    search: str = "hyperparameters",
    seconds: float | None = None,
    seed: int = 0,
    log: Callable[[str], None] = print,
    **settings: Any,
) -> dict[str, Any]:
    """Search for the hyperparameters with which PPO learns a task, and return those that differ from its recipe.

    Args:
        task: As for ``run``.
        folder: Folder for ``tune.json`` and ``tune.png``; None to write nothing.
        search: ``"hyperparameters"``, or ``"rewards"`` for factors of the terms of the reward as well.
        seconds: Time for the search, s, but for compilation and a fifth of a round at least; None for 60 on a GPU,
            and 300 on a CPU.
        seed: Random seed of the search.
        log: Function that is called with each line.
        settings: ``options`` and ``config`` of ``TrainConfig.create``; hyperparameters in ``config`` stay as they are.
    """
    require(search in SEARCHES, f"expected a search for {' or '.join(SEARCHES)}, got {search!r}. Use 'rewards'.")
    start_time, random = time.perf_counter(), np.random.default_rng(seed)
    trial = _Trial(TrainConfig.create(task, "ppo", **settings), search, settings.get("config") or {})
    seconds = trial.size.seconds if seconds is None else seconds
    candidates = [Candidate({}), *(trial.draw(random) for _ in range(trial.size.n_places - 1))]
    log(
        f"searching {', '.join(trial.names)} for {seconds:.0f} s: {trial.size.n_places} policies a round, each "
        f"{trial.iterations} iterations in {trial.size.n_worlds:,} worlds"
    )
    n_places, best = trial.size.n_places, candidates[0]
    for number in range(1, MAX_ROUNDS + 1):
        n_seeds = 1 if number == 1 else min(4, n_places // 2)
        n_entrants = n_places // n_seeds
        entrants = candidates[:n_entrants]
        if number > 2:  # the best, with more seeds, against new ones near it
            entrants = [best, *(trial.draw(random, best.settings) for _ in range(n_entrants - 1))]
            candidates += entrants[1:]
        round_start = time.perf_counter()
        trial.fly(entrants, [1000 * number + i for i in range(n_seeds)], start_time + seconds)
        candidates = [candidate for candidate in candidates if candidate.curves]
        candidates.sort(key=lambda candidate: candidate.score, reverse=True)
        best = next((x for x in candidates if len(x.curves) > 1), candidates[0])
        duration = time.perf_counter() - round_start
        log(f"round {number}: {_describe(best, trial.unit)}; {time.perf_counter() - start_time:.0f} s")
        if time.perf_counter() - start_time + duration > seconds:  # the next round would not end in time
            break
    recipe = best.settings if best.score[0] else {}
    if folder is not None:
        _write(as_path(folder), trial, candidates, recipe, log)
    if number == 1:
        log(f"one round is partly luck, since the best of {n_places} was taken; use --tune-seconds {5 * seconds:g}")
    if not best.score[0]:
        log("no policy succeeded, so nothing is changed; see --check, and define demonstrate(obs)")
    elif recipe:
        log(f"to keep it, write into the class: recipe = {json.dumps(trial.class_recipe | recipe)}")
    else:
        log("nothing better than the settings with which the search began was found")
    return recipe


class _Trial:
    """The compiled program in which candidates are trained, and the ranges from which they are drawn."""

    def __init__(self, config: TrainConfig, search: str, given: Mapping[str, Any]):
        platform = find_device(config.options.get("device", "cpu")).platform
        self.size = SIZES["cpu" if platform == "cpu" else "gpu"]
        n_places, n_worlds = self.size.n_places, self.size.n_worlds
        self.iterations = min(self.size.iterations, config.config["iterations"])
        first = {x: min(config.config[x], self.iterations // 4) for x in ("demonstrations", "value_iterations")}
        hyperparameters = config.config | first | {"iterations": self.iterations}
        self.class_recipe = dict(entry_of(config.task).task.recipe)
        self.config = dataclasses.replace(config, n_worlds=n_worlds, config=hyperparameters)
        env = self.config.make_training_env(n_places)
        self.eval_env, self.unit = self.config.make_env(n_places * N_STARTS), env.task.unit
        self.terms: list[str] = []
        if search == "rewards":
            self.terms = [*terms_of(jax.eval_shape(RewardTerms(env).reset, held_out_key()).info)]
            hyperparameters["rewards"] = {name: 1.0 for name in self.terms} | dict(config.config["rewards"])
            self.config = dataclasses.replace(self.config, config=hyperparameters)
        self.ranges = {name: limits for name, limits in RANGES.items() if name not in given}
        self.names = [*self.ranges, *self.terms]
        base = self.config.algorithm_config()
        self.env = env = wrap_env(env, base)

        @jax.jit
        def init(seeds: Array) -> ppo.Learner:
            return ppo.init(env, (base,) * n_places, jax.vmap(jax.random.key)(seeds))

        @jax.jit
        def advance(learner: ppo.Learner, values: Any) -> ppo.Learner:
            return ppo.advance(learner, env, stack_configs((base,)).replace(values=values))[0]

        self.init, self.advance = init, advance

    def draw(self, random: np.random.Generator, near: dict[str, Any] | None = None) -> Candidate:
        def number(low: float, high: float, middle: float) -> float:
            if near is None:
                return float(np.exp(random.uniform(np.log(low), np.log(high))))
            return float(np.clip(middle * np.exp(random.normal() * np.log(high / low) / 8), low, high))

        settings: dict[str, Any] = {}
        for name, limits in self.ranges.items():
            middle = (near or {}).get(name, self.config.config[name])
            x = number(*limits, 1 - middle if name in COMPLEMENTS else middle)
            settings[name] = float(f"{1 - x:.4g}" if name in COMPLEMENTS else f"{x:.2g}")
        middles = dict((near or {}).get("rewards", {}))
        if factors := {name: float(f"{number(*FACTORS, middles.get(name, 1.0)):.2g}") for name in self.terms}:
            settings["rewards"] = factors
        return Candidate(settings)

    @keep_programs()
    def fly(self, candidates: list[Candidate], seeds: list[int], deadline: float) -> None:
        # Only the first round may be cut short.
        places = [(candidate, seed) for candidate in candidates for seed in seeds]
        base = self.config.config
        configs = [ppo.Config(**base | candidate.settings) for candidate, _ in places]
        values = jax.device_put(stack_configs(configs).values, self.eval_env.sim.device)
        device, evaluations = self.eval_env.sim.device, []
        with announce_if_slow("compiling the search", "10 to 60 s"):
            learner = self.advance(self.init(jax.device_put(np.array([seed for _, seed in places]), device)), values)
        for n_done in range(1, self.iterations + 1):
            learner = learner if n_done == 1 else self.advance(learner, values)
            if n_done * N_EVALUATIONS % self.iterations < N_EVALUATIONS:
                evaluations.append(self._evaluate(learner))
                if time.perf_counter() > deadline and n_done < self.iterations:
                    if any(candidate.curves for candidate in candidates):
                        return  # a round that is cut short does not count against others
                    break
        for i, (candidate, _) in enumerate(places):
            results = [evaluation[i] for evaluation in evaluations]
            candidate.curves.append([result["success"] for result in results])
            errors = [result["error"] for result in results if result["error"] == result["error"]]
            candidate.errors.append(min(errors, default=1e9))

    def _evaluate(self, learner: ppo.Learner) -> list[dict[str, float]]:
        return evaluate_blocks(self.eval_env, Policies(learner.as_policy()), None, self.size.n_places)


def _describe(candidate: Candidate, unit: str) -> str:
    best, _, error = candidate.score
    n = len(candidate.curves)
    text = f"best so far: success {best}% with {n} seed{'s' * (n > 1)}, error {-error:.3g} {unit}, with "
    return text + (json.dumps(candidate.settings) if candidate.settings else "the settings of the start")


def _write(
    folder: Path, trial: _Trial, candidates: list[Candidate], recipe: dict[str, Any], log: Callable[[str], None]
) -> None:
    make_folder(folder)
    rows = [dataclasses.asdict(candidate) | {"success": candidate.score[0]} for candidate in candidates]
    size = {"iterations": trial.iterations, "n_worlds": trial.size.n_worlds, "n_starts": N_STARTS}
    found = {"recipe": recipe, **size, "start": trial.config.config, "candidates": rows}
    write_file(folder / TUNE_FILE, json.dumps(found, indent=1))
    first = {name: trial.config.config[name] for name in trial.ranges} | dict.fromkeys(trial.terms, 1.0)
    settings = [first | candidate.settings | candidate.settings.get("rewards", {}) for candidate in candidates]
    values = {name: [x[name] for x in settings] for name in trial.names}
    try:
        success = [candidate.score[0] for candidate in candidates]
        plot_search(values, success, [x.settings for x in candidates].index(recipe), folder / "tune.png")
        log(f"wrote {folder / TUNE_FILE}, {folder / 'tune.png'}")
    except ImportError as error:
        log(f"wrote {folder / TUNE_FILE}; no plot: {error}")
