"""Figures of README.md and of the pages: measure them again, write their tables, and list outdated records.

    python benchmarks/figures.py --list
    python benchmarks/figures.py --write [--only loop step] [--device gpu] [--peer-python PATH/OF/python]
    python benchmarks/figures.py --stale

``FIGURES`` has a command for each figure. ``--write`` runs the commands for a device. It stores what they print in
``docs/concepts/figures.json``, with machine, versions, date and commit. Then it writes their tables into the pages,
between the comments ``<!-- figure NAME -->`` and ``<!-- end of NAME -->``. Records of other machines stay. On a machine
without the repository, ``--write --records FILE --commit COMMIT`` writes the records to a file. In the repository,
``--write --take FILE`` then puts them into the pages.

``--stale`` lists each record that is older than a change of the code that it measures, and ends with status 1 if there
is such a record. Changes of comments, docstrings, annotations of functions, names and error messages are ignored.
"""

from __future__ import annotations

import argparse
import ast
import functools
import itertools
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import tables
from tables import Line

ROOT = Path(__file__).parents[1]
RECORDS_FILE = ROOT / "docs" / "concepts" / "figures.json"
MACHINE_KEYS = ("device", "processor", "vectors", "cores", "jax", "python", "date", "crazysim")
"""Keys of lines that a record holds once for all lines."""

# Sources that several figures measure, as Git's path specifications.
ENGINE = ("crazysim/engine", ":(exclude)crazysim/engine/tools")
BASE = ("crazysim/rotation.py", "crazysim/drones")
STEP = (*BASE, *ENGINE, "crazysim/core", "crazysim/dynamics", "crazysim/control", "crazysim/sim/sim.py")
"""Sources of a step."""
SCENE = ("crazysim/geometry", "crazysim/scene")
ENVS = (*STEP, "crazysim/envs")
PLUGINS = (*STEP, "crazysim/plugins")
TRAIN = (*ENVS, "crazysim/train", ":(exclude)crazysim/train/show.py")
"""Sources of a training, without its plots and films, which are made afterwards and are in no figure."""
VERSUS = ("benchmarks/versus_crazyflow.py", "benchmarks/contestant.py")


class Figure(NamedTuple):
    """A table on a page, and the command that measures it."""

    page: str
    """Page with the figure."""
    sources: tuple[str, ...]
    """Sources that the figure measures, as Git's path specifications, without the script of the command."""
    cpu: str = ""
    """Command on two cores, without ``python benchmarks/``; empty if the figure has no command for a CPU."""
    gpu: str = ""
    """Command on GPUs, in the same form."""
    table: Callable[[list[Line]], str] | None = None
    """Function that returns the Markdown of a record's lines; None if another command writes the page."""
    commits: Callable[[], dict[str, str]] | None = None
    """Function that returns the commits of records that another command stores, by name; None for other figures."""

    def command(self, device: str) -> str:
        """Return the command for a device."""
        return self.gpu if device == "gpu" else self.cpu

    def tracked_paths(self) -> tuple[str, ...]:
        """Return the sources with the scripts of the commands."""
        scripts = {f"benchmarks/{shlex.split(command)[0]}" for command in (self.cpu, self.gpu) if command}
        return (*self.sources, *sorted(scripts))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="list figures, pages, commands and records")
    parser.add_argument("--stale", action="store_true", help="list records that are older than what they measure")
    parser.add_argument("--write", action="store_true", help="measure, and write records and pages")
    parser.add_argument(
        "--only", nargs="*", choices=list(FIGURES), default=list(FIGURES), help="figures that --write measures"
    )
    parser.add_argument("--device", choices=("cpu", "gpu"), default="cpu")
    parser.add_argument("--peer-python", help="interpreter with Crazyflow 0.4.0, for comparisons with it")
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
    if args.stale:
        failures += stale_records()
    if failures:
        raise SystemExit("\n".join(failures))


