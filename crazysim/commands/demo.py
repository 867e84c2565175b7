"""``crazysim demo``: demonstrations."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path

from crazysim.commands.options import given
from crazysim.demos import DEMOS


def add(commands: argparse._SubParsersAction) -> None:
    """Add the command that runs demonstrations."""
    parser = commands.add_parser(
        "demo",
        help="run a demonstration; print figures, write a plot and a film",
        epilog="\n".join(["demonstrations:", *(f"  {name:8}{what}" for name, what in DEMOS.items())]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    add = parser.add_argument
    name_help = "demonstration, one of those below; by default flight"
    add("name", nargs="?", choices=DEMOS, default="flight", metavar="NAME", help=name_help)
    add("--worlds", type=int, dest="n_worlds", metavar="N", help="number of worlds; by default the demonstration's")
    add("--drones", type=int, dest="n_drones", metavar="N", help="drones in each; by default the demonstration's")
    add("--seconds", type=float, help="simulated time, s; by default the demonstration's")
    add("--device", help="device: cpu, gpu; by default cpu")
    add("--out", type=Path, help="folder of the files; by default out")
    add("--no-film", dest="film", action="store_const", const=False, help="write no film")


def run(options: argparse.Namespace) -> None:
    """Run the demonstration of a name."""
    settings = given(options, "n_worlds", "n_drones", "seconds", "device", "out", "film")
    importlib.import_module(f"crazysim.demos.{options.name}").run(**settings)
