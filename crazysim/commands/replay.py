"""``crazysim replay``: recorded flights in a browser."""

from __future__ import annotations

import argparse
from pathlib import Path

from crazysim.commands.options import DefaultsFormatter, add_page_options, number


def add_parsers(commands: argparse._SubParsersAction) -> None:
    text = "play a recorded flight in a browser"
    parser = commands.add_parser("replay", help=text, formatter_class=DefaultsFormatter)
    parser.set_defaults(run=run)
    add = parser.add_argument
    add("flight", type=Path, help="flight saved by crazysim.media.Flight or recorded live")
    add("--world", type=number(0, example=0), help="world to show; by default the first that was recorded")
    add_page_options(parser)
    add("--export", type=Path, metavar="FILE", help="write the page to an .html file instead of serving it")


def run(options: argparse.Namespace) -> None:
    """Serve the page of a flight, or write it."""
    from crazysim.media.flight import Flight
    from crazysim.media.web import page, serve_page
    from crazysim.storage import check_writable, write_file

    if options.export is not None:
        check_writable(options.export, (".html",))
    html = page(Flight.load(options.flight), options.world)
    if options.export is None:
        serve_page(html, options.port, options.host)
    else:
        write_file(options.export, html)
        print(f"wrote {options.export}")
