"""``crazysim train``, ``evaluate``, ``export`` and ``render``: policies.

A recipe is the settings that are known to solve a task (``crazysim.train.config``).
"""

from __future__ import annotations

import argparse
import signal
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from crazysim.commands import hosts
from crazysim.commands.options import (
    DefaultsFormatter,
    load_policy_and_env,
    number,
    parse_pairs,
    seed,
    size,
    specified_options,
)
from crazysim.errors import ConfigError, require
from crazysim.storage import PICTURE_SUFFIXES, check_writable

DISTILLATION_WORLDS = 256
"""Number of worlds in which a policy is distilled for ``--tflite``."""


def add_parsers(commands: argparse._SubParsersAction) -> None:
    text = "train a policy; write checkpoint, learning curve, policy and film"
    parser = commands.add_parser("train", help=text, formatter_class=DefaultsFormatter)
    parser.set_defaults(run=train)
    add = parser.add_argument
    task_help = "name of a task, such as hover, or FILE.py:CLASS for your task; list prints all names"
    add("task", help=task_help)
    add("--algorithm", help="ppo, apg or dagger; by default that of the task's recipe, or dagger with --teacher")
    teacher_help = (
        "folder of a run whose policy is the teacher (DAgger); the new policy gets the observations of the task. By "
        "default the recipe's teacher, if it has one, which is trained first"
    )
    add("--teacher", metavar="FOLDER", help=teacher_help)
    start_help = "folder of a run from whose policy ppo or apg starts; it must have the same network"
    add("--start", metavar="FOLDER", help=start_help)
    add("--seed", type=seed, help="random seed; by default 0")
    seeds_help = "several seeds in one program: 0:8 for 0 to 7, or 0,3,5; a folder for each in the folder of the run"
    add("--seeds", type=parse_seeds, metavar="FIRST:END", help=seeds_help)
    sweep_help = "values of hyperparameters, each trained with each seed in one program"
    add("--sweep", nargs="+", default=[], metavar="NAME=VALUE,VALUE", help=sweep_help)
    worlds_help = "number of parallel worlds of a training, but not of a recipe's teacher; by default the recipe's"
    add("--worlds", type=number(example=1024), help=worlds_help)
    iterations_help = (
        "number of rollouts, each with its updates, but not of a recipe's teacher; by default the recipe's"
    )
    add("--iterations", type=number(), help=iterations_help)
    add("--out", type=Path, help="folder of the run; by default out/TASK")
    resume_help = "continue from the checkpoint in that folder; settings that you leave out are the checkpoint's"
    add("--resume", action="store_true", help=resume_help)
    checkpoint_every_help = "write a checkpoint every so many seconds, in addition to the one at each evaluation"
    add("--checkpoint-every", type=size(60), metavar="SECONDS", help=checkpoint_every_help)
    add("--device", help="device: cpu, gpu; by default cpu, or JAX's default platform with --devices")
    devices_help = "devices to distribute the worlds over: all, their number, or their indices such as 0,2,3"
    add("--devices", metavar="all|N|I,J", help=devices_help)
    hosts.add_options(add)
    add(
        "--set",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=VALUE",
        help="options of the task and the simulation",
    )
    config_help = "hyperparameters of the algorithm, but not of a recipe's teacher"
    add("--config", nargs="+", action="extend", default=[], metavar="NAME=VALUE", help=config_help)
    add("--no-film", action="store_true", help="write no film")
    check_help = "fly the task without training and for ten iterations, say what is wrong with it, and write nothing"
    add("--check", action="store_true", help=check_help)
    tune_help = (
        "first search hyperparameters, or --tune rewards also factors of the terms of the reward, and train with the "
        "best; print them, and write them as tune.json"
    )
    add("--tune", nargs="?", const="hyperparameters", choices=("hyperparameters", "rewards"), help=tune_help)
    tune_seconds_help = "time for the search, s; by default 60 on a GPU, 300 on a CPU"
    add("--tune-seconds", type=size(60), metavar="SECONDS", help=tune_seconds_help)

    add = _add_policy_command(commands, "evaluate", "evaluate a trained policy on held-out initial states", evaluate)
    add("--worlds", type=number(), default=1000, help="number of initial states")
    add("--seed", type=seed, help="seed of other initial states than the held-out ones")
    add("--plot", type=Path, metavar="FILE", help="plot of the terms of the reward to write, .png")
    _add_task_and_device(add)

    text = "write a trained policy for flight controllers, or as ONNX or C"
    add = _add_policy_command(commands, "export", text, export)
    add("--onnx", type=Path, metavar="FILE", help="ONNX file to write")
    add("--c", type=Path, metavar="FILE", help="C header to write; it includes only math.h")
    out_of_tree_help = "existing folder for an out of tree controller of the Crazyflie's firmware"
    add("--out-of-tree", type=Path, metavar="FOLDER", help=out_of_tree_help)
    add(
        "--betaflight", type=Path, metavar="FOLDER", help="existing folder for a header to call from Betaflight's mixer"
    )
    add("--rl-tools", type=Path, metavar="FILE", help="policy.tar of PX4's mc_raptor to write, of RAPTOR's shape")
    tflite_help = (
        "control_net.tflite of PX4's mc_nn_control to write, distilled from a policy that commands rotor speeds"
    )
    add("--tflite", type=Path, metavar="FILE", help=tflite_help)
    drone_help = "airframe that flies a policy of RAPTOR's shape; by default cf21B_500"
    add("--drone", "--airframe", metavar="NAME|FILE", help=drone_help)

    add = _add_policy_command(commands, "render", "film a trained policy", render)
    add("--film", type=Path, metavar="FILE", help=".mp4 or .gif; by default policy.mp4 in the folder, or TASK.mp4")
    add("--worlds", type=number(), default=4, help="number of worlds side by side")
    add("--seed", type=seed, default=1, help="seed of the initial states")
    _add_task_and_device(add)


