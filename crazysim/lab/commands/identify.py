"""``crazysim identify``: airframes from logs of real flights."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from crazysim.commands.options import DefaultsFormatter, number, size
from crazysim.drones import load_airframe
from crazysim.errors import ConfigError, require
from crazysim.lab.identify import (
    Columns,
    FittedModel,
    Log,
    Model,
    Predictor,
    aligned,
    errors_table,
    fast_rotation,
    fit_residual,
    identify,
    identify_attitude,
    plot_errors,
    prediction_errors,
    read_log,
    with_speeds,
)
from crazysim.lab.identify.fitted import FITTED_MODELS
from crazysim.storage import PICTURE_SUFFIXES, check_writable, write_file

MAX_HIDDEN = 10_000
"""Largest number of hidden units of ``--network``."""


def add_parsers(commands: argparse._SubParsersAction) -> None:
    """Add the command that fits airframes to flights."""
    text = "fit an airframe to logs of real flights"
    parser = commands.add_parser("identify", help=text, formatter_class=DefaultsFormatter)
    parser.set_defaults(run=run)
    add = parser.add_argument
    add(
        "logs",
        nargs="+",
        metavar="LOG",
        help="logs to fit: .csv, .npz, PX4 .ulg, ROS bags, or logs of a micro-SD card; LOG@10:25 is the part from 10 "
        "to 25 s",
    )
    add("--airframe", default="cf21B_500", help="airframe to start from: a name or a TOML file")
    add("--out", type=Path, required=True, metavar="FILE", help=".toml file to write")
    add("--test", nargs="+", default=[], metavar="LOG", help="held-out logs to report prediction errors on")
    add("--motion", type=Path, nargs="+", default=[], metavar="FILE", help="motion capture of each log, also of --test")
    add("--mass", type=size(0.03), metavar="KG", help="mass; by default the airframe's")
    add(
        "--dynamics",
        choices=["first_principles", *(x.value for x in FITTED_MODELS)],
        default="first_principles",
        help="model to fit",
    )
    network_help = "train a residual wrench with N hidden units, 0 for linear terms"
    add("--network", type=number(0, MAX_HIDDEN, 16), metavar="N", help=network_help)
    add(
        "--iterations",
        type=number(example=1000),
        default=1000,
        metavar="N",
        help="iterations of the training of --network",
    )
    add("--plot", type=Path, metavar="FILE", help="picture of the errors of held-out logs, or else of the fitted ones")
    add(
        "--columns",
        nargs="+",
        default=[],
        metavar="FIELD=NAMES",
        help="names of the log's columns, such as time=s pos=px,py,pz",
    )


def run(options: argparse.Namespace) -> None:
    """Fit an airframe, print its errors, and write its file."""
    check_writable(options.out, (".toml",))
    require(
        not options.out.exists(), f"expected a new file, got {str(options.out)!r}, which exists. Choose another name."
    )
    if options.plot is not None:
        check_writable(options.plot, PICTURE_SUFFIXES)
    require(
        options.dynamics == "first_principles" or options.network is None,
        f"expected no --network with --dynamics {options.dynamics}, which has no residual. "
        "Leave --network out, or use --dynamics first_principles with logs of rotor speeds.",
    )
    # Logs, and what was repaired in them.
    columns = _read_columns(options.columns) if options.columns else None
    paths = [*options.logs, *options.test]
    require(
        not options.motion or len(options.motion) == len(paths),
        f"expected motion capture of each of {len(paths)} logs, got {len(options.motion)} files. "
        "Name them in the order of the logs, then of the logs of --test.",
    )
    all_logs = [
        read_log(path, columns, motion, interval)
        for (path, interval), motion in zip(
            map(_split_interval, paths), options.motion or [None] * len(paths), strict=True
        )
    ]
    airframe = load_airframe(options.airframe)
    if options.dynamics == "first_principles":
        all_logs = [with_speeds(log, airframe) for log in all_logs]
    for log in all_logs:
        for repair in log.repairs:
            print(f"{log.name}: {repair}")
    logs, held_out = all_logs[: len(options.logs)], all_logs[len(options.logs) :]
    source = f"crazysim identify, {datetime.now(UTC):%Y-%m-%d}, from {', '.join(log.name for log in logs)}"
    # Models of attitude commands.
    if options.dynamics != "first_principles":
        fitted, text = identify_attitude(logs, options.airframe, options.dynamics, source, mass=options.mass)
        models = {"identified": FittedModel.create(fitted, options.dynamics)}
        if f"fitted.{options.dynamics}.cmd_f_coef" in airframe.values:
            models = {options.airframe: FittedModel.create(airframe, options.dynamics, options.mass)} | models
        print(text, end="")
        _report_errors(options, logs, held_out, models)
        _write_file(options.out, text)
        return
    # First principles, from rotor speeds.
    result = identify(logs, options.airframe, mass=options.mass)
    print("\n".join(result.describe()))
    logs = [aligned(log, result.delays[log.name]) for log in logs]
    # Each log has its own delay of the state behind the rotor speeds, which fast rotations show.
    held_out = [aligned(log, fast_rotation([log], result.model.params).delays[0]) for log in held_out]
    models = {
        options.airframe: Model.create(airframe, options.mass),
        "identified": result.model,
    }
    if options.network is not None:
        trained = fit_residual(logs, result.model, n_hidden=options.network, iterations=options.iterations)
        result = result.with_residual(trained.residual)
        models["with residual"] = result.model
    _report_errors(options, logs, held_out, models)
    _write_file(options.out, result.toml(source))
    if result.doubtful:
        print(f"DOUBTFUL, less than 1/3 or more than 3 times the airframe's value: {', '.join(result.doubtful)}")


def _report_errors(
    options: argparse.Namespace, logs: Sequence[Log], held_out: Sequence[Log], models: Mapping[str, Predictor]
) -> None:
    for title, flights in (("fitted logs", logs), ("held-out logs", held_out)):
        if flights:
            for name, model in models.items():
                print(f"{title}, {name}\n{errors_table(prediction_errors(flights, model))}")
    if options.plot:
        plot_errors(held_out or logs, models, options.plot)
        print(f"wrote {options.plot}")


def _write_file(path: Path, text: str) -> None:
    write_file(path, text)
    print(f"wrote {path}")


def _split_interval(text: str) -> tuple[str, tuple[float, float]]:
    match = re.fullmatch(r"(.+)@(\d*\.?\d*):(\d*\.?\d*)", text)
    if match is None and re.fullmatch(r".+@[^@/]*:[^@/]*", text) and not Path(text).exists():
        raise ConfigError(f"expected LOG@START:END with times in s, got {text!r}. Use for example flight.csv@10:25.")
    if match is None or Path(text).exists():
        return text, (0.0, math.inf)
    return match[1], (float(match[2] or 0), float(match[3] or math.inf))


def _read_columns(texts: Sequence[str]) -> Columns:
    column_fields = Columns.__dataclass_fields__
    fields: dict[str, Any] = {}
    for text in texts:
        name, equals, names = text.partition("=")
        require(
            name in column_fields and equals,
            f"expected FIELD=NAMES without spaces, such as pos=px,py,pz, got {text!r}. "
            f"Fields are {', '.join(column_fields)}.",
        )
        if "_per_" not in name:  # column names; the other fields are factors, such as rpm_per_unit
            fields[name] = names if name == "time" else tuple(filter(None, names.split(",")))
            continue
        try:
            fields[name] = float(names)
        except ValueError:
            raise ConfigError(f"expected a number as {name}, got {names!r}. Give the factor to SI units.") from None
    return Columns(**fields)
