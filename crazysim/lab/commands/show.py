"""``crazysim show``: light shows."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from crazysim.commands.options import (
    SIMULATION_OPTIONS,
    DefaultsFormatter,
    add_page_options,
    add_simulation_options,
    require_screen,
    size,
    specified_options,
)
from crazysim.errors import require
from crazysim.lab.show_files import Show, load_show
from crazysim.storage import check_writable, write_file


def add_parsers(commands: argparse._SubParsersAction) -> None:
    text = "fly a light show; print separation and tracking errors, write a film or a report"
    parser = commands.add_parser("show", help=text, formatter_class=DefaultsFormatter)
    parser.set_defaults(run=run)
    add = parser.add_argument
    add("file", type=Path, help="show to fly, a .skyc file")
    add("--film", type=Path, metavar="FILE", help="film to write, .mp4 or .gif")
    add("--page", type=Path, metavar="FILE", help="page to write, .html, which plays the show in a browser")
    add("--browser", action="store_true", help="play the show on a page in a browser, until Ctrl-C")
    add_page_options(parser)
    add("--window", action="store_true", help="play the show in a window")
    live_help = "fly in real time while --window or --browser shows it; no report of distances"
    add("--live", action="store_true", help=live_help)
    add("--report", type=Path, metavar="FILE", help="figures to write, .json")
    add("--seconds", type=size(10), help="duration of the flight, s; by default the show's")
    add("--fps", type=size(25), default=25.0, help="frames per second of the film")
    add_simulation_options(parser)


def run(options: argparse.Namespace) -> None:
    """Fly a show, and write figures, films and pages of it."""
    from crazysim.lab.shows import film, fly_show, page, report, summary
    from crazysim.media.web import require_free_port
    from crazysim.progress import progress_bar

    for path, suffixes in ((options.report, (".json",)), (options.page, (".html",)), (options.film, (".mp4", ".gif"))):
        if path is not None:
            check_writable(path, suffixes)
    if options.browser and not options.live:
        require_free_port(options.host, options.port, "--")  # the page is served after the flight
    show = load_show(options.file)
    if options.window:
        require_screen("--browser or --film FILE")
    settings = specified_options(options, *SIMULATION_OPTIONS)
    if options.live:
        file_option = next((x for x in ("film", "page", "report") if getattr(options, x) is not None), None)
        require(file_option is None, f"expected --live or --{file_option}, got both. Leave one of them out.")
        _run_live(show, options, settings, options.browser)
        return
    flight = fly_show(show, options.seconds, progress_bar, **settings)
    figures = report(flight)
    print(summary(flight, figures))
    if options.report is not None:
        write_file(options.report, json.dumps(figures))
        print(f"wrote {options.report}")
    if options.film is not None:
        film(flight, options.film, options.fps, progress=True)
        print(f"wrote {options.film}")
    if options.window:
        _run_live(show, options, settings, browser=False)
    if options.page is not None or options.browser:
        html = page(flight)
        if options.page is not None:
            write_file(options.page, html)
            print(f"wrote {options.page}")
        if options.browser:
            from crazysim.media.web import serve_page

            serve_page(html, options.port, options.host)


def _run_live(show: Show, options: argparse.Namespace, settings: dict[str, Any], browser: bool) -> None:
    import numpy as np

    from crazysim.lab.live import Browser, Window
    from crazysim.lab.shows.flight import planned_positions
    from crazysim.lab.shows.view import camera_around, live_show

    with live_show(show, **settings) as live:
        if options.window:
            planned = planned_positions(show.trajectories, np.linspace(0.0, show.duration, 50))
            live.show(Window(cam_config=camera_around(np.asarray(planned))))
        if browser:
            print(f"open {live.show(Browser(options.port, options.host)).url}; stop with Ctrl-C", flush=True)
        seconds = show.duration if options.seconds is None else min(options.seconds, show.duration)
        print(live.run(seconds))