def _add_policy_command(commands: argparse._SubParsersAction, name: str, text: str, run: Any) -> Any:
    folder_help = (
        "folder of the run; or any, the package's policy, or a checkpoint of rl-tools (.tar) of its shape; or, with "
        "--policies, a task, such as head_to_head"
    )
    parser = commands.add_parser(name, help=text, formatter_class=DefaultsFormatter)
    parser.set_defaults(run=run)
    parser.add_argument("folder", type=Path, help=folder_help)
    return parser.add_argument


def _add_task_and_device(add: Any) -> None:
    task_help = "FILE.py:CLASS of your task, if it has moved since training"
    add("--task", metavar="FILE.py:CLASS", help=task_help)
    drone_help = "airframe that a policy for any flies; by default another one in every world"
    add("--drone", "--airframe", metavar="NAME|FILE", help=drone_help)
    add("--device", help="device: cpu, gpu; by default the training's")
    set_help = "options of the task and the simulation that differ from the training's"
    add("--set", nargs="+", action="extend", default=[], metavar="NAME=VALUE", help=set_help)
    policies_help = "folders of runs whose policies fly the drones of a world together; the last one flies the rest"
    add("--policies", nargs="+", type=Path, default=[], metavar="FOLDER", help=policies_help)


def parse_seeds(text: str) -> Sequence[int]:
    """Return the seeds of ``FIRST:END``, from FIRST to END - 1, or of a list with commas."""
    seeds: Sequence[int]
    start, colon, stop = text.partition(":")
    try:
        seeds = range(int(start), int(stop)) if colon else [int(x) for x in text.split(",")]
    except ValueError:
        seeds = []
    require(
        seeds and (colon or len(set(seeds)) == len(seeds)),
        f"expected FIRST:END with FIRST below END, or seeds with commas, each once, got {text!r}. Use for example "
        f"0:8, for the seeds 0 to 7.",
        argparse.ArgumentTypeError,
    )
    return seeds


def _parse_sweep(texts: Sequence[str]) -> dict[str, list[float]]:
    sweep: dict[str, list[float]] = {}
    for text in texts:
        name, _, values = text.partition("=")
        try:
            sweep[name] = [*sweep.get(name, ()), *map(float, values.split(","))]
        except ValueError:
            raise ConfigError(
                f"expected NAME=VALUE,VALUE with numbers to sweep, got {text!r}. Use for example "
                f"learning_rate=1e-4,3e-4."
            ) from None
    return sweep


