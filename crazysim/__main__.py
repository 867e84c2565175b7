"""The command line: ``crazysim`` or ``python -m crazysim``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from crazysim.errors import RenderError


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
    replay = commands.add_parser(
        "replay",
        help="show a recorded flight in a browser, to be played and scrubbed",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    replay.add_argument("flight", type=Path, help="what crazysim.pictures.Flight has saved, an .npz file")
    replay.add_argument("--world", type=int, help="which world; the first that was recorded if left out")
    replay.add_argument("--port", type=int, default=8080, help="where the page is served; 0 for any free port")
    replay.add_argument("--host", default="127.0.0.1", help="who may see it; 0.0.0.0 for everyone")
    replay.add_argument("--export", type=Path, metavar="FILE", help="write the page into this .html, and serve nothing")
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help()
        return 0
    try:
        {"demo": _demo, "replay": _replay}[options.command](options)
    except (ValueError, ImportError, RenderError) as error:
        print(f"crazysim: {error}", file=sys.stderr)
        return 2
    return 0


def _demo(options: argparse.Namespace) -> None:
    from crazysim.demo import run

    run(options.worlds, options.drones, options.seconds, options.device, options.out, film=not options.no_film)


def _replay(options: argparse.Namespace) -> None:
    from crazysim.pictures.flight import Flight
    from crazysim.pictures.web import export, serve

    flight = Flight.load(options.flight)
    if options.export is None:
        serve(flight, options.world, options.port, options.host)
    else:
        export(flight, options.export, options.world)
        print(f"wrote {options.export}")


if __name__ == "__main__":
    sys.exit(main())
