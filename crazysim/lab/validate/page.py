"""Markdown page with the results of all comparisons."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Mapping, Sequence

from crazysim.lab.validate.rows import Row, Section

INTRODUCTION = """
# Validation

Comparisons of crazysim with closed forms, other simulators, the Crazyflie's firmware and real flights. Rows with bad
figures are kept. In a checkout of the sources, these commands write this page:

```sh
pip install -e {packages}
crazysim validate --data FOLDER
```

Each section names the command that measures it again and writes it to `validation.md`. Sections whose package is not
installed are left out, and so are rows of simulators that are not installed. In Python
`crazysim.lab.validate.validate(only=["mujoco"])` returns the rows.

FOLDER holds logs of real flights, `.csv` or `.npz`, which are not part of crazysim, and the policies that the section
*Sim to sim* trains:

- `idsia/melon_20251017_run1.csv` is a flight of IDSIA's benchmark (arXiv 2512.14450) as it was recorded. These commands
  write it in a clone of [its repository](https://github.com/idsia-robotics/nanodrone-sysid-benchmark), with pandas and
  pyarrow:

    ```sh
    git checkout b0cf4b3
    python -c "import pandas
    log = pandas.read_parquet('control_engineering_practice/data/real/new/parquets/melon_20251017_run1.parquet')
    log[250:6750].to_csv('melon_20251017_run1.csv', index=False)"
    ```

    This page was made with these samples rounded to float32, which changes its figures by up to 2%.
- `nanobench/` holds the logs of NanoBench (arXiv 2603.09908) that the rows name, from `datasets/dataset` of
  [its repository](https://github.com/syediu/nanobench-iros2026) at commit d45bc5a. More of its logs make more rows.
- `policies/` holds or receives the trainings; without FOLDER, they are not kept.

A figure passes if it is within the range in its row; figures without a range always pass.
"""
"""Introduction at the top of the page, in which ``packages`` is filled in."""
TABLE_COLUMNS: Mapping[str, Callable[[Row], str]] = {
    "Quantity": lambda row: row.quantity,
    "Reference": lambda row: row.reference,
    "Figure": lambda row: f"**{row.text}**" if row.failed else row.text,
    "Passes": lambda row: bound_text(row.bound),
    "For comparison": lambda row: row.remark,
}
"""Functions from a row to the text of a cell, by the heading of the column."""


def format_page(sections: Sequence[Section], rows: Sequence[Row], provenance: str, pictures: Mapping[str, str]) -> str:
    """Return the page in Markdown.

    Args:
        sections: Sections, in their order on the page.
        rows: Rows of these sections.
        provenance: Sentence with the date, commit, machine and versions with which the rows were measured.
        pictures: Paths of pictures, relative to the page, by the name of their section.
    """
    # A comparison that failed to run counts as outside of its range.
    counted_rows = [row for row in rows if row.bound is not None or row.problem]
    failed_rows = [row for row in counted_rows if row.failed]
    summary = (
        f" {len(counted_rows) - len(failed_rows)} of {len(counted_rows)} figures with a range are within it."
        if counted_rows
        else ""
    )
    if failed_rows:
        summary += " Outside: " + "; ".join(row.quantity for row in failed_rows) + "."
    packages = dict.fromkeys(
        name for section in sections for name in (*section.packages.values(), *section.peers.values())
    )
    parts = [INTRODUCTION.format(packages=f'".[demo]" {shlex.join(packages)}'.rstrip()).strip(), provenance + summary]
    for section in sections:
        command = f"`crazysim validate --only {section.name}{' --data FOLDER' * section.needs_logs}`"
        if package_names := [*section.packages.values(), *section.peers.values()]:
            command = f"`pip install {shlex.join(package_names)}` and {command}"
        parts += [f"## {section.title}", section.text, f"Repeat: {command}."]
        if section.problem:
            parts.append(f"Not measured: {section.problem}.")
            continue
        if section.name in pictures:
            parts.append(f"![{section.axes[1]}]({pictures[section.name]})")
        section_rows = [row for row in rows if row.section == section.name]
        cells = {name: [cell(row) for row in section_rows] for name, cell in TABLE_COLUMNS.items()}
        cells = {name: column for name, column in cells.items() if any(column)}
        lines = [list(cells), ["---"] * len(cells), *zip(*cells.values(), strict=True)]
        parts.append("\n".join(f"| {' | '.join(line)} |".replace("  ", " ") for line in lines))
        if section.missing_peers:
            parts.append(f"Left out: {section.missing_peers}.")
    return "\n\n".join(parts) + "\n"


def bound_text(bound: tuple[float, float] | None) -> str:
    """Return a bound in words; empty for None."""
    if bound is None:
        return ""
    low, high = bound
    if low <= 0:
        return f"at most {high:.2g}"
    return f"at least {low:.3g}" if high == math.inf else f"{low:.3g} to {high:.3g}"
