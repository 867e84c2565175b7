"""Training results: several seeds per task, evaluated on 1,000 held-out initial states, and the table of the page.

    python benchmarks/train.py [--tasks hover track] [--seeds 0:5] [--device gpu] [--parallel 3] [--plot FILE]
    python benchmarks/train.py --all --seeds 0:20 --device gpu --parallel 3 --write
    python benchmarks/train.py --check --device gpu --parallel 3
    python benchmarks/train.py --tasks hover -- --worlds 2048 --config learning_rate=1e-3

All seeds of a task are trained by one process, ``crazysim train TASK --seeds ...``. Its time includes imports,
building, compilation and evaluation for all seeds. ``--together`` limits the number of seeds of a process. If the
recipe of a task has a teacher, each seed has its own process and its own teacher, whose steps and time are included.
When a process ends, a JSON line for each of its seeds is printed. At the end there is a line for each task, with
medians over its seeds. A seed that diverges has a success of 0, and the line of its task names it.

Finished seeds are stored in the file ``results.jsonl`` of the folder ``--out``. They are not trained again while the
sources of the package are the same. An interrupted command therefore continues where it was, also on another machine
that has this file. A process that was interrupted continues from its last checkpoint if its folder still exists. A
failed training is reported at the end, and the other trainings continue.

``--write`` puts the rows of tasks with all seeds finished into the committed table,
docs/results/training.json, and into the page docs/results.md. ``--check`` trains one seed of each task. It fails if
the success of a seed is lower than the least success in the table by more than two standard errors of 1,000 starts.
Arguments after ``--`` are passed to ``crazysim train``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import figures
import numpy as np
from measure import describe_machine, round_digits, run_in_process

import crazysim
from crazysim.commands.training import parse_seeds
from crazysim.envs.registry import TASKS, entry_of
from crazysim.train.config import ALGORITHMS, RECIPES, WORLDS, Recipe
from crazysim.train.show import read_curve
from crazysim.train.training import (
    CHECKPOINT_FILE,
    STUDENTS_FILE,
    TEACHER_FOLDER,
    kept_point,
    least_kept_success,
    stored_configs,
)
from crazysim.train.training import TABLE_FILE as SEEDS_TABLE_FILE

PACKAGE = Path(crazysim.__file__).parent
TABLE = Path(__file__).parents[1] / "docs" / "results" / "training.json"
"""The committed table, a row for each task."""
N_STARTS = 1000
"""Held-out starts of an evaluation of ``crazysim train``."""
PRINTED_ENTRIES = ("task", "seed", "success", "diverged", "crashed", "error", "seconds")
"""Entries of a result that are printed."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--tasks", nargs="+", help="tasks; by default hover, recover, track and race, or all to check")
    parser.add_argument("--all", action="store_true", help="train all built-in tasks")
    parser.add_argument("--seeds", type=parse_seeds, help="such as 0:20 or 3,5; by default 0:5, or 0 to check")
    parser.add_argument("--out", type=Path, default=Path("out/train"), help="folder of the runs")
    parser.add_argument("--parallel", type=int, default=1, help="processes that run at a time")
    parser.add_argument("--together", type=int, default=20, help="largest number of seeds of a process")
    parser.add_argument("--plot", type=Path, help="image of the learning curves")
    parser.add_argument("--only-plot", action="store_true", help="plot, summarise and write finished runs; train none")
    parser.add_argument("--keep", action="store_true", help="use finished runs of other versions of the package too")
    parser.add_argument(
        "--commit", default=source_commit(), help="name of the sources in the table; by default %(default)s"
    )
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--write", action="store_true", help="write the committed table and the page")
    mode.add_argument("--check", action="store_true", help="compare with the committed table")
    split_index = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    args, arguments = parser.parse_args(sys.argv[1:split_index]), sys.argv[split_index + 1 :]
    if arguments and (args.write or args.check):
        parser.error("expected no arguments of the training with --write or --check: the table is of the recipes")
    tasks = args.tasks or (list(TASKS) if args.all or args.check else ["hover", "recover", "track", "race"])
    seeds = args.seeds or ([0] if args.check else [0, 1, 2, 3, 4])

    results_file, digest = args.out / "results.jsonl", source_hash()
    keys = [(task, seed, args.device, *arguments) for seed in seeds for task in tasks]
    results = {
        key: x for key, x in read_results(results_file).items() if key in keys and (args.keep or x["sources"] == digest)
    }
    failures = []
    if not args.only_plot:
        missing_keys = [key for key in keys if key not in results]
        print(json.dumps({"finished": len(results), "to_train": len(missing_keys)}), flush=True)
        groups = group_runs(missing_keys, args.together)
        run_info = {"sources": digest, "commit": args.commit, "parallel": min(args.parallel, max(len(groups), 1))}
        if missing_keys:
            # In a separate process, because this process would keep memory of the device.
            run_info |= run_in_process(describe_machine, args.device)
            cores = f"{run_info['cores']} cores of {run_info['processor']}"
            run_info["machine"] = cores if run_info["device"] == "cpu" else run_info["device"]
        failures = train_all(groups, args.out, results_file, run_info, results)

    finished = {task: [results[key] for key in keys if key[0] == task and key in results] for task in tasks}
    rows = [make_row(runs) for runs in finished.values() if runs]
    for row in rows:
        print(json.dumps(row), flush=True)
    if args.plot is not None:
        plot({task: runs for task, runs in finished.items() if runs}, args.plot)
    if args.write:
        write_table([row for row in rows if len(row["seeds"]) == len(seeds)])
    if args.check:
        failures += check_success([run for runs in finished.values() for run in runs])
    if failures:
        raise SystemExit("\n".join(failures))