def train(options: argparse.Namespace) -> int | None:
    """Train a policy, on this host or on several, or print the names of all tasks."""
    from crazysim.envs.registry import TASKS

    if options.task == "list":
        for name, entry in TASKS.items():
            text = (entry.task.__doc__ or "").splitlines()[0].replace("``", "")
            n_drones = f" {n} drones by default." if (n := entry.defaults["n_drones"]) > 1 else ""
            print(f"{name:{max(map(len, TASKS))}} {text}{n_drones}")
        return None
    if hosts.has_several_hosts(options):
        return hosts.run_on_hosts(partial(_train, devices="all"), options)
    old_handler = signal.signal(signal.SIGTERM, _exit)
    try:
        return _train(options)
    finally:
        signal.signal(signal.SIGTERM, old_handler)


def _train(options: argparse.Namespace, devices: str | None = None) -> int | None:
    from crazysim.train.runs import run, run_many

    settings: dict[str, Any] = {
        "resume": options.resume,
        "checkpoint_every": options.checkpoint_every,
        "algorithm": options.algorithm or (options.teacher and "dagger"),
        "n_worlds": options.worlds,
        "devices": options.devices or devices,
        "options": parse_pairs(options.set) | specified_options(options, "device"),
        "config": parse_pairs(options.config) | specified_options(options, "iterations", "teacher", "start"),
    }
    if options.check:
        from crazysim.train.check import check_task

        others = [f"--{name}" for name in ("resume", "seeds", "sweep", "tune") if getattr(options, name)]
        require(not others, f"expected --check alone, got it with {' and '.join(others)}. Leave them out at first.")
        kept = {name: settings[name] for name in ("algorithm", "n_worlds", "devices", "options", "config")}
        return int(bool(check_task(options.task, seed=options.seed, **kept)))
    require(options.tune or not options.tune_seconds, "expected --tune-seconds with --tune, got it alone. Add --tune.")
    if options.tune:
        settings["config"] |= _tune(options, settings)
    if options.seeds is None and not options.sweep:
        run(options.task, options.out, film=not options.no_film, seed=options.seed, **settings)
        return None
    require(options.seeds is None or options.seed is None, "expected --seed or --seeds, got both. Use --seeds alone.")
    run_many(
        options.task,
        options.out,
        seeds=options.seeds or [options.seed or 0],
        sweep=_parse_sweep(options.sweep),
        **settings,
    )
    return None


def _tune(options: argparse.Namespace, settings: dict[str, Any]) -> dict[str, Any]:
    from crazysim.train.config import TrainConfig
    from crazysim.train.search import tune
    from crazysim.train.training import require_no_run

    require(not options.resume, "expected --tune or --resume, got both. A resumed run keeps its hyperparameters.")
    config = TrainConfig.create(options.task, **{name: settings[name] for name in ("algorithm", "options", "config")})
    require(config.algorithm == "ppo", f"expected --tune with PPO, got {config.algorithm}. Use --algorithm ppo.")
    folder = options.out or Path("out") / config.title
    require_no_run(folder)
    return tune(
        options.task,
        folder,
        search=options.tune,
        seconds=options.tune_seconds,
        options=settings["options"],
        config=settings["config"],
    )


def _exit(*_: object) -> NoReturn:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second signal would interrupt the writing
    raise SystemExit(128 + signal.SIGTERM)


def _load(options: argparse.Namespace) -> tuple[Any, ...]:
    names = ("folder", "device", "worlds", "task", "drone", "policies")
    return load_policy_and_env(*[getattr(options, name) for name in names], settings=parse_pairs(options.set))


def evaluate(options: argparse.Namespace) -> None:
    """Evaluate a policy, and print and plot the results."""
    import jax

    from crazysim.train.evaluation import describe_flight, evaluate, evaluate_each
    from crazysim.train.show import plot_episode

    if options.plot is not None:
        check_writable(options.plot, PICTURE_SUFFIXES)
    policy, config, env = _load(options)
    key = None if options.seed is None else jax.random.key(options.seed)
    # Several policies fly the settings that their runs share.
    settings = [f"{k}={x}" for k, x in config.options.items() if k != "device"] if options.policies else options.set
    title = ", ".join([config.title, *settings, f"{options.worlds:,} starts ({env.task.criterion})"])
    if options.policies:
        for folder, metrics in zip(options.policies, evaluate_each(env, policy, key), strict=True):
            reward = metrics.pop("reward")
            rates = ", ".join(f"{name} {x:.1%}" for name, x in metrics.items())
            print(f"{title}, {folder}: {rates}, mean return {reward:.4g}")
    else:
        print(f"{title}: {describe_flight(evaluate(env, policy, key), env.task.unit)}")
    if options.plot is not None:
        plot_episode(env, policy, options.plot, key)
        print(f"wrote {options.plot}")


