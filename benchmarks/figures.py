"""Figures of README.md and of docs/results.md: measure them again, and write their tables.

    python benchmarks/figures.py --list
    python benchmarks/figures.py --write [--only loop step] [--device gpu] [--peer-python PATH/OF/python]

``FIGURES`` has a command for each figure. ``--write`` runs the commands for a device. It stores what they print in
``docs/results/figures.json``, with machine, versions, date and commit. Then it writes their tables into the page,
between the comments ``<!-- figure NAME -->`` and ``<!-- end of NAME -->``. Records of other machines stay. On a machine
without the repository, ``--write --records FILE --commit COMMIT`` writes the records to a file. In the repository,
``--write --take FILE`` then puts them into the page.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import tables
from tables import Line

ROOT = Path(__file__).parents[1]
RECORDS_FILE = ROOT / "docs" / "results" / "figures.json"
PAGES = ("README.md", "docs/results.md")
"""Pages with figures."""
MACHINE_KEYS = ("device", "processor", "vectors", "cores", "jax", "python", "date", "crazysim")
"""Keys of lines that a record holds once for all lines."""
VERSUS = "versus_crazyflow.py"


class Figure(NamedTuple):
    """A table of the page, and the command that measures it."""

    cpu: str = ""
    """Command on two cores, without ``python benchmarks/``; empty if the figure has no command for a CPU."""
    gpu: str = ""
    """Command on GPUs, in the same form."""
    table: Callable[[list[Line]], str] | None = None
    """Function that returns the Markdown of a record's lines; None for a figure that the page describes in words."""
    shown: Callable[[Line], bool] = lambda line: True
    """Whether the page shows a line. The machine of the record is its entry ``machine``."""

    def command(self, device: str) -> str:
        """Return the command for a device."""
        return self.gpu if device == "gpu" else self.cpu


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="list figures, commands and records")
    parser.add_argument("--write", action="store_true", help="measure, and write records and pages")
    parser.add_argument(
        "--only", nargs="*", choices=list(FIGURES), default=list(FIGURES), help="figures that --write measures"
    )
    parser.add_argument("--device", choices=("cpu", "gpu"), default="cpu")
    parser.add_argument("--peer-python", help="interpreter with Crazyflow 0.4.0, for comparisons with it")
    parser.add_argument("--data", help="folder with logs of real flights, for the comparisons with them")
    parser.add_argument("--records", type=Path, help="file for the new records, instead of the pages")
    parser.add_argument(
        "--take", type=Path, nargs="+", default=[], help="files with records to write instead of new ones"
    )
    parser.add_argument("--commit", help="commit of the sources; by default the commit that is checked out")
    args = parser.parse_args()
    failures: list[str] = []
    if args.list:
        print("\n".join(list_figures()))
    if args.write:
        if args.take:
            records = [record for path in args.take for record in json.loads(path.read_text())]
        else:
            records, failures = measure(args)
        if args.records is None:
            store_records(records)
            write_pages()
    if failures:
        raise SystemExit("\n".join(failures))


def list_figures() -> list[str]:
    """Return a line for each figure."""
    machines = {name: [record["machine"] for record in load_records() if record["figure"] == name] for name in FIGURES}
    return [
        f"{name}: {figure.cpu or '-'}; {figure.gpu or '-'}; {', '.join(machines[name]) or 'no record'}"
        for name, figure in FIGURES.items()
    ]


def measure(args: argparse.Namespace) -> tuple[list[Line], list[str]]:
    """Run the commands of figures on a device, and return their records and messages about failures."""
    commit, records, failures = args.commit or current_commit(), [], []
    for name in args.only:
        command = FIGURES[name].command(args.device)
        if not command:
            continue
        words = shlex.split(command)
        words += ["--device", "gpu"] * (args.device == "gpu")
        shown_command = shlex.join(words)
        words += ["--peer-python", args.peer_python] if args.peer_python and words[0] == VERSUS else []
        words += ["--data", args.data] if args.data and words[0] == "validation.py" else []
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
        print(f"{name}: {shown_command}", file=sys.stderr, flush=True)
        process = subprocess.run(
            [sys.executable, *words], cwd=ROOT / "benchmarks", env=environment, stdout=subprocess.PIPE, text=True
        )
        lines = [json.loads(text) for text in process.stdout.splitlines() if text.startswith("{")]
        if process.returncode or not lines:
            failures.append(f"{name}: {shown_command} failed with status {process.returncode}; its error is above.")
            continue
        records.append(make_record(name, shown_command, commit, lines))
        if args.records is not None:
            args.records.write_text(records_text(records))
    return records, failures


