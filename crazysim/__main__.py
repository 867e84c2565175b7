"""The command line: ``crazysim`` or ``python -m crazysim``."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from crazysim import cache
from crazysim.demos import DEMOS
from crazysim.errors import DivergedError, RenderError


class DefaultsFormatter(argparse.HelpFormatter):
    """Help that states the defaults which are numbers or names; a help text that says "by default" states its own."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        text, default = action.help, action.default
        states_none = default == [] or any(default is x for x in (None, False, argparse.SUPPRESS))
        if text is None or states_none or "by default" in text:
            return text
        return f"{text} (default: %(default)s)"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return the exit status; without a command, print the help."""
    parser = argparse.ArgumentParser(
        prog="crazysim", description="A drone simulator in which millions of worlds advance in one call."
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", dest="command")
    demo = commands.add_parser(
        "demo",
        help="run a demonstration; print figures, write a plot and a film",
        epilog=f"demonstrations:\n{_listed(DEMOS)}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    demo.add_argument(
        "name",
        nargs="?",
        choices=DEMOS,
        default="flight",
        metavar="NAME",
        help="demonstration, one of those below; by default flight",
    )
    demo.add_argument(
        "--worlds",
        type=int,
        dest="n_worlds",
        metavar="N",
        help="number of worlds; by default that of the demonstration",
    )
    demo.add_argument(
        "--drones",
        type=int,
        dest="n_drones",
        metavar="N",
        help="drones in each world; by default that of the demonstration",
    )
    demo.add_argument("--seconds", type=float, help="simulated time, s; by default that of the demonstration")
    demo.add_argument("--device", help="device: cpu, gpu; by default cpu")
    demo.add_argument("--out", type=Path, help="folder of the files; by default out")
    demo.add_argument("--no-film", dest="film", action="store_const", const=False, help="write no film")
    replay = commands.add_parser(
        "replay",
        help="play a recorded flight in a browser",
        formatter_class=DefaultsFormatter,
    )
    replay.add_argument("flight", type=Path, help="flight saved by crazysim.media.Flight or recorded live")
    replay.add_argument("--world", type=int, help="world to show; by default the first that was recorded")
    replay.add_argument("--port", type=int, default=8080, help="port of the server; 0 for any free port")
    replay.add_argument("--host", default="127.0.0.1", help="address of the server; 0.0.0.0 to accept other machines")
    replay.add_argument(
        "--export", type=Path, metavar="FILE", help="write the page to an .html file instead of serving it"
    )
    _add_show(commands)
    _add_live(commands)
    _add_training(commands)
    _add_airframe(commands)
    _add_identify(commands)
    commands.add_parser("info", help="print versions, devices, compiler and caches, for reports of bugs")
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help()
        return 0
    if options.command != "info":
        cache.enable_for_command()
    try:
        COMMANDS[options.command](options)
        sys.stdout.flush()
    except (ValueError, ImportError, DivergedError, RenderError) as error:
        print(f"crazysim: {_named_extra(error, options.command)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # who reads the output, such as head, has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what Python flushes at its end
        return 141
    return 0


def _named_extra(error: Exception, command: str) -> str:
    """Return the message of an error; that of a missing package says which extra of crazysim brings it."""
    package = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    if package not in EXTRAS:
        return str(error)
    install = f"pip install 'crazysim[{EXTRAS[package]}]'"
    return f"expected {package}, which 'crazysim {command}' needs, got none. Run {install}."


def _add_show(commands: Any) -> None:
    """Add the command that flies light shows."""
    show = commands.add_parser(
        "show",
        help="fly a light show; print separation and tracking errors, write a film or a report",
        formatter_class=DefaultsFormatter,
    )
    show.add_argument("file", type=Path, help="show to fly, a .skyc file")
    show.add_argument("--film", type=Path, metavar="FILE", help="film to write, .mp4 or .gif")
    show.add_argument(
        "--page", type=Path, metavar="FILE", help="page to write, .html, which plays the show in a browser"
    )
    show.add_argument("--browser", action="store_true", help="play the show on a page in a browser, until Ctrl-C")
    show.add_argument("--port", type=int, default=8080, help="port of the page; 0 for any free port")
    show.add_argument("--host", default="127.0.0.1", help="address of the page; 0.0.0.0 to accept other machines")
    show.add_argument("--window", action="store_true", help="play the show in a window")
    show.add_argument(
        "--live",
        action="store_true",
        help="fly in real time while --window or --browser shows it; no report of distances",
    )
    show.add_argument("--report", type=Path, metavar="FILE", help="figures to write, .json")
    show.add_argument("--seconds", type=float, help="duration of the flight, s; by default that of the show")
    show.add_argument("--fps", type=float, default=25.0, help="frames per second of the film")
    show.add_argument("--drone", help="airframe: a name or the path of a TOML file; by default cf21B_500")
    show.add_argument(
        "--controller", help="controller that follows the trajectories, such as mellinger; by default auto"
    )
    show.add_argument("--device", default="cpu", help="device: cpu, gpu")


def _add_live(commands: Any) -> None:
    """Add the command that flies live."""
    live = commands.add_parser(
        "live",
        help="fly in real time: watch, pilot, command and record; print the factor of real time",
        formatter_class=DefaultsFormatter,
    )
    live.add_argument("--drones", type=int, default=4, metavar="N", help="drones in each world")
    live.add_argument("--worlds", type=int, default=1, metavar="N", help="number of worlds")
    live.add_argument("--seconds", type=float, help="simulated time, s; by default until all viewers are closed")
    live.add_argument("--speed", default="1", help="simulated seconds per second, or max for as fast as possible")
    live.add_argument("--window", action="store_true", help="show a window; by default where there is a screen")
    live.add_argument(
        "--browser", action="store_true", help="show a page in a browser; by default where there is no screen"
    )
    live.add_argument("--headless", action="store_true", help="show nothing; requires --seconds")
    live.add_argument("--port", type=int, default=8080, help="port of the page; 0 for any free port")
    live.add_argument("--host", default="127.0.0.1", help="address of the page; 0.0.0.0 to accept other machines")
    live.add_argument("--fps", type=float, default=50.0, help="pictures per second, sent to viewers")
    live.add_argument("--control-freq", type=int, default=100, metavar="HZ", help="rate of control steps, Hz")
    live.add_argument("--freq", type=int, default=500, metavar="HZ", help="rate of physics steps, Hz")
    live.add_argument("--record", type=Path, metavar="FILE", help="file to record to, for crazysim replay")
    live.add_argument(
        "--pilot", action="store_true", help="pilot the first drone with arrow keys, W, S, A, D and clicks"
    )
    live.add_argument("--gamepad", action="store_true", help="pilot the first drone with a gamepad and the keyboard")
    live.add_argument("--commands", action="store_true", help="listen for commands over TCP, at ports 7000 and 7002")
    live.add_argument("--drone", help="airframe: a name or the path of a TOML file; by default cf21B_500")
    live.add_argument("--controller", help="controller that follows the setpoints, such as mellinger; by default auto")
    live.add_argument("--device", help="device: cpu, gpu; by default cpu")


def _listed(names: Mapping[str, str]) -> str:
    """Return names and what they are, for a help text."""
    return "\n".join(f"  {name:8}{what}" for name, what in names.items())


def _add_training(commands: Any) -> None:
    """Add the commands that train, evaluate, export and film policies."""
    with_defaults = {"formatter_class": DefaultsFormatter}
    train = commands.add_parser(
        "train", help="train a policy; write checkpoint, learning curve, policy and film", **with_defaults
    )
    train.add_argument(
        "task", help="name of a task, such as hover, or place of your own, FILE.py:CLASS; list prints all names"
    )
    train.add_argument("--algorithm", help="ppo or apg; by default that of the task's recipe")
    train.add_argument("--seed", type=int, help="random seed; by default 0")
    train.add_argument("--worlds", type=int, help="number of parallel worlds; by default that of the task's recipe")
    train.add_argument(
        "--iterations",
        type=int,
        help="number of rollouts, each with its updates; by default that of the task's recipe",
    )
    train.add_argument("--out", type=Path, help="folder of the run; by default out/TASK")
    train.add_argument(
        "--resume",
        action="store_true",
        help="continue from the checkpoint in that folder, with its settings where none are given",
    )
    train.add_argument("--device", help="device: cpu, gpu; by default cpu")
    train.add_argument(
        "--set", nargs="+", default=[], metavar="NAME=VALUE", help="options of the task and the simulation"
    )
    train.add_argument("--config", nargs="+", default=[], metavar="NAME=VALUE", help="hyperparameters of the algorithm")
    train.add_argument("--no-film", action="store_true", help="write no film")
    evaluation = commands.add_parser(
        "evaluate", help="evaluate a trained policy on held-out initial states", **with_defaults
    )
    evaluation.add_argument("folder", type=Path, help="folder of the run")
    evaluation.add_argument("--worlds", type=int, default=1000, help="number of initial states")
    evaluation.add_argument("--seed", type=int, help="seed of other initial states than the held-out ones")
    evaluation.add_argument("--plot", type=Path, metavar="FILE", help="plot of the terms of the reward to write, .png")
    evaluation.add_argument(
        "--task", metavar="FILE.py:CLASS", help="place of a task of your own, if it is not where it was in training"
    )
    evaluation.add_argument("--device", help="device: cpu, gpu; by default that of the training")
    export = commands.add_parser("export", help="write a trained policy as ONNX or as a C header", **with_defaults)
    export.add_argument("folder", type=Path, help="folder of the run")
    export.add_argument("--onnx", type=Path, metavar="FILE", help="ONNX file to write")
    export.add_argument("--c", type=Path, metavar="FILE", help="C header to write; it includes only math.h")
    render = commands.add_parser("render", help="film a trained policy", **with_defaults)
    render.add_argument("folder", type=Path, help="folder of the run")
    render.add_argument("--film", type=Path, metavar="FILE", help=".mp4 or .gif; by default policy.mp4 in the folder")
    render.add_argument("--worlds", type=int, default=4, help="number of worlds side by side")
    render.add_argument("--seed", type=int, default=1, help="seed of the initial states")
    render.add_argument(
        "--task", metavar="FILE.py:CLASS", help="place of a task of your own, if it is not where it was in training"
    )
    render.add_argument("--device", help="device: cpu, gpu; by default that of the training")


def _demo(options: argparse.Namespace) -> None:
    names = ("n_worlds", "n_drones", "seconds", "device", "out", "film")
    settings = {name: x for name in names if (x := getattr(options, name)) is not None}
    importlib.import_module(f"crazysim.demos.{options.name}").run(**settings)


def _add_airframe(commands: Any) -> None:
    """Add the commands that make and check airframes."""
    airframe = commands.add_parser("airframe", help="make an airframe of your own from a few numbers, or check one")
    actions = airframe.add_subparsers(title="actions", metavar="ACTION", dest="action", required=True)
    new = actions.add_parser(
        "new",
        help="estimate an airframe from mass, rotors and thrust; write a TOML file with a source for every number",
        epilog="example: crazysim airframe new mine.toml --mass 1.2 --arm 0.12 --propeller 0.127 --thrust-to-weight 4",
        formatter_class=DefaultsFormatter,
    )
    new.add_argument("file", type=Path, help=".toml file to write")
    new.add_argument("--mass", type=float, required=True, metavar="KG", help="mass with the battery")
    new.add_argument("--propeller", type=float, required=True, metavar="M", help="diameter of the propellers")
    new.add_argument("--arm", type=float, metavar="M", help="distance of the rotors from the centre")
    new.add_argument("--rotors", type=int, default=4, dest="n_rotors", metavar="N", help="number of rotors on a circle")
    new.add_argument("--layout", default="x", choices=("x", "+"), help="nose between two rotors, or on the first rotor")
    new.add_argument(
        "--positions",
        metavar="'X,Y ...'",
        help="rotors from the centre of mass, m, instead of --arm: X,Y or X,Y,Z each",
    )
    new.add_argument(
        "--spins",
        nargs="+",
        metavar="CCW|CW",
        help="sense of rotation of each rotor seen from above; by default they alternate from ccw",
    )
    new.add_argument("--thrust-to-weight", type=float, metavar="RATIO", help="largest thrust of all rotors over weight")
    new.add_argument(
        "--motor-table",
        type=Path,
        metavar="FILE",
        help="data sheet of one motor with its propeller instead of --thrust-to-weight, .csv with columns thrust_g or "
        "thrust_n, and if known rpm, torque_nm, power_w",
    )
    new.add_argument("--pitch", type=float, metavar="M", help="pitch of the propellers; by default half the diameter")
    new.add_argument("--inertia", type=float, nargs=3, metavar="KGM2", help="moments; by default estimated")
    new.add_argument("--time-constant", type=float, metavar="S", help="of the rotors; by default estimated")
    new.add_argument("--cells", type=int, metavar="N", help="battery cells in series; by default estimated")
    new.add_argument("--capacity", type=float, metavar="AH", help="of the battery, A h; by default estimated")
    new.add_argument("--resistance", type=float, metavar="OHM", help="of the whole battery; by default estimated")
    new.add_argument("--name", help="name of the airframe; by default that of the file")
    check = actions.add_parser(
        "check", help="print what an airframe can do and what it lacks, and draw it", formatter_class=DefaultsFormatter
    )
    check.add_argument("file", help="path of a .toml file, or the name of a built-in airframe")
    check.add_argument("--picture", type=Path, metavar="FILE", help="picture of the body to write, .png")


def _add_identify(commands: Any) -> None:
    """Add the command that fits airframes to flights."""
    command = commands.add_parser(
        "identify", help="fit an airframe to logs of real flights", formatter_class=DefaultsFormatter
    )
    command.add_argument("logs", type=Path, nargs="+", metavar="LOG", help="logs to fit, .csv or .npz")
    command.add_argument("--airframe", default="cf21B_500", help="airframe to start from: a name or a TOML file")
    command.add_argument("--out", type=Path, required=True, metavar="FILE", help=".toml file to write")
    command.add_argument("--test", type=Path, nargs="+", default=[], metavar="LOG", help="logs for held-out errors")
    command.add_argument("--mass", type=float, metavar="KG", help="mass; by default that of the airframe")
    command.add_argument(
        "--columns", nargs="+", default=[], metavar="FIELD=NAMES", help="columns, such as time=s pos=px,py,pz"
    )


def _identify(options: argparse.Namespace) -> None:
    from datetime import UTC, datetime

    from crazysim.identify import Columns, errors_table, identify, prediction_errors, read_log

    if options.out.suffix != ".toml" or not options.out.parent.is_dir() or options.out.exists():
        raise ValueError(f"expected a new .toml file in an existing folder, got {str(options.out)!r}")
    columns = None
    if options.columns:
        fields = dict(text.partition("=")[::2] for text in options.columns)
        unknown = sorted(set(fields) - set(Columns.__dataclass_fields__))
        if unknown:
            raise ValueError(f"expected fields of {', '.join(Columns.__dataclass_fields__)}, got {unknown[0]!r}")
        convert = {"time": str, "rpm_per_unit": float}
        columns = Columns(**{k: convert.get(k, lambda x: tuple(x.split(",")))(x) for k, x in fields.items()})

    def read(paths: Sequence[Path]) -> list[Any]:
        logs = [read_log(path, columns) for path in paths]
        for log in logs:
            for repair in log.repairs:
                print(f"{log.name}: {repair}")
        return logs

    logs, held_out = read(options.logs), read(options.test)
    result = identify(logs, options.airframe, mass=options.mass)
    for name, x in result.values.items():
        print(f"{name:20}{x:12.4g} +- {result.deviations[name]:.2g}")
    if result.doubtful:
        print(f"doubtful, more than three times from the airframe: {', '.join(result.doubtful)}")
    for title, flights in (("fitted logs", logs), ("held-out logs", held_out)):
        if flights:
            print(f"{title}\n{errors_table(prediction_errors(flights, result.model))}")
    names = ", ".join(log.name for log in logs)
    text = result.toml(f"crazysim identify, {datetime.now(UTC):%Y-%m-%d}, from {names}")
    options.out.write_text(text, encoding="utf-8")
    print(f"wrote {options.out}")


def _airframe(options: argparse.Namespace) -> None:
    from crazysim.drones import load_airframe

    if options.action == "check":
        from crazysim.airframe_check import describe_airframe, draw_airframe

        airframe = load_airframe(options.file)
        print(describe_airframe(airframe))
        if options.picture is not None:
            draw_airframe(airframe, options.picture)
            print(f"wrote {options.picture}")
        return
    _new_airframe(options)


def _new_airframe(options: argparse.Namespace) -> None:
    import tomllib

    from crazysim.drones import estimate_airframe, load_airframe

    path: Path = options.file
    if path.suffix != ".toml" or not path.parent.is_dir():
        raise ValueError(f"expected a .toml file in an existing folder, got {str(path)!r}")
    if path.exists():
        raise ValueError(f"expected a new file, got {str(path)!r}, which exists; choose another name or remove it")
    spins = {"ccw": 1, "cw": -1}
    wrong = [x for x in options.spins or () if x.lower() not in spins]
    if wrong:
        raise ValueError(f"expected --spins of ccw and cw, got {wrong[0]!r}")
    try:
        places = (options.positions or "").split()
        positions = [[float(x) for x in f"{place},0".split(",")][:3] for place in places] or None
    except ValueError:
        raise ValueError(f"expected --positions such as '0.1,-0.1 0.1,0.1', got {options.positions!r}") from None
    given = (
        "mass", "propeller", "arm", "n_rotors", "layout", "thrust_to_weight", "motor_table", "pitch", "inertia",
        "time_constant", "cells", "capacity", "resistance",
    )  # fmt: skip
    numbers = {name: getattr(options, name) for name in given}
    text = estimate_airframe(
        **numbers,
        positions=positions,
        spins=options.spins and [spins[x.lower()] for x in options.spins],
        name=options.name or path.stem,
    )
    tables = tomllib.loads(text)
    load_airframe(tables)
    path.write_text(text, encoding="utf-8")
    estimates = [key for key, source in tables["sources"].items() if source.startswith("estimate: ")]
    print(f"wrote {path}; estimated: {', '.join(estimates)}")
    print(f"next: crazysim airframe check {path} --picture {path.with_suffix('.png')}")


def _info(_: argparse.Namespace) -> None:
    from crazysim.info import info

    print(info())


def _replay(options: argparse.Namespace) -> None:
    from crazysim.media.flight import Flight
    from crazysim.media.web import export, serve

    flight = Flight.load(options.flight)
    if options.export is None:
        serve(flight, options.world, options.port, options.host)
    else:
        export(flight, options.export, options.world)
        print(f"wrote {options.export}")


def _show(options: argparse.Namespace) -> None:
    from crazysim.errors import ConfigError
    from crazysim.progress import progress
    from crazysim.shows import film, fly, page, report, summary
    from crazysim.shows.live_show import run_live
    from crazysim.shows.view import play
    from crazysim.trajectories.files import load_show

    for path, suffixes in ((options.report, (".json",)), (options.page, (".html",)), (options.film, (".mp4", ".gif"))):
        if path is not None and path.suffix not in suffixes:
            raise ConfigError(f"expected the name of a file that ends with {' or '.join(suffixes)}, got {str(path)!r}")
        if path is not None and not path.parent.is_dir():
            raise ConfigError(f"expected an existing folder, got {str(path.parent)!r} for {path.name!r}")
    show = load_show(options.file)
    given = {name: getattr(options, name) for name in ("drone", "controller") if getattr(options, name) is not None}
    if options.live:
        run_live(show, options, device=options.device, **given)
        return
    flight = fly(show, options.seconds, progress, device=options.device, **given)
    figures = report(flight)
    print(summary(flight, figures))
    if options.report is not None:
        options.report.write_text(json.dumps(figures))
        print(f"wrote {options.report}")
    if options.film is not None:
        film(flight, options.film, options.fps, progress=True)
        print(f"wrote {options.film}")
    if options.window:
        play(flight)
    if options.page is not None or options.browser:
        html = page(flight)
        if options.page is not None:
            options.page.write_text(html, encoding="utf-8")
            print(f"wrote {options.page}")
        if options.browser:
            from crazysim.media.web import serve_page

            serve_page(html, options.port, options.host)


def _live(options: argparse.Namespace) -> None:
    from crazysim.live.program import run

    run(options)


def _pairs(texts: Sequence[str]) -> dict[str, Any]:
    """Return NAME=VALUE pairs as a dict; a value that is not JSON is a string."""
    pairs = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ValueError(f"expected NAME=VALUE, got {text!r}; write for example seconds=5")
        try:
            pairs[name] = json.loads(value)
        except ValueError:
            pairs[name] = value
    return pairs


def _train(options: argparse.Namespace) -> None:
    from crazysim.envs.registry import TASKS

    if options.task == "list":
        for name, entry in TASKS.items():
            print(f"{name:12} {(entry.task.__doc__ or '').splitlines()[0]}")
        return
    from crazysim.train.runs import run

    hyperparameters = _pairs(options.config)
    if options.iterations is not None:
        hyperparameters["iterations"] = options.iterations
    device = {} if options.device is None else {"device": options.device}
    run(
        options.task,
        options.out,
        resume=options.resume,
        film=not options.no_film,
        algorithm=options.algorithm,
        seed=options.seed,
        n_worlds=options.worlds,
        options=_pairs(options.set) | device,
        config=hyperparameters,
    )


def _evaluate(options: argparse.Namespace) -> None:
    import jax

    from crazysim.train.evaluation import TERM, evaluate, outcome
    from crazysim.train.show import plot_episode
    from crazysim.train.training import load_policy

    policy, config, _ = load_policy(options.folder, options.task)
    env = config.with_device(options.device).make_env(options.worlds)
    key = None if options.seed is None else jax.random.key(options.seed)
    metrics = evaluate(env, policy, key)
    terms = ", ".join(f"{k.removeprefix(TERM)} {x:.4g}" for k, x in metrics.items() if k.startswith(TERM))
    print(
        f"{config.title}, {options.worlds:,} starts: success {metrics['success']:.1%}, "
        f"{outcome(metrics, env.task.unit)}, mean return {metrics['reward']:.4g} ({terms})"
    )
    if options.plot is not None:
        plot_episode(env, policy, options.plot, key)
        print(f"wrote {options.plot}")


def _export(options: argparse.Namespace) -> None:
    from crazysim.train.export import to_c, to_onnx
    from crazysim.train.training import load_policy

    if options.onnx is None and options.c is None:
        raise ValueError("expected a file to write, got none; use --onnx FILE, --c FILE, or both")
    policy, _, meta = load_policy(options.folder)
    for path, write in ((options.onnx, to_onnx), (options.c, to_c)):
        if path is not None:
            write(policy, path, meta)
            print(f"wrote {path}")


def _render(options: argparse.Namespace) -> None:
    from crazysim.train.show import film
    from crazysim.train.training import load_policy

    policy, config, _ = load_policy(options.folder, options.task)
    path = options.film or options.folder / "policy.mp4"
    env = config.with_device(options.device).make_env(options.worlds)
    film(env, policy, path, options.worlds, options.seed, progress=True)
    print(f"wrote {path}")


EXTRAS = {"optax": "train", "matplotlib": "demo", "imageio_ffmpeg": "demo", "tqdm": "demo", "viser": "web",
          "websockets": "web", "onnx": "onnx", "motioncapture": "mocap", "cflib": "radio"}  # fmt: skip
"""Extra of crazysim that brings a package."""

COMMANDS = {
    "demo": _demo,
    "replay": _replay,
    "show": _show,
    "live": _live,
    "train": _train,
    "evaluate": _evaluate,
    "export": _export,
    "render": _render,
    "airframe": _airframe,
    "identify": _identify,
    "info": _info,
}
"""Functions that run the commands."""


if __name__ == "__main__":
    sys.exit(main())
