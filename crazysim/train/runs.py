"""Training runs: training, evaluation, plots and a film, in one folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from crazysim.envs.task import Task
from crazysim.errors import ConfigError, RenderError
from crazysim.train.config import TrainConfig
from crazysim.train.show import film as film_policy
from crazysim.train.show import plot_curve, plot_episode, read_curve
from crazysim.train.training import CHECKPOINT, POLICY, TrainResult, stored_config, train

SETTINGS = ("algorithm", "seed", "n_worlds", "options", "config")
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

    Args:
        task: Name of a task, the reference of a class of your own, ``FILE.py:NAME`` or ``MODULE:NAME``, or a task, such
            as ``TwoHoops(radius=0.4)``.
        folder: Folder of the run; None for ``out/NAME``.
        resume: True to continue from the checkpoint in the folder, with its settings where none are given.
        film: True to write a film.
        evaluation_worlds: Number of held-out initial states of each evaluation.
        log: Function that is called with each line of output.
        progress: True to show progress bars, if tqdm is installed and stderr is a terminal.
        checkpoint_every: Time after which a checkpoint is written between evaluations as well, s; None for none.
        on_iteration: Function that is called after each iteration with its number, from 1, and its metrics by name;
            names of metrics of an evaluation after it begin with ``"evaluation "``. Each call waits for the device.
            None for none.
        settings: ``algorithm``, ``seed``, ``n_worlds``, ``options`` and ``config`` of ``TrainConfig.create``.

    Raises:
        ConfigError: If the folder holds a run and ``resume`` is False, or the run has other settings than those that
            may change or is damaged; if a setting is invalid; if files cannot be written.
        DivergedError: If weights or losses become non-finite; the last checkpoint stays.
        KeyboardInterrupt, SystemExit: After the checkpoint of an interrupted run has been written.
    """
    if unknown := settings.keys() - SETTINGS:
        raise ConfigError(
            f"expected settings among {', '.join(SETTINGS)}, got {', '.join(sorted(unknown))}. Hyperparameters belong "
            f"in config={{...}}, such as config={{'iterations': 100}}."
        )
    config = TrainConfig.create(task, **settings)
    folder = Path("out") / config.title if folder is None else Path(folder)
    if resume:
        config = TrainConfig.create(task, **settings, resumed=stored_config(folder))
    result = train(config, folder, resume, evaluation_worlds, log, progress, checkpoint_every, on_iteration)
    log(f"wrote {folder / CHECKPOINT}, {folder / POLICY}")
    try:
        plot_curve({config.title: read_curve(folder)}, folder / "curve.png")
        plot_episode(result.env, result.policy, folder / "episode.png")
        log(f"wrote {folder / 'curve.png'}, {folder / 'episode.png'}")
        if film:
            film_policy(config.make_env(4), result.policy, folder / "policy.mp4", progress=progress)
            log(f"wrote {folder / 'policy.mp4'}")
    except (ImportError, RenderError) as error:
        log(f"no curve or film: {error}")
    return result
