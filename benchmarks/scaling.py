"""Scaling of steps per second, compile time and bytes with the number of worlds and of drones per world.

One JSON line for each engine and size, in two series. In the series ``worlds`` each world has one drone. In the series
``drones`` the number of drones per world grows and the total number of drones is constant. Each case runs in its own
process, so that nothing is cached. ``bytes_a_world`` are the bytes of ``sim.data`` per world, without shared leaves.

    python benchmarks/scaling.py [--engine plain lanes fused] [--most-worlds 4194304] [--plot out/scaling.png]
    python benchmarks/scaling.py --lines out/scaling.jsonl --plot out/scaling.png     # plots stored lines
"""

from __future__ import annotations

import argparse
import json
import sys
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import jax
from measure import Flight, describe_machine, engine_name, medians, round_digits, run_in_process

from crazysim import Sim, __version__
from crazysim.engine import ENGINES
from crazysim.engine.pytree import scopes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--engine", nargs="+", default=["plain", "lanes", "fused"], choices=ENGINES)
    parser.add_argument("--controls", nargs="+", default=["attitude"])
    parser.add_argument("--integrator", default="euler")
    parser.add_argument(
        "--most-worlds", type=int, default=4**11, help="largest number of worlds, reached from 1 by factors of 4"
    )
    parser.add_argument(
        "--most-drones", type=int, default=256, help="largest number of drones per world, reached likewise; 0 for none"
    )
    parser.add_argument("--total", type=int, default=65536, help="total number of drones in the second series")
    parser.add_argument("--steps", type=int, default=100, help="physics steps per call")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--plot", type=Path, help="image to write; needs matplotlib")
    parser.add_argument("--lines", type=Path, help="file of JSON lines to plot instead of measuring")
    args = parser.parse_args()
    lines = [json.loads(line) for line in args.lines.read_text().splitlines()] if args.lines else measure_cases(args)
    if args.plot:
        plot(lines, args.plot)


def measure_cases(args: argparse.Namespace) -> list[dict[str, Any]]:
    sizes = [("worlds", n, 1) for n in powers_of_4(args.most_worlds)]
    sizes += [("drones", max(args.total // n, 1), n) for n in powers_of_4(args.most_drones)]
    lines = []
    for control in args.controls:
        for series, n_worlds, n_drones in sizes:
            for engine in args.engine:
                case = {"control": control, "integrator": args.integrator, "n_worlds": n_worlds, "n_drones": n_drones}
                line = {"benchmark": "scaling", "series": series, "engine": engine, **case, "n_steps": args.steps}
                try:
                    line |= run_in_process(measure, {**case, "engine": engine}, args.steps, args.device, args.repeats)
                except (BrokenProcessPool, jax.errors.JaxRuntimeError) as error:
                    # Out of memory: continue with the other sizes.
                    line |= {"error": f"{type(error).__name__}: {error}"[:200]}
                print(json.dumps(line), flush=True)
                lines.append(line)
    return lines


def powers_of_4(limit: int) -> list[int]:
    """Return 1, 4, 16, ... up to ``limit``."""
    return [4**k for k in range(limit.bit_length()) if 4**k <= limit]


def measure(case: dict[str, Any], n_steps: int, device: str, repeats: int) -> dict[str, Any]:
    sim = Sim(**case, device=device, controller="crazyflow")
    flight = Flight(sim, case["control"], n_steps, device)
    step_s = medians({"step": flight.seconds}, repeats)["step"]
    flight.require_flying()
    n_worlds, n_drones = case["n_worlds"], case["n_drones"]
    return {
        "engine": engine_name(sim),
        "compile_s": round(flight.first_s - step_s, 2),
        "call_s": round_digits(step_s),
        "steps_per_s": round_digits(n_worlds * n_drones * n_steps / step_s),
        "bytes_a_world": bytes_a_world(sim),
        "crazysim": __version__,
        **describe_machine(device),
    }


def bytes_a_world(sim: Sim) -> int:
    """Return the bytes of ``sim.data`` per world, without shared leaves."""
    pairs = zip(jax.tree.leaves(scopes(sim.data)), jax.tree.leaves(sim.data), strict=True)
    return sum(x.nbytes for scope, x in pairs if scope in ("drone", "world")) // sim.n_worlds


SERIES_AXES = {"worlds": ("n_worlds", "worlds of one drone"), "drones": ("n_drones", "drones a world")}
"""Key of the size of a case, and label of its axis, by series."""
ENGINE_STYLES = {
    "plain": ("#9a6a3a", "s"),
    "lanes": ("#2b7a78", "o"),
    "fused": ("#c1443c", "^"),
    "auto": ("#555555", "D"),
}
"""Colour and marker of the lines of each engine."""


def plot(lines: list[dict[str, Any]], path: Path) -> None:
    """Plot steps per second and compile time of both series on logarithmic axes, one line per engine."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    lines = [line for line in lines if "steps_per_s" in line]
    controls = list(dict.fromkeys(line["control"] for line in lines))
    plotted_series = [series for series in SERIES_AXES if any(line["series"] == series for line in lines)]
    quantities = {"steps_per_s": "drone steps per second", "compile_s": "compile time, s"}
    figure, grid = plt.subplots(
        len(quantities), len(plotted_series), figsize=(5 * len(plotted_series), 7), squeeze=False
    )
    for row, (quantity, label) in zip(grid, quantities.items(), strict=True):
        for axes, series in zip(row, plotted_series, strict=True):
            size, name = SERIES_AXES[series]
            for engine, (color, marker) in ENGINE_STYLES.items():
                for control, style in zip(controls, ("-", "--", ":", "-.", (0, (1, 3))), strict=False):
                    selection = {"series": series, "engine": engine, "control": control}
                    points = [(line[size], line[quantity]) for line in lines if line.items() >= selection.items()]
                    if points:
                        title = engine if len(controls) == 1 else f"{engine}, {control}"
                        axes.loglog(*zip(*points, strict=True), marker=marker, color=color, ls=style, label=title)
            axes.set(xlabel=name, ylabel=label)
            axes.grid(alpha=0.3)
    grid[0][0].legend()
    first_line = lines[0]
    machine_name = first_line["processor"] if first_line["device"] == "cpu" else first_line["device"]
    figure.suptitle(f"{', '.join(controls)} command, {first_line['integrator']}, {first_line['n_steps']} steps a call; "
                    f"{machine_name}, jax {first_line['jax']}")  # fmt: skip
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    print(f"wrote {path}", file=sys.stderr)


if __name__ == "__main__":
    main()