def source_hash() -> str:
    """Return a hash of the sources of the package, to recognise finished runs of the same sources."""
    digest = hashlib.sha256()
    for path in sorted(path for path in PACKAGE.rglob("*") if path.suffix in (".py", ".toml", ".xml")):
        digest.update(str(path.relative_to(PACKAGE)).encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def source_commit() -> str:
    """Return the commit of the sources, followed by ``+`` if the package differs from it; without Git, the version."""
    git = ["git", "-C", str(PACKAGE)]
    process = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True)
    if process.returncode:
        return crazysim.__version__
    changed = subprocess.run([*git, "status", "--porcelain", "--", "."], capture_output=True, text=True).stdout
    return process.stdout.strip() + "+" * bool(changed)


def read_results(results_file: Path) -> dict[tuple[Any, ...], dict[str, Any]]:
    """Return the last result in a file for each task, seed, device and arguments."""
    results = [json.loads(line) for line in results_file.read_text().splitlines()] if results_file.exists() else []
    return {(x["task"], x["seed"], x["on"], *x["arguments"]): x for x in results}


def group_runs(keys: list[tuple[Any, ...]], max_size: int) -> list[list[tuple[Any, ...]]]:
    """Return the runs to train in groups of at most ``max_size`` that differ only in the seed, the longest first.

    Each run of a recipe with a teacher is a separate group, because all seeds of a process have the same teacher.
    """
    groups: dict[tuple[Any, ...], list[tuple[Any, ...]]] = {}
    for key in keys:
        groups.setdefault((key[0], *key[2:]), []).append(key)
    subgroups = []
    for (task, *_), group in groups.items():
        size = 1 if RECIPES.get(task, Recipe()).teacher else max_size
        subgroups += [group[i : i + size] for i in range(0, len(group), size)]

    def n_samples(subgroup: list[tuple[Any, ...]]) -> int:
        recipe = RECIPES.get(subgroup[0][0], Recipe())
        config = ALGORITHMS[recipe.algorithm].Config(**recipe.config)
        return len(subgroup) * (recipe.n_worlds or WORLDS["gpu"]) * config.iterations * config.n_steps

    return sorted(subgroups, key=n_samples, reverse=True)


