"""``crazysim race``: time-optimal flights over race tracks."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from crazysim.commands.options import DefaultsFormatter, number, parse_pairs, size
from crazysim.errors import expect, require
from crazysim.storage import PICTURE_SUFFIXES, check_writable, write_file

if TYPE_CHECKING:
    from crazysim.lab.racing.flight import RaceFlight


def add_parsers(commands: argparse._SubParsersAction) -> None:
    text = "fly a race track by a time-optimal plan or a policy; print laps and splits, draw and film the flight"
    parser = commands.add_parser("race", help=text, formatter_class=DefaultsFormatter)
    parser.set_defaults(run=run)
    add = parser.add_argument
    track_help = "name of a track, such as split_s_gates, or a YAML file; list prints all names"
    add("track", nargs="?", help=f"{track_help}; not with --controller")
    policy_help = (
        "folder of a training run of the task race, whose policy flies; by default a time-optimal plan is flown"
    )
    add("--policy", type=Path, metavar="FOLDER", help=policy_help)
    controller_help = (
        "controller files of lsy_drone_racing, folders of training runs, or folders of both, to rank in its race; what "
        "is written shows the first run of a single controller"
    )
    add("--controller", type=Path, nargs="+", metavar="PATH", help=controller_help)
    add("--level", type=int, choices=range(4), default=2, help="level of the race of controllers")
    add("--runs", type=number(high=1000, example=20), default=20, help="runs of each controller")
    add("--seed", type=number(0, example=1), default=1, help="seed of the first run of each controller")
    add("--ranking", type=Path, metavar="FILE", help="ranking to write, .json or .md")
    add("--laps", type=number(high=100, example=3), default=1, help="number of laps")
    penalty_help = (
        "seconds that a policy loses for each gate that it touches or misses; by default contacts end the flight"
    )
    add("--penalty", type=number(0.0, 1e3, 2.0, float), metavar="S", help=penalty_help)
    battery_help = "state of charge at the start, up to 1, of a battery that sags, for a policy; by default none"
    add("--battery", type=number(0.05, 1.0, 0.9, float), metavar="C", help=battery_help)
    set_help = "options of the task and the simulation of a policy that differ from the training's"
    add("--set", nargs="+", action="extend", metavar="NAME=VALUE", help=set_help)
    add("--drone", help="airframe of a plan: a name or the path of a TOML file; by default uzh_cpc")
    rates_help = "largest roll, pitch and yaw rate of a plan, rad/s; by default 15 15 3"
    add("--body-rate", type=size(15), nargs=3, metavar=("P", "Q", "R"), help=rates_help)
    add("--floor", type=number(-1e3, 1e3, 0.5, float), help="smallest height of a plan, m; by default none")
    add("--dt", type=size(0.04), help="time between changes of the thrusts of a plan, s; by default 0.04")
    add("--rotor-lag", action="store_true", help="plan with the lag of the airframe's rotors")
    add("--plot", type=Path, metavar="FILE", help="plot to write, .png")
    add("--film", type=Path, metavar="FILE", help="film to write, .mp4 or .gif")
    add("--page", type=Path, metavar="FILE", help="page to write, .html, which plays the flight in a browser")


def run(options: argparse.Namespace) -> int:
    """Fly a race track, print the clock, and write what was asked for; the exit status is 1 if a gate was missed."""
    from crazysim.envs.track_files import track_names

    if options.track == "list":
        print("\n".join(track_names()))
        return 0
    for path, suffixes in (
        (options.plot, PICTURE_SUFFIXES),
        (options.film, (".mp4", ".gif")),
        (options.page, (".html",)),
        (options.ranking, (".json", ".md")),
    ):
        if path is not None:
            check_writable(path, suffixes)
    from crazysim.lab.racing import flight as flights

    if options.controller is not None:
        flight, status = _rank(options)
    else:
        require(
            options.track is not None, "expected a TRACK or --controller PATH, got neither. Use crazysim race list."
        )
        flight = _fly_plan(options) if options.policy is None else _fly_policy(options)
        status = 0 if bool(flight.clock.finished) else 1
    if flight is None:
        return status
    print(flights.summary(flight))
    if options.plot is not None:
        flights.plot(flight, options.plot)
    if options.film is not None:
        flights.film(flight, options.film, progress=True)
    if options.page is not None:
        write_file(options.page, flights.page(flight))
    for path in (options.plot, options.film, options.page):
        if path is not None:
            print(f"wrote {path}")
    return status


def _rank(options: argparse.Namespace) -> tuple[RaceFlight | None, int]:
    from crazysim.lab.racing import ranking
    from crazysim.lab.racing.controllers import Run

    settings = ("track", "policy", "penalty", "battery", "drone", "body_rate", "floor", "dt", "set")
    given = [name for name in settings if getattr(options, name) is not None]
    require(
        not given, f"expected none of the settings of plans with --controller, got {', '.join(given)}. Leave it out."
    )
    runs: list[Run] = []
    scores = ranking.rank(options.controller, options.level, options.runs, options.seed, runs.append)
    print(ranking.table(scores))
    if options.ranking is not None:
        ranking.write(scores, options.ranking, options.level, options.runs, options.seed)
        print(f"wrote {options.ranking}")
    flight = runs[0].flight if runs and len(scores) == 1 else None
    files = [path for path in (options.plot, options.film, options.page) if path is not None]
    require(flight or not files, "expected one controller that flies for --plot, --film and --page. Name one file.")
    return flight, int(any(score.error for score in scores))


def _fly_plan(options: argparse.Namespace) -> RaceFlight:
    import numpy as np

    from crazysim.envs.track_files import load_track
    from crazysim.lab.racing.flight import flight_of_plan
    from crazysim.lab.racing.time_optimal import fly_open_loop, plan_race

    given = [f"--{name}" for name in ("penalty", "battery", "set") if getattr(options, name) is not None]
    require(not given, f"expected {' and '.join(given)} with --policy, got a plan. Leave it out.")
    track = load_track(options.track)
    plan = plan_race(
        track,
        options.drone or "uzh_cpc",
        laps=options.laps,
        body_rate=options.body_rate or (15.0, 15.0, 3.0),
        floor=options.floor,
        dt=options.dt or 0.04,
        rotor_lag=options.rotor_lag,
    )
    deviation = np.linalg.norm(fly_open_loop(plan)[:, :3] - plan.pos, axis=-1).max()
    print(
        f"{plan.airframe.name}: {plan.duration:.3f} s; flown open loop, it deviates by up to {100 * deviation:.1f} cm"
    )
    return flight_of_plan(plan, track, options.laps)


def _fly_policy(options: argparse.Namespace) -> RaceFlight:
    from crazysim.envs.registry import entry_of
    from crazysim.envs.tasks.race import Race
    from crazysim.lab.racing.flight import flight_of_policy
    from crazysim.plugins.effects.battery import Battery
    from crazysim.train.interface import allow_rate_of, check_policy
    from crazysim.train.training import load_policy

    given = [
        name
        for name in ("drone", "body_rate", "floor", "dt", "rotor_lag")
        if getattr(options, name) not in (None, False)
    ]
    require(not given, f"expected the settings of the run with --policy, got {', '.join(given)}. Leave them out.")
    policy, config, _ = load_policy(options.policy)
    settings = parse_pairs(options.set or ())
    policy = allow_rate_of(policy, settings)
    course = {"track": options.track, "laps": options.laps, "level": 0, "device": "cpu"}
    course |= {} if options.penalty is None else {"penalty": options.penalty}
    effects = [] if options.battery is None else [Battery(charge=options.battery)]
    expect(issubclass(entry_of(config.task).task, Race), "a policy of the task race or time_trial", config.task)
    env = config.with_options(**course | settings).make_env(1, effects=effects)
    check_policy(policy, env)
    return flight_of_policy(env, policy)
