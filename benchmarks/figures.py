"""Figures of README.md and of docs/results.md: measure them again, and write their tables.

    python benchmarks/figures.py --list
    python benchmarks/figures.py --show validation-firmware controllers
    python benchmarks/figures.py --write [--only loop step] [--device gpu] [--peer-python PATH/OF/python]

``FIGURES`` has a command for each figure. ``--write`` runs the commands for a device. It stores what they print in
``docs/results/figures.json``, with machine, versions, date and commit. Then it writes the tables of ``tables.TABLES``
into the pages, below the lines that end with ``<!-- figure NAME -->``. ``docs/results/tables.json`` has the tables that
no command of ``FIGURES`` measures, and ``train.py --write`` writes ``docs/results/training.json``. Records of other
machines stay. On a machine without the repository, ``--write --records FILE --commit COMMIT`` writes the records to a
file. In the repository, ``--write --take FILE`` then puts them into the page.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import tables
from tables import Line

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
PAGES = ("README.md", "docs/results.md", "docs/lab/racing.md")
"""Pages with figures."""
MACHINE_KEYS = ("device", "processor", "vectors", "cores", "jax", "python", "date", "crazysim")
"""Keys of lines that a record holds once for all lines."""
SHORT_NAMES = {
    "2 cores of Intel(R) Xeon(R) Processor (AVX2)": "Xeon",
    "2 cores of AMD EPYC (AVX-512)": "EPYC",
    "AMD EPYC": "EPYC",
    "NVIDIA H100 80GB HBM3": "H100",
    "NVIDIA H200": "H200",
}
"""Names of machines in the tables. The page explains them."""
MOST_NAMES = 4
"""Figures that a table names at most."""
VERSUS = "versus_crazyflow.py"
MARKER = re.compile(r"<!-- figure (\S+) -->$", re.MULTILINE)


class Figure(NamedTuple):
    """The commands that measure a figure."""

    cpu: str = ""
    """Command on two cores, without ``python benchmarks/``; empty if the figure has no command for a CPU."""
    gpu: str = ""
    """Command on GPUs, in the same form."""

    def command(self, device: str) -> str:
        return self.gpu if device == "gpu" else self.cpu


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="list figures, commands and records")
    parser.add_argument(
        "--show", nargs="+", default=[], metavar="NAME", choices=table_names(), help="print tables of stored records"
    )
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
    for name in args.show:
        print("\n".join(make_table(name, page_records())), end="\n\n")
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
    return json.loads((RESULTS / "figures.json").read_text())


def records_text(records: Iterable[Line]) -> str:
    return "[\n" + ",\n".join(json.dumps(record) for record in records) + "\n]\n"


def store_records(records: list[Line]) -> None:
    """Store records in place of earlier records of the same figures and machines."""
    record_by_key = {(record["figure"], record["machine"]): record for record in [*load_records(), *records]}
    order = list(FIGURES)
    sorted_records = sorted(record_by_key.values(), key=lambda x: (order.index(x["figure"]), x["machine"]))
    (RESULTS / "figures.json").write_text(records_text(sorted_records))


def page_records() -> list[Line]:
    """Return all records: measured figures, other tables, and a record for each row of the trainings."""
    rows = json.loads((RESULTS / "training.json").read_text())
    trainings = [
        {"figure": "training", "lines": [row]} | {name: row[name] for name in ("machine", "date", "commit")}
        for row in rows
    ]
    return [*load_records(), *json.loads((RESULTS / "tables.json").read_text()), *trainings]


def write_pages() -> None:
    """Write the tables of all stored records into the pages."""
    records = page_records()
    for path in PAGES:
        page = ROOT / path
        text = page.read_text()
        if (written := insert_tables(text, records)) != text:
            page.write_text(written)


def figure_names(text: str) -> list[str]:
    return MARKER.findall(text)


def insert_tables(text: str, records: list[Line]) -> str:
    """Return a page with each table below the line that ends with its comment, after machine, date and commit."""
    for name in figure_names(text):
        origin, table = make_table(name, records)
        replacement = f"{origin} <!-- figure {name} -->\n\n{table}\n"
        pattern = rf"^.*<!-- figure {name} -->\n\n(?:\|.*\n)*"
        text = re.sub(pattern, lambda match, new=replacement: new, text, flags=re.MULTILINE)
    return text


def table_names() -> list[str]:
    return sorted(tables.TABLES.keys() | {x["figure"] for x in page_records() if "rows" in x})


def make_table(name: str, records: list[Line]) -> tuple[str, str]:
    """Return the origin of a table as text, and the table."""
    names = tables.figures_of(name)
    shown = [x for figure in names for x in records if x["figure"] == figure]
    machines = {(x["figure"], x["machine"]) for x in shown}
    # A processor that was also measured without its AVX-512 is shown without.
    shown = [
        x
        for x in shown
        if "AVX-512" not in x["machine"] or (x["figure"], x["machine"].replace("AVX-512", "AVX2")) not in machines
    ]
    if "rows" in shown[0]:
        return origin_text(shown), tables.markdown_table(shown[0]["head"], shown[0]["rows"])
    lines = [
        line | {"machine": SHORT_NAMES.get(x["machine"], x["machine"]), "name": x["figure"]}
        for x in shown
        for line in x["lines"]
    ]
    return origin_text(shown), tables.TABLES[name][1](lines)


def origin_text(records: list[Line]) -> str:
    """Return names, machines, dates and commits of records, and the commands of tables without a figure."""
    machines_by_source: dict[str, dict[str, None]] = {}
    for x in records:
        machine = SHORT_NAMES.get(x["machine"]) or x["machine"]
        about = [
            x["date"],
            f"commit {x['commit']}" if "commit" in x else "",
            f"`{x['command']}`" if "rows" in x and "command" in x else "",
        ]
        machines_by_source.setdefault(", ".join(filter(None, about)), {})[machine] = None
    names = dict.fromkeys(f"`{x['figure']}`" for x in records)
    origins = [f"{', '.join(machines)}, {about}" for about, machines in machines_by_source.items()]
    return (f"{', '.join(names)}: " if len(names) <= MOST_NAMES else "") + "; ".join(origins)


FIGURES: dict[str, Figure] = {
    "loop": Figure(f"{VERSUS} --only loop --repeats 9", "loop.py"),
    "step": Figure(gpu="step.py --controllers auto crazyflow --worlds 1024 16384 262144 4194304 --repeats 5"),
    "step-randomised": Figure(gpu="step.py --controllers auto --worlds 4194304 --integrators euler --randomised"),
    "limits": Figure(gpu="limits.py"),
    "versus": Figure(
        f"{VERSUS} --only step --repeats 5",
        f"{VERSUS} --only step --worlds 1024 16384 262144 --integrators euler --repeats 5",
    ),
    "gradient-versus": Figure(f"{VERSUS} --only gradient --repeats 9"),
    "gradient": Figure("gradient.py --worlds 1024", "gradient.py --worlds 1024 16384 131072"),
    "coupled": Figure(gpu="coupled.py"),
    "envs": Figure("envs.py --actions random policy", "envs.py --actions random policy"),
    "envs-training": Figure(gpu="envs.py --actions training --worlds 4096 65536 262144"),
    "envs-depth": Figure(gpu="envs.py --tasks avoid --worlds 4096 --depth 16 12 --actions policy"),
    "queries": Figure(
        f"{VERSUS} --only contacts depth swarm_build gym --repeats 3",
        f"{VERSUS} --only contacts depth gym --repeats 3",
    ),
    "memory": Figure(f"{VERSUS} --only memory"),
    "depth": Figure("depth.py --poles 30 1000", "depth.py --worlds 16384"),
    "depth-small": Figure(gpu="depth.py --worlds 4096 --size 16 12 --poles 30"),
    "colors": Figure("depth.py --colors --poles 30 --repeats 25", "depth.py --colors --poles 30 --worlds 16384"),
    "maps": Figure("depth.py --maps 200 --worlds 4096 --repeats 7", "depth.py --maps 200 --worlds 16384"),
    "sight": Figure(gpu="sight.py"),
    "range-finder": Figure(
        "depth.py --range-finder --worlds 1024 --poles 0 4 30 100 1000",
        "depth.py --range-finder --worlds 16384 --poles 0 30 1000",
    ),
    "plugins": Figure("plugins.py --repeats 7", "plugins.py --worlds 1048576 --repeats 7"),
    "randomize": Figure(
        "envs.py --randomize --actions random policy --worlds 1024",
        "envs.py --randomize --actions random policy --worlds 4096 1048576",
    ),
    "loads": Figure(
        "flight_stack.py --cases rod cable offset",
        "flight_stack.py --worlds 4194304 --cases rod cable offset",
    ),
    "path-errors": Figure("vehicles.py --errors"),
    "vehicles": Figure(gpu="vehicles.py"),
    "fleets": Figure("fleets.py", "fleets.py"),
    "controllers": Figure("controllers.py --worlds 0"),
    "controllers-rates": Figure(
        "controllers.py --drones cf21B_500 --attitudes 1 --repeats 5",
        "controllers.py --worlds 1048576 --drones cf21B_500 --attitudes 1",
    ),
    "follow": Figure(
        "flight_stack.py --cases follow starts slots",
        "flight_stack.py --worlds 4194304 --cases follow starts slots",
    ),
    "mppi": Figure("mppi.py", "mppi.py"),
    "racing": Figure("racing.py"),
    "live": Figure("live.py --only max recorded jitter"),
    "mocap": Figure("mocap.py"),
    "first-results": Figure("first_results.py --repeat 1"),
    "devices": Figure(gpu="devices.py --devices 1 2 4 --processes 12 --hosts 2"),
    "trainers": Figure(gpu="trainers.py --worlds 1024 65536 --seeds 3"),
    "validation-closed": Figure("validation.py closed"),
    "validation-mujoco": Figure("validation.py mujoco"),
    "validation-firmware": Figure("validation.py firmware"),
    "validation-crazyflow": Figure("validation.py crazyflow"),
    "validation-rotorpy": Figure("validation.py rotorpy"),
    "validation-commonroad": Figure("validation.py commonroad"),
    "validation-idsia": Figure("validation.py idsia"),
    "validation-nanobench": Figure("validation.py nanobench"),
    "validation-filter": Figure("validation.py filter"),
    "validation-any": Figure("validation.py any"),
    "validation-sim2sim": Figure("validation.py sim2sim"),
    "validation-sight": Figure("validation.py sight"),
}


if __name__ == "__main__":
    main()