def train_all(
    groups: list[list[tuple[Any, ...]]],
    out: Path,
    results_file: Path,
    run_info: dict[str, Any],
    results: dict[Any, dict[str, Any]],
) -> list[str]:
    """Train each group, add the results of successful trainings to ``results`` and its file, and return failures."""
    failures = []
    out.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(run_info["parallel"]) as pool:
        group_by_future = {pool.submit(train, group, out, run_info): group for group in groups}
        try:
            for future in as_completed(group_by_future):
                group = group_by_future[future]
                task, _, device, *arguments = group[0]
                seeds = [key[1] for key in group]
                try:
                    new_results = future.result()
                except RuntimeError as error:
                    failures.append(f"{task}: training with seeds {', '.join(map(str, seeds))} failed")
                    print(json.dumps({"task": task, "seeds": seeds, "failed": str(error)}), flush=True)
                    continue
                for key, result in zip(group, new_results, strict=True):
                    results[key] = (
                        {"task": task, "seed": key[1], "on": device, "arguments": arguments} | result | run_info
                    )
                    with results_file.open("a") as file:
                        file.write(json.dumps(results[key]) + "\n")
                    print(json.dumps({name: results[key][name] for name in PRINTED_ENTRIES}), flush=True)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return failures


def run_folder(out: Path, task: str, seeds: str, device: str, *arguments: str) -> Path:
    """Return the folder of a run, which is in ``out`` even if the task is elsewhere, such as ``../task.py:NAME``."""
    return out / re.sub(r"[^A-Za-z0-9_.-]+", "_", "-".join([task, device, seeds, *arguments]))


def train(group: list[tuple[Any, ...]], out: Path, run_info: dict[str, Any]) -> list[dict[str, Any]]:
    """Train some seeds of a task in a new process, and return the result of each seed.

    Args:
        group: Task, seed, device and further arguments of ``crazysim train`` for each run; only the seeds differ.
        out: Folder of the runs.
        run_info: Entries of all results, among them the hash of the sources (``sources``) and the number of processes
            that run at the same time (``parallel``).

    Raises:
        RuntimeError: If the training fails, with the end of its output.
    """
    task, _, device, *arguments = group[0]
    seeds = ",".join(str(key[1]) for key in group)
    folder = run_folder(out, task, seeds, device, *arguments)
    sources_file = folder / "sources.txt"
    has_same_sources = sources_file.exists() and sources_file.read_text() == run_info["sources"]
    if not has_same_sources:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        sources_file.write_text(run_info["sources"])
    command = [sys.executable, "-P", "-m", "crazysim", "train", task, "--seeds", seeds, "--out", str(folder)]
    if any((folder / name).exists() for name in (CHECKPOINT_FILE, STUDENTS_FILE)):  # the training was interrupted
        command.append("--resume")
    # By default each process would take three quarters of the memory of a GPU.
    environment = ({"XLA_PYTHON_CLIENT_PREALLOCATE": "false"} if run_info["parallel"] > 1 else {}) | os.environ
    # The same package as here, whatever the folder in which this runs.
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(PACKAGE.parent), os.environ.get("PYTHONPATH")]))
    log, start_time = folder.with_name(f"{folder.name}.log"), time.perf_counter()
    with log.open("w") as file:
        process = subprocess.run(
            [*command, "--no-film", "--device", device, *arguments],
            stdout=file,
            stderr=subprocess.STDOUT,
            env=environment,
        )
    wall_s = time.perf_counter() - start_time
    if process.returncode:
        last_line = (log.read_text().strip().splitlines() or ["no output"])[-1]
        raise RuntimeError(f"status {process.returncode}, {last_line} (see {log})")
    algorithm = next(iter(stored_configs(folder).values())).algorithm
    diverged = {row["seed"]: row["diverged"] for row in json.loads((folder / SEEDS_TABLE_FILE).read_text())}
    results = [read_result(folder / f"seed-{key[1]}", diverged[key[1]]) for key in group]
    common = {"algorithm": algorithm, "wall_s": round_digits(wall_s), "together": len(group)}
    return [result | common for result in results]


