"""The command line: ``crazysim`` or ``python -m crazysim``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; without one, list what there is."""
    parser = argparse.ArgumentParser(
        prog="crazysim", description="A drone simulator in which thousands of worlds advance in one call."
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", dest="command")
    demo = commands.add_parser(
        "demo",
        help="fly figure eights around obstacles in many worlds; print figures, write a plot and a film",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    demo.add_argument("--worlds", type=int, default=1024, help="number of worlds")
    demo.add_argument("--drones", type=int, default=4, help="drones in each world")
    demo.add_argument("--seconds", type=float, default=10.0, help="time to fly, s")
    demo.add_argument("--device", default="cpu", help="where to simulate: cpu, gpu")
    demo.add_argument("--out", type=Path, default=Path("out"), help="folder for the plot and the film")
    demo.add_argument("--no-film", action="store_true", help="write no film")
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help()
        return 0
    from crazysim.demo import run

    try:
        run(options.worlds, options.drones, options.seconds, options.device, options.out, film=not options.no_film)
    except ValueError as error:
        print(f"crazysim: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