def list_figures() -> list[str]:
    """Return a line for each figure."""
    machines = {name: [record["machine"] for record in load_records() if record["figure"] == name] for name in FIGURES}
    return [
        f"{name}: {figure.page}; {figure.cpu or '-'}; {figure.gpu or '-'}; {', '.join(machines[name]) or 'no record'}"
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
        words += ["--peer-python", args.peer_python] if args.peer_python and words[0] == Path(VERSUS[0]).name else []
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
    for path in sorted({"README.md", *(figure.page for figure in FIGURES.values())}):
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
    """Return the tables of a figure, each with its machine, versions, date, commit and command."""
    if name == "readme":
        return tables.readme(records)
    table = FIGURES[name].table
    parts = []
    for record in records:
        if record["figure"] == name and table is not None:
            origin = f"jax {record['jax']}, Python {record['python']}, {record['date']}, commit {record['commit']}"
            parts.append(f"{record['machine']} ({origin}, `{record['command']}`):\n\n{table(record['lines'])}")
    return "\n\n".join(parts)


def stale_records() -> list[str]:
    """Return a line for each record that is older than a change of the code that it measures."""
    reports = []
    for name, figure in FIGURES.items():
        commits = [(record["machine"], record["commit"]) for record in load_records() if record["figure"] == name]
        commits += list(figure.commits().items()) if figure.commits else []
        if not commits:
            reports.append(f"{name}: no record")
        for machine, commit in commits:
            try:
                paths = changed_files(commit, figure.tracked_paths())
            except RuntimeError as error:
                reports.append(f"{name}, {machine}: {error}")
                continue
            if paths:
                more_text = f" and {len(paths) - 3} more" if len(paths) > 3 else ""
                reports.append(f"{name}, {machine}: {', '.join(paths[:3])}{more_text} changed after {commit}")
    return reports


def changed_files(commit: str, path_specs: Iterable[str]) -> list[str]:
    """Return the files whose code differs between a commit and the working tree, apart from renamed names."""
    if commit.endswith("+"):
        raise RuntimeError(f"measured with changes beyond commit {commit[:-1]}")
    paths = run_git("diff", "--name-only", "--no-renames", commit, "--", *path_specs).split()
    pairs = {path: pair for path in paths if (pair := read_versions(commit, path)) is not None}
    old_names, new_names = ({name for pair in pairs.values() for name in pair[k].defined} for k in (0, 1))

    def is_same_name(old: str, new: str) -> bool:
        """Return True if two names are equal, or if the new name replaced the old name.

        The new name replaced the old name if the changed files defined the old name before and define the new name now.
        In addition, the old name must no longer be defined, or the new name must not have been defined before. If the
        new name is a name of new code, the file that defines it has changed.
        """
        is_renamed = old in old_names and new in new_names and (new not in old_names or old not in new_names)
        return old == new or is_renamed

    def is_unchanged(path: str) -> bool:
        """Return True if a file differs only in names. Local variables must be renamed one to one within a function."""
        if path not in pairs:
            return False
        old, new = pairs[path]
        renamed: dict[tuple[int, str], str] = {}
        old_name_of: dict[tuple[int, str], str] = {}

        def is_same(x: Atom, y: Atom) -> bool:
            if (x.function, x.is_name) != (y.function, y.is_name):
                return False
            if x.function is None:
                return x.text == y.text or (x.is_name and is_same_name(x.text, y.text))
            return (
                renamed.setdefault((x.function, x.text), y.text) == y.text
                and old_name_of.setdefault((x.function, y.text), x.text) == x.text
            )

        def are_among(imports: set[tuple[str, ...]], others: set[tuple[str, ...]], is_same_part: Any) -> bool:
            return all(any(len(x) == len(y) and all(map(is_same_part, x, y)) for y in others) for x in imports - others)

        return (
            len(old.atoms) == len(new.atoms)
            and all(map(is_same, old.atoms, new.atoms))
            and are_among(old.imports, new.imports, is_same_name)
            and are_among(new.imports, old.imports, lambda x, y: is_same_name(y, x))
        )

    return [path for path in paths if not is_unchanged(path)]


class Atom(NamedTuple):
    """The smallest part of a Python source: a kind of node, a constant or a name."""

    text: str
    """The kind, the constant or the name."""
    is_name: bool = False
    """True for a name, or for a constant that may be one."""
    function: int | None = None
    """Number, in the module, of the function that binds a local variable; None for anything else."""


class Code(NamedTuple):
    """Parts of a Python source that can change a measurement."""

    atoms: list[Atom]
    """Nodes, names and constants, without docstrings, annotations of functions, error messages and imports."""
    imports: set[tuple[str, ...]]
    """Modules and names that it imports."""
    defined: set[str]
    """Names that it defines."""


def read_versions(commit: str, path: str) -> tuple[Code, Code] | None:
    """Return the code of a Python file at a commit and in the working tree; None if the file is missing in one."""
    if not path.endswith(".py") or not (ROOT / path).exists():
        return None
    try:
        return read_code(commit, path), parse_code((ROOT / path).read_text())
    except RuntimeError:
        return None


@functools.cache
def read_code(commit: str, path: str) -> Code:
    """Return the code of a file at a commit."""
    return parse_code(run_git("show", f"{commit}:{path}"))


@functools.cache
def parse_code(source: str) -> Code:
    """Return the code of a Python source."""
    code = Code([], set(), set())
    _add_atoms(code, ast.parse(source), itertools.count(), {})
    return code


FUNCTION_NODES = (
    ast.FunctionDef,
    ast.AsyncFunctionDef,
    ast.Lambda,
    ast.ListComp,
    ast.SetComp,
    ast.DictComp,
    ast.GeneratorExp,
)
"""Kinds of nodes that have local variables."""


def _add_atoms(code: Code, node: ast.AST, counter: Iterator[int], functions: dict[str, int]) -> None:
    """Add the atoms of a node.

    Args:
        code: Code of the source so far.
        node: The node.
        counter: Iterator over the numbers of functions.
        functions: Number of the function that binds each local variable of the functions around the node.
    """
    if isinstance(node, ast.Import | ast.ImportFrom):
        module = getattr(node, "module", None) or ""
        code.imports.update((*module.split("."), name.name, name.asname or "") for name in node.names)
        return
    if isinstance(node, FUNCTION_NODES):
        functions = functions | dict.fromkeys(_local_variables(node), next(counter))
    code.atoms.append(Atom(type(node).__name__))
    can_have_docstring = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
    for field, value in ast.iter_fields(node):
        if field in ("returns", "type_comment", "kind", "ctx") or (field == "annotation" and isinstance(node, ast.arg)):
            continue
        values = list(value) if isinstance(value, list) else [value]
        if field == "body" and can_have_docstring and ast.get_docstring(node, clean=False) is not None:  # type: ignore[arg-type]
            values = values[1:]
        if field == "exc" and isinstance(value, ast.Call):
            values = [value.func]
        code.atoms.append(Atom(f"{field} {len(values)}" if isinstance(value, list) and field != "body" else field))
        for x in values:
            if isinstance(x, ast.Expr) and isinstance(x.value, ast.Constant):
                continue  # the docstring of a field or of a constant
            if isinstance(x, ast.AST):
                _add_atoms(code, x, counter, functions)
            elif isinstance(x, str) and field in ("id", "arg", "name", "attr", "rest"):
                is_attribute = isinstance(node, ast.Attribute | ast.keyword)
                code.atoms.append(Atom(x, True, None if is_attribute else functions.get(x)))
                if _defines(node):
                    code.defined.add(x)
            elif isinstance(x, str) and isinstance(node, ast.Constant):
                code.atoms.extend(Atom(word, word.isidentifier()) for word in x.split("."))
            else:
                code.atoms.append(Atom(repr(x)))


def _local_variables(function: ast.AST) -> set[str]:
    """Return the names that a function binds as parameters or variables, without the names of its inner functions."""
    names, nodes = set(), list(ast.iter_child_nodes(function))
    while nodes:
        node = nodes.pop()
        if _defines(node) and not isinstance(node, ast.Attribute):
            names.add(next(getattr(node, field) for field in ("arg", "id", "name") if hasattr(node, field)))
        nodes += [] if isinstance(node, FUNCTION_NODES) else ast.iter_child_nodes(node)
    return names


def _defines(node: ast.AST) -> bool:
    """Return True if a node defines its name."""
    return isinstance(node, ast.arg | ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.ExceptHandler) or (
        isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store)
    )


