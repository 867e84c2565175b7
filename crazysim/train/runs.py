"""Training runs: training, evaluation, plots and a film, in one folder."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from crazysim.envs.task import Task
from crazysim.errors import ConfigError, RenderError, expect, require
from crazysim.storage import as_path
from crazysim.train.config import TrainConfig
from crazysim.train.convolution import images_of
from crazysim.train.hosts import is_first_host
from crazysim.train.hyperparameters import SWEEPABLE
from crazysim.train.show import film as film_policy
from crazysim.train.show import plot_curve, plot_episode, plot_spread, read_curve
from crazysim.train.training import (
    CHECKPOINT_FILE,
    CURVE_FILE,
    POLICY_FILE,
    STUDENTS_FILE,
    TABLE_FILE,
    TEACHER_FOLDER,
    TrainResult,
    require_no_run,
    store_configs,
    stored_configs,
    train,
    train_many,
)

RUN_SETTINGS = ("algorithm", "seed", "n_worlds", "options", "config", "network", "devices")
"""Settings of ``TrainConfig.create`` that ``run`` takes."""


def run(
    task: str | Task,
    folder: str | Path | None = None,
    *,
    resume: bool = False,
    film: bool = True,
    evaluation_worlds: int = 1000,
    log: Callable[[str], None] = print,
    progress: bool = True,
    checkpoint_every: float | None = None,
    on_iteration: Callable[[int, dict[str, float]], None] | None = None,
    **settings: Any,
) -> TrainResult:
    """Train a policy, evaluate it, plot the training and an episode, and film it, as ``crazysim train`` does.

    The folder then has ``checkpoint.npz``, ``policy.npz``, ``curve.json``, ``curve.png``, ``episode.png`` and
    ``policy.mp4``. Where matplotlib, the encoder or OpenGL is missing, the plots or the film are left out, and a line
    is logged. An interrupt (Ctrl-C) writes a checkpoint first, and so does a ``SystemExit`` from a signal handler.

    The recipe of a task is the settings that are known to solve it (``crazysim.train.config``). Some recipes have a
    teacher, such as the recipe of ``race_by_camera``. The teacher is trained first, in the folder ``teacher`` of the
    run, unless the settings name another teacher or another algorithm. ``options`` apply to teacher and student;
    ``n_worlds``, ``config`` and ``on_iteration`` apply only to the student. If the teacher is interrupted,
    ``resume=True`` continues it, and then trains the student with the settings of the first call.

    Args:
        task: Name of a task, reference of your class (``FILE.py:NAME`` or ``MODULE:NAME``), or a ``Task`` such as
            ``TwoHoops(radius=0.4)``.
        folder: Folder of the run; None for ``out/NAME``.
        resume: Whether to continue from the checkpoint in the folder; omitted settings come from the checkpoint.
        evaluation_worlds: Number of held-out initial states of each evaluation.
        log: Function that is called with each line of output.
        progress: Whether to show progress bars if tqdm is installed, or lines where stderr is no terminal.
        checkpoint_every: Time after which a checkpoint is written between evaluations as well, s; None for none.
        on_iteration: Function, or None, that is called after each iteration with its number, from 1, and its metrics by
            name. After an evaluation it also gets the metrics of the evaluation, with names that begin with
            ``"evaluation "``. Each call waits for the device.
        settings: ``algorithm``, ``seed``, ``n_worlds``, ``options``, ``config``, ``network`` and ``devices`` of
            ``TrainConfig.create``.

    Raises:
        ConfigError: If the folder holds a run and ``resume`` is False; if the run is damaged, or has other values of
            settings that must not change; if a setting is invalid; if files cannot be written.
        DivergedError: If weights or losses become non-finite; the last checkpoint stays.
        KeyboardInterrupt, SystemExit: After the checkpoint of an interrupted run has been written.
    """
    _check_settings(settings, RUN_SETTINGS)
    options = {
        "evaluation_worlds": evaluation_worlds,
        "log": log,
        "progress": progress,
        "checkpoint_every": checkpoint_every,
    }
    folder, configs, results = _train_variants(
        task, folder, resume, {"": (settings.get("seed"), {})}, settings, options, on_iteration
    )
    config, result = configs[""], results[""]
    if not is_first_host():
        return result
    log(f"wrote {folder / CHECKPOINT_FILE}, {folder / POLICY_FILE}")
    try:
        plot_curve({config.title: read_curve(folder)}, folder / "curve.png", result.env.task.unit)
        plot_episode(result.env, result.policy, folder / "episode.png")
        log(f"wrote {folder / 'curve.png'}, {folder / 'episode.png'}")
    except ImportError as error:
        log(f"no plots: {error}")
    try:
        if film:
            film_policy(config.make_env(4), result.policy, folder / "policy.mp4", progress=progress)
            log(f"wrote {folder / 'policy.mp4'}")
    except (ImportError, RenderError) as error:
        log(f"no film: {error}")
    return result


def run_many(
    task: str | Task,
    folder: str | Path | None = None,
    *,
    seeds: Iterable[int] = (0,),
    sweep: Mapping[str, Sequence[float]] | None = None,
    resume: bool = False,
    evaluation_worlds: int = 1000,
    log: Callable[[str], None] = print,
    progress: bool = True,
    checkpoint_every: float | None = None,
    on_iteration: Callable[[int, dict[str, Any]], None] | None = None,
    **settings: Any,
) -> dict[str, TrainResult]:
    """Train with several seeds and values of hyperparameters in one program, as ``crazysim train --seeds`` does.

    A seed gives the same training, to rounding, whichever other seeds are trained with it. The folder then has one
    ``checkpoint.npz`` of all trainings, ``seeds.csv`` and ``seeds.json`` with a row for each training, and
    ``curve.png`` with medians, quartiles and extremes. Each training has a folder with ``policy.npz`` and
    ``curve.json``, such as ``seed-3`` or ``learning_rate-0.0003-seed-3``. A teacher of the recipe, see ``run``, is
    trained with the first seed and teaches all students.

    Args:
        task: As in ``run``.
        folder: Folder of the run; None for ``out/NAME``.
        sweep: Values of hyperparameters by name, which is one of ``SWEEPABLE``. Every combination of values is trained
            with every seed.
        resume: Whether to continue from the checkpoint in the folder, with the same seeds and values.
        evaluation_worlds: Number of held-out initial states of each evaluation.
        log: Function that is called with each line of output.
        progress: Whether to show a progress bar, if tqdm is installed and stderr is a terminal.
        checkpoint_every: Time after which a checkpoint is written between evaluations as well, s; None for none.
        on_iteration: As in ``run``, but each metric is an array with a number for each training.
        settings: ``algorithm``, ``n_worlds`` of each training, ``options``, ``config``, ``network`` and ``devices`` of
            ``TrainConfig.create``.

    Returns:
        Results by the name of the folder of the training.

    Raises:
        ConfigError, DivergedError, KeyboardInterrupt, SystemExit: As ``run``, but a training that diverges does not
            end the others; ``DivergedError`` is raised if all have diverged.
    """
    _check_settings(settings, tuple(x for x in RUN_SETTINGS if x != "seed"))
    variants = make_variants(seeds, sweep or {}, settings.get("config") or {})
    options = {
        "evaluation_worlds": evaluation_worlds,
        "log": log,
        "progress": progress,
        "checkpoint_every": checkpoint_every,
    }
    folder, configs, results = _train_variants(task, folder, resume, variants, settings, options, on_iteration)
    if not is_first_host():
        return results
    log(
        f"wrote {folder / CHECKPOINT_FILE}, {folder / TABLE_FILE}, and {POLICY_FILE} and {CURVE_FILE} in "
        f"{', '.join(configs)}"
    )
    curves: dict[str, list[Any]] = {}
    for name, config in configs.items():
        curves.setdefault(name.rpartition("seed-")[0].strip("-") or config.title, []).append(read_curve(folder / name))
    try:
        plot_spread(curves, folder / "curve.png", next(iter(results.values())).env.task.unit)
        log(f"wrote {folder / 'curve.png'}")
    except ImportError as error:
        log(f"no plot: {error}")
    return results


MAX_TRAININGS = 10_000
"""Largest number of trainings in one program."""


def make_variants(
    seeds: Iterable[int], sweep: Mapping[str, Sequence[float]], config: Mapping[str, Any]
) -> dict[str, tuple[int, dict[str, float]]]:
    """Return the seed and the changed hyperparameters of each training, by the name of its folder.

    Args:
        sweep: Values of hyperparameters by name.
        config: Hyperparameters of all trainings, which a sweep must not change.
    """
    expect(isinstance(sweep, Mapping), "sweep as a dict of values by name", sweep, "Use {'clip': [0.1, 0.2]}.")
    for name, values in {"seeds": seeds, **sweep}.items():
        expect(
            np.iterable(values) and not isinstance(values, str),
            f"{name} as a list of values",
            values,
            f"Use [{values!r}], for example.",
        )
    # An endless iterable is cut, so that its length is an error.
    values_by_name: dict[str, list[Any]] = {
        name: list(itertools.islice(values, MAX_TRAININGS + 1)) for name, values in {"seeds": seeds, **sweep}.items()
    }
    if (n := math.prod(map(len, values_by_name.values()))) > MAX_TRAININGS:
        raise ConfigError(
            f"expected at most {MAX_TRAININGS} trainings in one program, got {n} or more of seeds and values. Use "
            f"several calls."
        )
    for name, values in values_by_name.items():
        require(
            values and len(set(map(str, values))) == len(values),
            f"expected at least one value of {name}, and each once, got {values or 'none'}. Leave out the others.",
        )
        require(
            name == "seeds" or name in SWEEPABLE,
            f"expected hyperparameters to sweep among {', '.join(SWEEPABLE)}, got {name}, on which shapes or "
            f"counters depend. Train its values one after another, with --config {name}=VALUE and --out.",
        )
        require(name not in config, f"expected {name} to be swept or given, got both. Leave it out of the config.")
    # Every combination of values with every seed.
    names = list(sweep)
    return {
        "-".join([*(f"{name}-{value}" for name, value in zip(names, values, strict=True)), f"seed-{seed}"]): (
            seed,
            dict(zip(names, values, strict=True)),
        )
        for *values, seed in itertools.product(*(values_by_name[name] for name in names), values_by_name["seeds"])
    }


def _train_variants(
    task: str | Task,
    folder: str | Path | None,
    resume: bool,
    variants: Mapping[str, tuple[int | None, Mapping[str, float]]],
    settings: Mapping[str, Any],
    options: Mapping[str, Any],
    on_iteration: Callable[[int, dict[str, Any]], None] | None,
) -> tuple[Path, dict[str, TrainConfig], dict[str, TrainResult]]:
    first_seed, _ = next(iter(variants.values()))
    config = TrainConfig.create(task, **{**settings, "seed": first_seed})
    folder = Path("out") / config.title if folder is None else as_path(folder)
    stored_by_name = stored_configs(folder) if resume else {}
    configs = {}
    for name, (seed, changes) in variants.items():
        own_settings = {**settings, "seed": seed, "config": {**(settings.get("config") or {}), **changes}}
        configs[name] = TrainConfig.create(task, **own_settings, resumed=stored_by_name.get(name))
    if _train_teacher(configs, folder, resume, options):
        resume, teacher = False, str(folder / TEACHER_FOLDER)
        configs = {name: dataclasses.replace(x, config=x.config | {"teacher": teacher}) for name, x in configs.items()}
    return folder, configs, train_many(configs, folder, resume, on_iteration=on_iteration, **options)


def _train_teacher(students: Mapping[str, TrainConfig], folder: Path, resume: bool, options: Mapping[str, Any]) -> bool:
    student = next(iter(students.values()))
    teacher = student.teacher_config()
    if teacher is None or (resume and (folder / CHECKPOINT_FILE).exists()):
        if not resume:
            (folder / STUDENTS_FILE).unlink(missing_ok=True)  # of a run whose teacher was interrupted
        return False
    teacher_folder = folder / TEACHER_FOLDER
    if not resume:
        require_no_run(folder)
        require_no_run(teacher_folder)
        _check_student(student)
    store_configs(students, folder, resume)
    options["log"](f"first the teacher of {student.title}, then the student by {student.algorithm}")
    train(teacher, teacher_folder, resume and (teacher_folder / CHECKPOINT_FILE).exists(), **options)
    return True


def _check_student(student: TrainConfig) -> None:
    env = student.make_training_env()
    if student.config["convolution"]:
        images_of(env, jax.eval_shape(env.reset, jax.random.key(0)).obs)


def _check_settings(settings: Mapping[str, Any], names: Sequence[str]) -> None:
    if unknown := settings.keys() - set(names):
        raise ConfigError(
            f"expected settings among {', '.join(names)}, got {', '.join(sorted(unknown))}. Hyperparameters belong "
            f"in config={{...}}, such as config={{'iterations': 100}}."
        )
