"""``crazysim validate``: a page of comparisons with closed forms, other simulators and real flights."""

from __future__ import annotations

import argparse
import importlib.util
import platform
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path

import crazysim
from crazysim.commands.options import DefaultsFormatter
from crazysim.validate import (
    closed_forms,
    firmware_controllers,
    firmware_filters,
    flights,
    logged_filter,
    peers,
    raptor,
)
from crazysim.validate.rows import Section, measure, page

NAMES = ("closed", "mujoco", "firmware", "crazyflow", "idsia", "nanobench", "filter", "raptor", "l2f")
PEERS = ("crazyflow", "foundation-policy", "l2f")
"""Other programs that are compared if they are installed, by their names for pip."""


def add(commands: argparse._SubParsersAction) -> None:
    """Add the command that measures the page."""
    text = "compare with closed forms, other simulators and logs"
    parser = commands.add_parser("validate", help=text, formatter_class=DefaultsFormatter)
    parser.set_defaults(run=run)
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="folder with logs in idsia/ and nanobench/")
    parser.add_argument("--only", nargs="+", choices=NAMES, default=NAMES, help="sections; by default all")
    parser.add_argument("--out", type=Path, default=Path("validation.md"), metavar="FILE", help="page to write")


def run(options: argparse.Namespace) -> int:
    """Write the page; the exit status is 1 if a figure is out of its bound."""
    if options.data is not None and not options.data.is_dir():
        raise ValueError(
            f"expected a folder with logs, got {str(options.data)!r}. Give one with idsia/ and nanobench/."
        )
    if not options.out.parent.is_dir():
        raise ValueError(f"expected a page in an existing folder, got {str(options.out)!r}")
    chosen = [section for section in sections(options.data) if section.name in options.only]
    rows = measure(chosen)
    options.out.write_text(page(chosen, rows, _made()), encoding="utf-8")
    every = [row for section in chosen for row in rows[section.name]]
    for row in every:
        if row.failed:
            print(f"failed: {row.what}: {row.problem or f'{row.figure:.3g} {row.unit}, bound {row.bound}'}")
    print(f"wrote {options.out}: {len(every)} rows, {sum(row.failed for row in every)} failed")
    return int(any(row.failed for row in every))


def sections(data: Path | None) -> Sequence[Section]:
    """Return the sections of the page.

    Args:
        data: Folder with logs in ``idsia`` and ``nanobench``; None for none.
    """
    absent = "" if data else "give `--data FOLDER`"
    folder = data or Path()
    recorded = "" if firmware_controllers.VECTORS.is_dir() else "run it in a checkout of the sources"
    return (
        Section("closed", "Closed forms and orders",
                "In float64, at 500 Hz. Repeat: `crazysim validate --only closed`.", closed_forms.CHECKS),
        Section("mujoco", "C MuJoCo", "In float64, steps of 1 ms. Repeat: `crazysim validate --only mujoco`.",
                (peers.of_mujoco,)),
        Section("firmware", "The Crazyflie's firmware", "Recorded outputs of its compiled C sources, on the same "
                "inputs, in float32; the recordings are in tests/control and tests/plugins/estimators. Figures "
                "are the largest differences, of motors for 8 flights and a full scale of 65,535. Repeat: `crazysim "
                "validate --only firmware`.",
                (firmware_controllers.of_controllers, firmware_filters.of_filters), absent=recorded),
        Section("crazyflow", "Crazyflow", "In float32, Crazyflow's controllers in both programs. Repeat: `crazysim "
                "validate --only crazyflow`.", (peers.of_crazyflow,), "crazyflow", "crazyflow==0.4.0"),
        Section("idsia", "Real flights, open loop", "A Crazyflie 2.1 Brushless of 45 g: flight melon of IDSIA's "
                "benchmark (arXiv 2512.14450), predicted from measured rotor speeds, starts every 0.05 s. The "
                "published figures are mean distances. Repeat: `crazysim validate --only idsia --data FOLDER`.",
                (partial(flights.open_loop, folder / "idsia"),), absent=absent),
        Section("nanobench", "Real flights, closed loop", "A Crazyflie 2.1: NanoBench (arXiv 2603.09908). The "
                "simulated drone `cf2x_L250` follows the logged setpoints with the firmware's controller and filter. "
                "The figure is its RMS distance from the setpoint over the real drone's. Repeat: `crazysim validate "
                "--only nanobench --data FOLDER`.", (partial(flights.closed_loop, folder / "nanobench"),),
                absent=absent),
        Section("filter", "Real flights, the filter", "The firmware's Kalman filter on the logged "
                "accelerometer, gyroscope and motion capture of NanoBench. The figure is its RMS error against motion "
                "capture over that of the filter on board. Flights more than 2 m from their setpoint are left out. "
                "Repeat: `crazysim validate --only filter --data FOLDER`.",
                (partial(logged_filter.of_filter, folder / "nanobench"),),
                absent=absent),
        Section("raptor", "The foundation policy RAPTOR", "`foundation-policy` 1.0.2, unchanged, commands rotors. It "
                "is called every 10 ms, as in its training, or every 2 ms, with a recurrent state that advances every "
                "10 ms; the authors' firmware calls it every 0.5 to 2.5 ms. A drone is held if it stays within 0.3 m "
                "of its goal from 9 to 10 s. Method of Runge-Kutta of order 4, steps of 2 ms. The latency is added to "
                "the lag of the motors. The policy was trained without latency, on thrusts of 1.5 to 5 weights and "
                "time constants of rising rotor speeds of 30 to 100 ms. Only `cf21B_500` is within these ranges: "
                "`cf2x_L250` has 1.49 weights and 136 ms, `crazyflie` 20 ms, `bumblebee` 10.1 weights. Repeat: "
                "`crazysim validate --only raptor`.",
                (raptor.of_airframes,), "foundation_policy", "foundation-policy"),
        Section("l2f", "l2f, the simulator of RAPTOR's training", "RAPTOR flies the same 256 quadrotors, drawn from "
                "the ranges of its training, in crazysim and in `l2f` 2.0.18, with methods of Runge-Kutta of order 4 "
                "and steps of 2 ms in both. The figure is the difference of the shares that it holds; latency costs as "
                "many quadrotors in the one as in the other. Repeat: `crazysim validate --only l2f`.",
                (raptor.of_trained,), "l2f", "l2f foundation-policy"),
    )  # fmt: skip


def _made() -> str:
    """Return a sentence that says with what the page was made."""
    command = ["git", "-C", str(Path(crazysim.__file__).parent), "describe", "--always", "--dirty"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        commit = f", commit {done.stdout.strip()}" if done.returncode == 0 else ""
    except OSError:
        commit = ""
    found = [name for name in ("jax", "mujoco", "numpy", *PEERS) if importlib.util.find_spec(name.replace("-", "_"))]
    programs = ", ".join(f"{name} {version(name)}" for name in found)
    return (
        f"Made on {datetime.now(UTC):%Y-%m-%d} with crazysim {crazysim.__version__}{commit}, {programs}, Python "
        f"{platform.python_version()}, {platform.machine()}, on a CPU."
    )