def make_record(name: str, command: str, commit: str, lines: list[Line]) -> Line:
    """Return the record of a figure."""
    machine_line = next(line for line in lines if "device" in line)
    cores = f"{machine_line['cores']} cores of {machine_line['processor']} ({machine_line['vectors']})"
    return {
        "figure": name,
        "machine": cores if machine_line["device"] == "cpu" else machine_line["device"],
        "jax": machine_line["jax"],
        "python": machine_line["python"],
        "date": machine_line["date"],
        "commit": commit,
        "command": command,
        "lines": [{key: value for key, value in line.items() if key not in MACHINE_KEYS} for line in lines],
    }


def current_commit() -> str:
    """Return the commit that is checked out, followed by ``+`` if the sources differ from it."""
    changes = run_git("status", "--porcelain", "--", "crazysim", "benchmarks").strip()
    return run_git("rev-parse", "--short=9", "HEAD").strip() + "+" * bool(changes)


def run_git(*words: str) -> str:
    """Return the output of a Git command in this repository."""
    process = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True)
    if process.returncode:
        raise RuntimeError(process.stderr.strip())
    return process.stdout


def load_records() -> list[Line]:
    """Return the stored records."""
    return json.loads(RECORDS_FILE.read_text())


def records_text(records: Iterable[Line]) -> str:
    """Return records as the text of ``RECORDS_FILE``."""
    return "[\n" + ",\n".join(json.dumps(record) for record in records) + "\n]\n"


def store_records(records: list[Line]) -> None:
    """Store records in place of earlier records of the same figures and machines."""
    record_by_key = {(record["figure"], record["machine"]): record for record in [*load_records(), *records]}
    order = list(FIGURES)
    sorted_records = sorted(record_by_key.values(), key=lambda x: (order.index(x["figure"]), x["machine"]))
    RECORDS_FILE.write_text(records_text(sorted_records))


def write_pages() -> None:
    """Write the tables of all stored records into the pages."""
    for path in PAGES:
        page = ROOT / path
        text = page.read_text()
        if (written := insert_tables(text, load_records())) != text:
            page.write_text(written)


def figure_names(text: str) -> list[str]:
    """Return the names of the figures whose comments a page has."""
    return re.findall(r"^<!-- figure (\S+) -->$", text, re.MULTILINE)


def insert_tables(text: str, records: list[Line]) -> str:
    """Return a page with the tables of records between its comments."""
    for name in figure_names(text):
        begin, end = f"<!-- figure {name} -->", f"<!-- end of {name} -->"
        before, _, rest = text.partition(begin)
        _, _, after = rest.partition(end)
        text = f"{before}{begin}\n\n{figure_tables(name, records)}\n\n{end}{after}"
    return text


def figure_tables(name: str, records: list[Line]) -> str:
    """Return the tables of a figure, below their machines, versions, dates, commits and commands.

    Tables with the same columns become one, with a column for the machine.
    """
    if name == "readme":
        return tables.readme(records)
    figure = FIGURES[name]
    assert figure.table is not None
    origins: dict[str, list[str]] = {}
    rows: dict[str, list[tuple[str, str]]] = {}
    for record in (record for record in records if record["figure"] == name):
        lines = [line for line in record["lines"] if figure.shown(line | {"machine": record["machine"]})]
        if not lines:
            continue
        versions = f"jax {record['jax']}, Python {record['python']}, {record['date']}, commit {record['commit']}"
        head, rule, *group = figure.table(lines).splitlines()
        origins.setdefault(f"{head}\n{rule}", []).append(f"{record['machine']} ({versions}, `{record['command']}`)")
        rows.setdefault(f"{head}\n{rule}", []).extend((machine_text(record["machine"]), row) for row in group)
    parts = []
    for head, texts in origins.items():
        if len(texts) > 1:
            head_lines = [f"| Machine {head}".replace("\n", "\n| --- ")]
            lines = head_lines + [f"| {machine} {row}" for machine, row in rows[head]]
        else:
            lines = [head, *(row for _, row in rows[head])]
        parts += ["; ".join(texts) + ":", "\n".join(lines)]
    return "\n\n".join(parts)


def machine_text(machine: str) -> str:
    """Return the short name of a machine, such as ``H100``."""
    return machine.split()[1] if machine.startswith("NVIDIA") else "CPU"


def is_avx2(line: Line) -> bool:
    """Whether a line is from a GPU, or from a CPU without its AVX-512."""
    return "(AVX-512)" not in line["machine"]


def is_gpu(line: Line) -> bool:
    """Whether a line is from a GPU."""
    return "NVIDIA" in line["machine"]


def is_large(line: Line) -> bool:
    """Whether a line of a comparison has the most worlds of its device, and one integrator."""
    largest = 262144 if is_gpu(line) else 16384
    return is_avx2(line) and line["n_worlds"] == largest and line["integrator"] == "euler"


