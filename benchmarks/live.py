"""The live loop measured: factor of real time, lateness of control steps, cost of pictures and recordings.

    python benchmarks/live.py [--seconds 20] [--drones 30] [--only max recorded pictures jitter]

- max: as fast as possible, with new setpoints of all drones at every control step; ``factor`` is the simulated time
  divided by the real time
- recorded: like max, with 50 samples per simulated second written to a file
- pictures: in real time, with a page in a server that one client reads, and 50 pictures a second
- jitter: in real time without viewers; 99.9% of control steps are late by at most ``lateness_999_ms``

One world, control at 100 Hz, physics at 500 Hz. To measure jitter, use --seconds 600 on an idle machine.
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
import threading
from pathlib import Path
from typing import Any

from measure import report, round_digits

from crazysim import Sim
from crazysim.lab.live import Browser, Live
from crazysim.lab.live.circles import Circles

CASES = ("max", "recorded", "pictures", "jitter")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="simulated time of each case, s")
    parser.add_argument("--drones", type=int, default=30)
    parser.add_argument("--only", nargs="+", choices=CASES, default=CASES)
    args = parser.parse_args()
    for case in args.only:
        measure(case, args.drones, args.seconds)


def measure(case: str, n_drones: int, seconds: float) -> None:
    sim = Sim(n_drones=n_drones, control="state", freq=500)
    speed = 1.0 if case in ("pictures", "jitter") else "max"
    with contextlib.ExitStack() as stack:
        live = stack.enter_context(Live(sim, control_freq=100, speed=speed))
        live.add(Circles(live, piloted=False), name="circles")
        if case == "recorded":
            live.record(Path(stack.enter_context(tempfile.TemporaryDirectory())) / "flight.journal")
        if case == "pictures":
            show_to_client(live)
        live.run(1.0)
        result = live.run(seconds)
    report(
        "cpu",
        benchmark="live",
        case=case,
        n_drones=n_drones,
        seconds=seconds,
        factor=round_digits(result.factor),
        pictures_per_s=round_digits(result.n_pictures / result.wall_s),
        late=result.n_late_steps,
        lateness_999_ms=round_digits(1e3 * result.lateness_999),
        worst_ms=round_digits(1e3 * result.max_lateness),
    )


def show_to_client(live: Live) -> None:
    """Show a simulation in a page that one client reads in a thread."""
    page = live.show(Browser(port=0))
    threading.Thread(target=read_page, args=(page.url,), daemon=True).start()


def read_page(url: str) -> Any:
    """Read and discard the messages of a page's server, as a browser would."""
    from viser import __version__
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    with (
        contextlib.suppress(Exception),
        connect(
            url.replace("http", "ws"), subprotocols=[Subprotocol(f"viser-v{__version__}")], max_size=None
        ) as socket,
    ):
        while True:
            socket.recv()


if __name__ == "__main__":
    main()