def read_result(folder: Path, diverged: int | None) -> dict[str, Any]:
    """Return the results of one seed from its learning curve.

    Seconds are those of the process, which trains all of its seeds together. Steps and seconds include those of a
    teacher that was trained first. ``kept_iteration`` is the iteration of the policy that was kept.

    Args:
        folder: Folder of the seed.
        diverged: Iteration in which a number became NaN or infinite, so that the success is 0; None if all numbers
            stayed finite.
    """
    curve, teacher_folder = read_curve(folder), folder.parent / TEACHER_FOLDER
    if teacher_folder.exists():
        teacher = read_curve(teacher_folder)[-1]
        curve = [p | {name: p[name] + teacher[name] for name in ("env_steps", "seconds")} for p in curve]
    point, last_point = kept_point(curve), curve[-1]
    seconds_to_95_percent = next((p["seconds"] for p in curve if p["success"] >= 0.95), None)
    return {
        "success": round(point["success"], 4) if diverged is None else 0.0,
        "diverged": diverged,
        "crashed": round(point["crashed"], 4),
        "error": round_digits(point["error"]) if point["error"] == point["error"] else None,
        "kept_iteration": point["iteration"],
        "env_steps": last_point["env_steps"],
        "seconds": round_digits(last_point["seconds"]),
        "compile_seconds": round_digits(last_point["compile_seconds"]),
        "seconds_to_95_percent": None if seconds_to_95_percent is None else round_digits(seconds_to_95_percent),
        "curve": [[round_digits(p["seconds"]), round(p["success"], 4)] for p in curve],
    }


def make_row(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the row of a task: least, 10% quantile and median of the success over its seeds, median error and time."""
    success = [run["success"] for run in runs]
    errors = [run["error"] for run in runs if run["error"] is not None]
    row: dict[str, Any] = {name: runs[-1][name] for name in ("task", "algorithm")}
    diverged = sorted(run["seed"] for run in runs if run.get("diverged") is not None)
    row |= {"env_steps": max(run["env_steps"] for run in runs)} | ({"diverged": diverged} if diverged else {})
    row |= {
        "seeds": sorted(run["seed"] for run in runs),
        "least": min(success),
        "tenth": round(float(np.quantile(success, 0.1)), 4),
        "median": round(statistics.median(success), 4),
        "error": round_digits(statistics.median(errors)) if errors else None,
        "unit": entry_of(runs[0]["task"]).task.unit,
        "seconds": round_digits(statistics.median(run["seconds"] for run in runs)),
    }
    row |= {name: max(run.get(name, 1) for run in runs) for name in ("parallel", "together")}
    return row | {name: ", ".join(sorted({run[name] for run in runs})) for name in ("commit", "date", "machine", "jax")}


def write_table(rows: list[dict[str, Any]]) -> None:
    """Put rows into the committed table, and the table into the page."""
    rows_by_task = {row["task"]: row for row in [*json.loads(TABLE.read_text()), *rows]}
    rows = [rows_by_task[task] for task in [*TASKS, *sorted(rows_by_task.keys() - TASKS)] if task in rows_by_task]
    TABLE.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")
    figures.write_pages()


def check_success(runs: list[dict[str, Any]]) -> list[str]:
    """Return a message for each run whose success is below the least in the table by more than two standard errors."""
    least_success = {row["task"]: row["least"] for row in json.loads(TABLE.read_text())}
    failures = []
    for run in runs:
        task, success = run["task"], run["success"]
        if task not in least_success:
            failures.append(f"{task} has no row in {TABLE.name} to compare with. Add it with --tasks {task} --write.")
        elif success < least_kept_success(least_success[task], N_STARTS):
            failures.append(
                f"{task}: expected at least {least_success[task]:.1%} as in {TABLE.name}, got {success:.1%} with seed "
                f"{run['seed']}, lower by more than two standard errors of {N_STARTS:,} starts."
            )
    return failures


def plot(runs: dict[str, list[dict[str, Any]]], path: Path) -> None:
    """Plot success over time, with a panel for each task and a line for each seed."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(runs), figsize=(3.2 * len(runs), 2.8), sharey=True, layout="constrained")
    for axis, (task, seeds) in zip(np.atleast_1d(axes), runs.items(), strict=True):
        for run in seeds:
            seconds, success = np.array(run["curve"]).T
            axis.plot(seconds, 100 * success, marker=".")
        axis.set(title=task, xlabel="time with compilation, s", ylim=(-3, 103))
        axis.grid(alpha=0.3)
    np.atleast_1d(axes)[0].set_ylabel("held-out starts that succeed, %")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


if __name__ == "__main__":
    main()