def training_commits() -> dict[str, str]:
    """Return the commits of the table that ``train.py --write`` writes, by task."""
    return {
        row["task"]: row["commit"] for row in json.loads((ROOT / "docs/concepts/training-results.json").read_text())
    }


def validation_commits() -> dict[str, str]:
    """Return the commit that ``crazysim validate`` wrote into its page."""
    commit = re.search(r"crazysim [\d.]+, commit ([0-9a-f]{7,}\+?)", (ROOT / "docs/validation.md").read_text())
    return {"all": commit[1]} if commit else {}


PAGE = "docs/concepts/figures.md"
ENGINE_PAGE = "docs/concepts/engine.md"
FIGURES: dict[str, Figure] = {
    "loop": Figure(
        PAGE,
        (*STEP, "crazysim/sim", VERSUS[1]),
        cpu="versus_crazyflow.py --only loop --repeats 9",
        gpu="loop.py",
        table=tables.loops,
    ),
    "step": Figure(
        PAGE,
        STEP,
        gpu="step.py --controllers auto crazyflow --worlds 1024 16384 262144 4194304 --repeats 5",
        table=tables.rates,
    ),
    "step-randomised": Figure(
        PAGE,
        STEP,
        gpu="step.py --controllers auto --worlds 4194304 --integrators euler --randomised",
        table=tables.rates,
    ),
    "limits": Figure(PAGE, STEP, gpu="limits.py", table=tables.limits),
    "versus": Figure(
        PAGE,
        (*STEP, VERSUS[1]),
        cpu="versus_crazyflow.py --only step --repeats 5",
        gpu="versus_crazyflow.py --only step --worlds 1024 16384 262144 --integrators euler --repeats 5",
        table=tables.versus,
    ),
    "gradient-versus": Figure(
        PAGE, (*STEP, VERSUS[1]), cpu="versus_crazyflow.py --only gradient --repeats 9", table=tables.versus
    ),
    "gradient": Figure(
        ENGINE_PAGE,
        STEP,
        cpu="gradient.py --worlds 1024",
        gpu="gradient.py --worlds 1024 16384 131072",
        table=tables.gradients,
    ),
    "coupled": Figure(PAGE, (*STEP, "crazysim/plugins/effects"), gpu="coupled.py", table=tables.coupled),
    "envs": Figure(
        PAGE, ENVS, cpu="envs.py --actions random policy", gpu="envs.py --actions random policy", table=tables.env_rates
    ),
    "envs-training": Figure(
        PAGE,
        TRAIN,
        gpu="envs.py --actions training --worlds 4096 65536 262144",
        table=tables.env_rates,
    ),
    "envs-depth": Figure(
        PAGE,
        (*ENVS, *SCENE),
        gpu="envs.py --tasks avoid --worlds 4096 --depth 16 12 --actions policy",
        table=tables.env_rates,
    ),
    "queries": Figure(
        PAGE,
        (*ENVS, *SCENE, VERSUS[1]),
        cpu="versus_crazyflow.py --only contacts depth swarm_build gym --repeats 3",
        gpu="versus_crazyflow.py --only contacts depth gym --repeats 3",
        table=tables.queries,
    ),
    "memory": Figure(
        PAGE,
        ("crazysim/core", "crazysim/scene", VERSUS[1]),
        cpu="versus_crazyflow.py --only memory",
        table=tables.queries,
    ),
    "depth": Figure(
        PAGE, (*ENGINE, *SCENE), cpu="depth.py --poles 30 1000", gpu="depth.py --worlds 16384", table=tables.depths
    ),
    "depth-small": Figure(
        PAGE, (*ENGINE, *SCENE), gpu="depth.py --worlds 4096 --size 16 12 --poles 30", table=tables.depths
    ),
    "sight": Figure(
        PAGE, (*ENVS, *SCENE, "crazysim/plugins", "crazysim/train/convolution.py"), gpu="sight.py", table=tables.sight
    ),
    "range-finder": Figure(
        PAGE,
        (*STEP, *SCENE, "crazysim/plugins/sensors"),
        cpu="depth.py --range-finder --worlds 1024 --poles 0 4 30 100 1000",
        gpu="depth.py --range-finder --worlds 16384 --poles 0 30 1000",
        table=tables.range_finders,
    ),
    "plugins": Figure(
        PAGE, PLUGINS, cpu="plugins.py --repeats 7", gpu="plugins.py --worlds 1048576 --repeats 7", table=tables.costs
    ),
    "randomize": Figure(
        PAGE,
        (*ENVS, "crazysim/plugins/effects"),
        cpu="envs.py --randomize --actions random policy --worlds 1024",
        gpu="envs.py --randomize --actions random policy --worlds 4096 1048576",
        table=tables.env_rates,
    ),
    "loads": Figure(
        PAGE,
        (*STEP, "crazysim/plugins/payloads"),
        cpu="flight_stack.py --cases rod cable offset",
        gpu="flight_stack.py --worlds 4194304 --cases rod cable offset",
        table=tables.costs,
    ),
    "path-errors": Figure(
        PAGE,
        ("crazysim/core/integration.py", "crazysim/plugins/vehicles", "crazysim/trajectories"),
        cpu="vehicles.py --errors",
        table=tables.path_errors,
    ),
    "vehicles": Figure(PAGE, (*STEP, "crazysim/plugins/vehicles"), gpu="vehicles.py", table=tables.vehicles),
    "fleets": Figure(
        "docs/guides/fleets.md",
        (*STEP, "crazysim/plugins/vehicles"),
        cpu="fleets.py",
        gpu="fleets.py",
        table=tables.fleets,
    ),
    "controllers": Figure(
        "docs/concepts/control-results.md",
        ("crazysim/control", "crazysim/dynamics", "crazysim/drones"),
        cpu="controllers.py --worlds 0",
        table=tables.control,
    ),
    "controllers-rates": Figure(
        "docs/concepts/control-results.md",
        STEP,
        cpu="controllers.py --drones cf21B_500 --attitudes 1 --repeats 5",
        gpu="controllers.py --worlds 1048576 --drones cf21B_500 --attitudes 1",
        table=tables.control_rates,
    ),
    "follow": Figure(
        "docs/concepts/control-results.md",
        (*STEP, "crazysim/plugins/follow.py", "crazysim/trajectories"),
        cpu="flight_stack.py --cases follow starts slots",
        gpu="flight_stack.py --worlds 4194304 --cases follow starts slots",
        table=tables.costs,
    ),
    "mppi": Figure(PAGE, (*STEP, "crazysim/sim/mppi.py"), cpu="mppi.py", gpu="mppi.py", table=tables.commands),
    "live": Figure(PAGE, (*STEP, "crazysim/lab/live"), cpu="live.py --only max recorded jitter", table=tables.live),
    "mocap": Figure(PAGE, ("crazysim/lab/live/mocap",), cpu="mocap.py", table=tables.mocap),
    "first-results": Figure(
        "docs/install.md",
        ("crazysim/engine/cache.py", "crazysim/startup.py", "crazysim/sim", *ENGINE, "crazysim/envs"),
        cpu="first_results.py --repeat 1",
        table=tables.first_results,
    ),
    "devices": Figure(
        "docs/guides/devices.md",
        (*TRAIN, *SCENE),
        gpu="devices.py --devices 1 2 4 --processes 12 --hosts 2",
        table=tables.devices,
    ),
    "trainers": Figure(
        "docs/concepts/training-results.md",
        TRAIN,
        gpu="trainers.py --worlds 1024 65536 --seeds 3",
        table=tables.trainers,
    ),
    "training": Figure(
        "docs/concepts/training-results.md",
        (*TRAIN, *SCENE, "crazysim/plugins"),
        commits=training_commits,
    ),
    "validation": Figure(
        "docs/validation.md",
        (*PLUGINS, "crazysim/lab/validate"),
        commits=validation_commits,
    ),
}


if __name__ == "__main__":
    main()