def export(options: argparse.Namespace) -> None:
    from crazysim.drones import load_airframe
    from crazysim.train import export as exports
    from crazysim.train.evaluation import describe_flight, evaluate
    from crazysim.train.training import load_policy

    files = {".onnx": options.onnx, ".h": options.c, ".tar": options.rl_tools, ".tflite": options.tflite}
    folders = ((options.out_of_tree, exports.to_out_of_tree), (options.betaflight, exports.to_betaflight))
    require(
        any(path is not None for path in (*files.values(), options.out_of_tree, options.betaflight)),
        "expected a file to write, got none; use --onnx FILE, --c FILE, --out-of-tree FOLDER, --betaflight FOLDER, "
        "--tflite FILE, or --rl-tools FILE",
        ValueError,
    )
    for suffix, path in files.items():
        if path is not None:
            check_writable(path, (suffix,))
    policy: Any = exports.find_weights(options.folder)
    meta: Any = None
    config = None
    if policy is None:
        policy, config, meta = load_policy(options.folder)
        if policy.network.is_limited:  # of RAPTOR's shape, which flies other airframes than that of the training, too
            airframe = config.with_device("cpu").make_env(1).sim.airframes[0]
            policy, config, meta = exports.raptor_weights(policy, airframe), None, None
    if isinstance(policy, dict):
        require(
            options.onnx is options.tflite is None,
            f"expected --c or another file for RAPTOR's shape, got {'--tflite' if options.onnx is None else '--onnx'}",
            ValueError,
        )
        if options.drone is not None:
            exports.raptor_order(load_airframe(options.drone))  # refuses rotors that turn the other way
        written = [exports.to_rl_tools(policy, options.rl_tools, options.folder.stem)] if options.rl_tools else []
        write_c = partial(exports.weights_to_c, policy)
    else:
        require(
            options.rl_tools is options.drone is None,
            f"expected a policy of RAPTOR's shape for --rl-tools and --drone, got {str(options.folder)!r}; a run "
            f"has its drone, and mc_raptor flies policies of the task any, or a checkpoint (.tar), only",
            ValueError,
        )
        written = [exports.to_onnx(policy, options.onnx, meta)] if options.onnx else []
        write_c = partial(exports.to_c, policy, meta=meta)
        if options.tflite is not None:
            env = config.with_device("cpu").make_env(DISTILLATION_WORLDS)
            print("distilling the policy to the inputs of mc_nn_control: 10 to 60 s on two cores", flush=True)
            student, parameters = exports.to_mc_nn_control(policy, env, options.tflite)
            metrics = evaluate(exports.observe_inputs(env), student)
            print(f"student: {describe_flight(metrics, env.task.unit)}")
            print("parameters of PX4: " + ", ".join(f"{name} {x:g}" for name, x in parameters.items()))
            written.append(options.tflite)
    if options.c is not None:
        written.append(write_c(options.c))
    for folder, write in folders:
        if folder is not None and config is None:
            written += write(policy, folder, meta, load_airframe(options.drone or "cf21B_500"))
        elif folder is not None:
            env = config.with_device("cpu").make_env(1)
            written += write(policy, folder, meta, env.sim.airframes[0], env.base.freq)
    for path in written:
        print(f"wrote {path}")
    if len(written) > sum(path is not None for path in (options.onnx, options.tflite)):
        print(exports.cost_text(policy, meta))


def render(options: argparse.Namespace) -> None:
    from crazysim.train.show import film

    policy, config, env = _load(options)
    path = options.film or (options.folder / "policy.mp4" if options.folder.is_dir() else Path(f"{config.title}.mp4"))
    film(env, policy, path, options.worlds, options.seed, progress=True)
    print(f"wrote {path}")
