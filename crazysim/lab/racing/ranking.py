"""Ranking of controllers of lsy_drone_racing and of policies by their runs through the gates of one level."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import re
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

import crazysim
from crazysim.envs.tasks.race import Race
from crazysim.errors import expect, require
from crazysim.lab.racing.controllers import Run, control_of, fly_controller, loaded
from crazysim.storage import write_file
from crazysim.train.evaluation import fly_episodes
from crazysim.train.interface import check_policy
from crazysim.train.training import POLICY_FILE, load_policy

DEFINES_CONTROLLER = re.compile(r"^class \w+\([^)]*Controller\b", re.MULTILINE)
"""Text of a file with a controller, in a folder that also holds other modules."""


@dataclass(frozen=True)
class Score:
    """Runs of one controller or policy."""

    name: str
    """Path of its file or folder, without what all paths share."""
    times: list[float | None]
    """Time of the last gate in every run, s; None for a run that missed a gate."""
    error: str = ""
    """Exception that ended its runs; empty without."""

    @property
    def finished(self) -> float:
        """Share of the runs that passed all gates."""
        return len(self.finish_times) / max(len(self.times), 1)

    @property
    def finish_times(self) -> list[float]:
        """Times of the runs that passed all gates, s."""
        return [time for time in self.times if time is not None]

    @property
    def order(self) -> tuple[bool, bool, float, float]:
        """Key by which scores are sorted: by the mean time if at least half of the runs were finished, after those by
        the share of finished runs, and last those with an error.
        """
        ranked = self.finished >= 0.5
        return bool(self.error), not ranked, float(np.mean(self.finish_times)) if ranked else 0.0, -self.finished


def find_pilots(paths: Sequence[Path]) -> list[Path]:
    """Return controller files and folders of training runs, from such paths and from folders that hold them."""
    pilots: list[Path] = []
    for path in paths:
        require(path.exists(), f"expected a controller file or a folder, got {str(path)!r}, which does not exist")
        if path.is_file() or (path / POLICY_FILE).exists():
            pilots.append(path)
            continue
        files = [x for x in path.glob("*.py") if DEFINES_CONTROLLER.search(x.read_text("utf-8", "replace"))]
        pilots += sorted([*files, *(x.parent for x in path.glob(f"*/{POLICY_FILE}"))])
    names = ", ".join(map(str, paths))
    expect(
        pilots, "controller files (.py) or folders of training runs", names, "Name a file, or a folder that has some."
    )
    return pilots


def rank(
    paths: Sequence[Path], level: int, n_runs: int, seed: int = 1, on_run: Callable[[Run], None] | None = None
) -> list[Score]:
    """Fly controllers and policies, and return their scores, the best first.

    All controllers fly the same tracks, starts and disturbances. A policy flies the task with which it was trained.
    What controllers print goes to the standard error, and so does the traceback of one that raises; the others fly.

    Args:
        paths: Controller files, folders of training runs, and folders that hold them.
        level: Level of the race, 0 to 3.
        on_run: Called with every run of a controller.
    """
    pilots = find_pilots(paths)
    parent = os.path.commonpath([path.resolve().parent for path in pilots])
    scores = []
    for path in pilots:
        name, times, error = os.path.relpath(path.resolve(), parent), [], ""
        try:
            with contextlib.redirect_stdout(sys.stderr):
                if path.is_dir():
                    times = _policy_times(path, level, n_runs, seed)
                    continue
                with loaded(path) as controller:
                    control = control_of(controller, level)
                    for k in range(n_runs):
                        run = fly_controller(controller, control, level, seed + k)
                        times.append(run.time if run.finished else None)
                        if on_run is not None:
                            on_run(run)
        except (Exception, SystemExit) as exception:
            traceback.print_exc()
            error = f"{type(exception).__name__}: {exception}".splitlines()[0]
        finally:
            scores.append(Score(name, times, error))
    return sorted(scores, key=lambda score: score.order)


def _policy_times(folder: Path, level: int, n_runs: int, seed: int) -> list[float | None]:
    policy, config, _ = load_policy(folder)
    env = config.with_options(level=level, device="cpu").make_env(n_runs)
    expect(isinstance(env.task, Race), "a policy of the task race", config.task)
    check_policy(policy, env)
    flight = fly_episodes(env, policy, jax.random.key(seed))
    steps = np.argmax(np.asarray(flight["over"]), axis=0) + 1
    finished = np.asarray(flight["succeeded"])[:, 0]
    return [float(k) / env.base.freq if ok else None for k, ok in zip(steps, finished, strict=True)]


def table(scores: Sequence[Score]) -> str:
    """Return a table in Markdown."""
    rows = [["", "Name", "Finished", "Mean, s", "Best, s", "Error"]]
    for place, score in enumerate(scores, 1):
        times = score.finish_times
        numbers = [f"{np.mean(times):.3f}", f"{min(times):.2f}"] if times else ["", ""]
        rows.append([str(place), score.name, f"{score.finished:.0%}", *numbers, score.error.replace("|", "/")])
    if not any(row[-1] for row in rows[1:]):
        rows = [row[:-1] for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    rows.insert(1, ["-" * width for width in widths])
    return "\n".join("| " + " | ".join(map(str.ljust, row, widths)) + " |" for row in rows)


def write(scores: Sequence[Score], path: Path, level: int, n_runs: int, seed: int) -> None:
    """Write scores as a table, .md, or with the time of every run, .json."""
    settings = {"level": level, "runs": n_runs, "seed": seed}
    if path.suffix == ".md":
        text = ", ".join(f"{name} {value}" for name, value in settings.items())
        write_file(path, f"{table(scores)}\n\ncrazysim {crazysim.__version__}, jax {jax.__version__}, {text}\n")
        return
    entries: list[dict[str, Any]] = [{"finished": score.finished, **dataclasses.asdict(score)} for score in scores]
    versions = {"crazysim": crazysim.__version__, "jax": jax.__version__}
    write_file(path, json.dumps({**settings, **versions, "scores": entries}, indent=1) + "\n")
