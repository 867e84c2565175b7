"""Training results: several seeds per task, evaluated on held-out initial states, with wall time.

    python benchmarks/train.py [--device gpu] [--tasks hover recover track race] [--seeds 0 1 2 3 4] [--out out/train]
                               [--parallel 1]

Each training runs in its own process, like ``crazysim train``, so its time includes imports, building, compilation and
evaluation. One JSON line each, and one with the success of all seeds of a task and its quantiles; ``--plot FILE`` plots
all learning curves. ``--parallel 12`` runs twelve trainings at a time, which changes their times alone.
"""

from __future__ import annotations

import argparse
import itertools
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from measure import digits, report

from crazysim.train.show import read_curve
from crazysim.train.training import kept_point


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--tasks", nargs="+", default=["hover", "recover", "track", "race"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--out", type=Path, default=Path("out/train"), help="folder of the runs")
    parser.add_argument("--parallel", type=int, default=1, help="trainings that run at a time")
    parser.add_argument("--plot", type=Path, help="image of the learning curves")
    parser.add_argument("--only-plot", action="store_true", help="plot and summarise existing runs without training")
    args = parser.parse_args()
    folders = {key: folder_of(args.out, *key, args.device) for key in itertools.product(args.tasks, args.seeds)}
    if not args.only_plot:
        with ThreadPoolExecutor(args.parallel) as pool:
            for run in [pool.submit(train, *key, folder, args.device) for key, folder in folders.items()]:
                run.result()
    curves = {task: [read_curve(folders[task, seed]) for seed in args.seeds] for task in args.tasks}
    for task in args.tasks:
        summary(task, curves[task], args.device, args.parallel)
    if args.plot is not None:
        plot(curves, args.plot)


def folder_of(out: Path, task: str, seed: int, device: str) -> Path:
    """Return the folder of a run, which is in ``out`` whatever the place of the task, such as ``../task.py:NAME``."""
    return out / f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', task)}-{device}-{seed}"


def plot(curves: dict[str, list[Any]], path: Path) -> None:
    """Plot success over time, with a panel for each task and a line for each seed."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(curves), figsize=(3.2 * len(curves), 2.8), sharey=True, layout="constrained")
    for axis, (task, seeds) in zip(np.atleast_1d(axes), curves.items(), strict=True):
        for curve in seeds:
            axis.plot([p["seconds"] for p in curve], [100 * p["success"] for p in curve], marker=".")
        axis.set(title=task, xlabel="time with compilation, s", ylim=(-3, 103))
        axis.grid(alpha=0.3)
    np.atleast_1d(axes)[0].set_ylabel("held-out starts that succeed, %")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def train(task: str, seed: int, folder: Path, device: str) -> None:
    """Train in a new process and print the results."""
    command = [sys.executable, "-m", "crazysim", "train", task, "--seed", str(seed), "--out", str(folder), "--no-film"]
    begin = time.perf_counter()
    done = subprocess.run([*command, "--device", device], capture_output=True, text=True)
    wall_s = time.perf_counter() - begin
    if done.returncode:
        raise SystemExit(f"training {task} failed: {done.stderr[-2000:]}")
    curve = read_curve(folder)
    point, last = kept_point(curve), curve[-1]
    solved = next((p["seconds"] for p in curve if p["success"] >= 0.95), None)
    report(
        device,
        benchmark="train",
        task=task,
        seed=seed,
        success=round(point["success"], 4),
        crashed=round(point["crashed"], 4),
        error=digits(point["error"]) if point["error"] == point["error"] else None,
        kept_iteration=point["iteration"],
        env_steps=last["env_steps"],
        seconds=digits(last["seconds"]),
        compile_seconds=digits(last["compile_seconds"]),
        seconds_to_95_percent=None if solved is None else digits(solved),
        wall_s=digits(wall_s),
    )


def summary(task: str, curves: list[Any], device: str, parallel: int) -> None:
    """Print the success of all seeds of a task, sorted, with quantiles, and medians of error and time."""
    points = [kept_point(curve) for curve in curves]
    success = sorted(round(point["success"], 4) for point in points)
    shares = (0, 0.1, 0.25, 0.5, 1)
    error = np.nanquantile([point["error"] for point in points], shares)
    report(
        device,
        benchmark="train_seeds",
        task=task,
        parallel=parallel,
        success=success,
        quantiles=shares,
        success_quantiles=np.quantile(success, shares).round(4).tolist(),
        error_quantiles=[digits(float(x)) for x in error],
        seconds=digits(float(np.median([curve[-1]["seconds"] for curve in curves]))),
        env_steps=curves[0][-1]["env_steps"],
    )


if __name__ == "__main__":
    main()
