"""``crazysim demo``: a demonstration."""

from __future__ import annotations

import argparse
from pathlib import Path

from crazysim.commands.options import MAX_DRONES, DefaultsFormatter, number, size, specified_options


def add_parsers(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "demo",
        help="fly figure eights around poles in many worlds; print figures, write a plot and a film",
        formatter_class=DefaultsFormatter,
    )
    parser.set_defaults(run=run)
    add = parser.add_argument
    add("--worlds", type=number(), dest="n_worlds", metavar="N", help="number of worlds; by default 1024")
    add(
        "--drones",
        type=number(high=MAX_DRONES),
        dest="n_drones",
        metavar="N",
        help="drones in each world; by default 4",
    )
    add("--seconds", type=size(10), help="simulated time, s; by default 10")
    add("--device", help="device: cpu, gpu; by default cpu")
    add("--out", type=Path, help="folder of the files; by default out")
    add("--no-film", dest="film", action="store_const", const=False, help="write no film")


def run(options: argparse.Namespace) -> None:
    """Run the demonstration."""
    from crazysim.commands import demo_flight

    demo_flight.run_demo_flight(
        **specified_options(options, "n_worlds", "n_drones", "seconds", "device", "out", "film")
    )