FIGURES: dict[str, Figure] = {
    "loop": Figure(f"{VERSUS} --only loop --repeats 9", "loop.py", tables.loops, is_avx2),
    "step": Figure(
        gpu="step.py --controllers auto crazyflow --worlds 1024 16384 262144 4194304 --repeats 5", table=tables.rates
    ),
    "step-randomised": Figure(
        gpu="step.py --controllers auto --worlds 4194304 --integrators euler --randomised", table=tables.rates
    ),
    "limits": Figure(gpu="limits.py", table=tables.limits),
    "versus": Figure(
        f"{VERSUS} --only step --repeats 5",
        f"{VERSUS} --only step --worlds 1024 16384 262144 --integrators euler --repeats 5",
        tables.versus,
        is_large,
    ),
    "gradient-versus": Figure(f"{VERSUS} --only gradient --repeats 9", "", tables.versus, is_avx2),
    "gradient": Figure(
        "gradient.py --worlds 1024",
        "gradient.py --worlds 1024 16384 131072",
        tables.gradients,
        lambda line: line["n_worlds"] != 16384,
    ),
    "coupled": Figure(gpu="coupled.py", table=tables.coupled),
    "envs": Figure("envs.py --actions random policy", "envs.py --actions random policy", tables.env_rates),
    "envs-training": Figure(gpu="envs.py --actions training --worlds 4096 65536 262144", table=tables.env_rates),
    "envs-depth": Figure(gpu="envs.py --tasks avoid --worlds 4096 --depth 16 12 --actions policy"),
    "queries": Figure(
        f"{VERSUS} --only contacts depth swarm_build gym --repeats 3",
        f"{VERSUS} --only contacts depth gym --repeats 3",
        tables.queries,
    ),
    "memory": Figure(f"{VERSUS} --only memory", "", tables.queries),
    "depth": Figure("depth.py --poles 30 1000", "depth.py --worlds 16384", tables.depths, is_avx2),
    "depth-small": Figure(gpu="depth.py --worlds 4096 --size 16 12 --poles 30"),
    "sight": Figure(gpu="sight.py", table=tables.sight),
    "range-finder": Figure(
        "depth.py --range-finder --worlds 1024 --poles 0 4 30 100 1000",
        "depth.py --range-finder --worlds 16384 --poles 0 30 1000",
        tables.range_finders,
        lambda line: line["n_poles"] in (0, 30, 1000),
    ),
    "plugins": Figure("plugins.py --repeats 7", "plugins.py --worlds 1048576 --repeats 7", tables.costs, is_gpu),
    "randomize": Figure(
        "envs.py --randomize --actions random policy --worlds 1024",
        "envs.py --randomize --actions random policy --worlds 4096 1048576",
        tables.env_rates,
    ),
    "loads": Figure(
        "flight_stack.py --cases rod cable offset",
        "flight_stack.py --worlds 4194304 --cases rod cable offset",
        tables.costs,
    ),
    "path-errors": Figure("vehicles.py --errors", "", tables.path_errors),
    "vehicles": Figure(gpu="vehicles.py", table=tables.vehicles),
    "fleets": Figure("fleets.py", "fleets.py", tables.fleets),
    "controllers": Figure(
        "controllers.py --worlds 0",
        "",
        tables.control,
        lambda line: line["controller"] == "auto" or line["drone"] == "cf21B_500",
    ),
    "controllers-rates": Figure(
        "controllers.py --drones cf21B_500 --attitudes 1 --repeats 5",
        "controllers.py --worlds 1048576 --drones cf21B_500 --attitudes 1",
        tables.control_rates,
    ),
    "follow": Figure(
        "flight_stack.py --cases follow starts slots",
        "flight_stack.py --worlds 4194304 --cases follow starts slots",
        tables.costs,
    ),
    "mppi": Figure("mppi.py", "mppi.py", tables.commands),
    "live": Figure("live.py --only max recorded jitter", "", tables.live),
    "mocap": Figure("mocap.py", "", tables.mocap),
    "first-results": Figure("first_results.py --repeat 1", "", tables.first_results),
    "devices": Figure(gpu="devices.py --devices 1 2 4 --processes 12 --hosts 2", table=tables.devices),
    "trainers": Figure(gpu="trainers.py --worlds 1024 65536 --seeds 3", table=tables.trainers),
    "validation-closed": Figure("validation.py closed", "", tables.validation),
    "validation-mujoco": Figure("validation.py mujoco", "", tables.validation),
    "validation-firmware": Figure("validation.py firmware", "", tables.validation_by(": ")),
    "validation-crazyflow": Figure("validation.py crazyflow", "", tables.validation),
    "validation-rotorpy": Figure("validation.py rotorpy", "", tables.validation),
    "validation-commonroad": Figure("validation.py commonroad", "", tables.validation),
    "validation-idsia": Figure("validation.py idsia", "", tables.validation_by(", after ")),
    "validation-nanobench": Figure("validation.py nanobench"),
    "validation-filter": Figure("validation.py filter"),
    "validation-raptor": Figure("validation.py raptor", "", tables.validation),
    "validation-l2f": Figure("validation.py l2f", "", tables.validation),
    "validation-sim2sim": Figure("validation.py sim2sim", "", tables.transfers),
}


if __name__ == "__main__":
    main()
