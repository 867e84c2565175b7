"""``crazysim validate``: a page of comparisons with closed forms, other simulators and real flights."""

from __future__ import annotations

import argparse
import importlib.util
import platform
import re
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import crazysim
from crazysim.commands.options import DefaultsFormatter
from crazysim.lab.validate import NAMES, Row, validate
from crazysim.lab.validate.page import bound_text, format_page
from crazysim.lab.validate.pictures import draw_section
from crazysim.lab.validate.rows import Section
from crazysim.lab.validate.sections import sections
from crazysim.storage import check_writable, write_file

PICTURES_FOLDER = "pictures"
"""Name of the folder of the pictures, in the folder of the page."""


def add_parsers(commands: argparse._SubParsersAction) -> None:
    text = "compare with closed forms, other simulators and logs"
    parser = commands.add_parser("validate", help=text, formatter_class=DefaultsFormatter)
    parser.set_defaults(run=run)
    parser.add_argument(
        "--data",
        type=Path,
        metavar="FOLDER",
        help="folder with logs in idsia/ and nanobench/; trained policies are kept in its folder policies/",
    )
    parser.add_argument("--only", nargs="+", choices=NAMES, default=NAMES, help="sections; by default all")
    policy_help = (
        "policy to compare with RAPTOR, rl-tools' .tar or a run of the task any, by default the package's; or a run of "
        "the task forest, which is flown by other images"
    )
    parser.add_argument("--policy", type=Path, metavar="FILE|FOLDER", help=policy_help)
    parser.add_argument("--out", type=Path, default=Path("validation.md"), metavar="FILE", help="page to write; its "
                        "pictures, of logs alone, go to the folder pictures next to it")  # fmt: skip


def run(options: argparse.Namespace) -> int:
    """Write the page and its pictures; the exit status is 1 if a figure is out of its bound."""
    check_writable(options.out)
    if (pictures := options.out.parent / PICTURES_FOLDER).exists():
        check_writable(pictures / options.out.name)
    rows = validate(options.data, options.only, options.policy)
    selected_sections = [section for section in sections(options.data, options.policy) if section.name in options.only]
    for section in selected_sections:
        if section.problem:
            print(f"left out {section.name}: {section.problem}")
        elif section.missing_peers:
            print(f"left out rows of {section.name}: {section.missing_peers}")
    pictures = _draw_sections(selected_sections, rows, options.out.parent)
    write_file(options.out, format_page(selected_sections, rows, _provenance(selected_sections), pictures))
    for row in rows:
        if row.failed:
            print(f"failed: {row.quantity}: {row.problem or f'{row.text}, {bound_text(row.bound)} passes'}")
    print(f"wrote {options.out}: {len(rows)} rows, {sum(row.failed for row in rows)} failed")
    return int(any(row.failed for row in rows))


def _draw_sections(selected_sections: Sequence[Section], rows: Sequence[Row], folder: Path) -> dict[str, str]:
    pictures = {}
    for section in selected_sections:
        section_rows = [row for row in rows if row.section == section.name]
        if not any(row.series for row in section_rows):
            continue
        pictures[section.name] = f"{PICTURES_FOLDER}/validation_{section.name}.png"
        try:
            draw_section(section, section_rows, folder / pictures[section.name])
        except ImportError as error:
            print(f"no pictures: {error}")
            return {}
    return pictures


def _provenance(selected_sections: Sequence[Section]) -> str:
    command = ["git", "-C", str(Path(crazysim.__file__).parent), "describe", "--always", "--dirty"]
    try:
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        commit = f", commit {result.stdout.strip()}" if result.returncode == 0 else ""
    except OSError:
        commit = ""
    packages: dict[str, str] = {}  # requirements by name of import
    for section in selected_sections:
        if not section.problem:
            packages |= section.packages
            packages |= {k: name for k, name in section.peers.items() if importlib.util.find_spec(k) is not None}
    other_packages = dict.fromkeys(re.split(r"[\[=@]", name)[0] for name in packages.values())
    programs = ", ".join(f"{name} {version(name)}" for name in ("jax", "mujoco", "numpy", *other_packages))
    return (
        f"Made on {datetime.now(UTC):%Y-%m-%d} with crazysim {crazysim.__version__}{commit}, {programs}, Python "
        f"{platform.python_version()}, on a CPU ({_processor()})."
    )


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
