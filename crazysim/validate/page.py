"""The page of comparisons."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from crazysim.validate.rows import Row, Section

INTRODUCTION = """
# Validation

Comparisons of crazysim with closed forms, other simulators, the Crazyflie's firmware and real flights. Rows with bad
figures stay. This page is written by

```sh
crazysim validate --data FOLDER --out docs/validation.md
```

and each section names the command that repeats it; without `--out` it writes `validation.md`. Other programs are
compared where they are installed:
`pip install crazyflow==0.4.0 rotorpy commonroad-vehicle-models foundation-policy l2f`.
In Python `crazysim.validate.validate(only=["mujoco"])` returns the rows.

FOLDER holds logs of real flights as `.csv` or `.npz` tables, which are not part of crazysim:

- `idsia/`: melon of IDSIA's benchmark (arXiv 2512.14450), `data/test` of
  [its repository](https://github.com/idsia-robotics/nanodrone-sysid-benchmark) (Git LFS). Here it is the recording as
  it stood at commit b0cf4b3; the published tables were processed further, so that figures may differ a little.
- `nanobench/`: NanoBench (arXiv 2603.09908), `datasets/dataset` of
  [its repository](https://github.com/syediu/nanobench-iros2026); here 34 of its flights.

A figure passes if it is within the range in its row; rows without a range report what was found.
"""
"""Beginning of the page."""
COLUMNS: Mapping[str, Callable[[Row], str]] = {
    "Quantity": lambda row: row.what,
    "Reference": lambda row: row.against,
    "Figure": lambda row: f"**{row.text}**" if row.failed else row.text,
    "Passes": lambda row: bound_text(row.bound),
    "For comparison": lambda row: row.other,
}
"""Cells of a row by the heading of their column."""


def page(sections: Sequence[Section], rows: Sequence[Row], made: str, pictures: Mapping[str, str]) -> str:
    """Return the page in Markdown.

    Args:
        sections: Sections, in the order of the page.
        rows: Their rows.
        made: Sentence with date, commit, machine and versions.
        pictures: Paths of pictures, relative to the page, by the name of the section.
    """
    bounded = [row for row in rows if row.bound is not None or row.problem]
    bad = [row for row in bounded if row.failed]
    summary = f"{len(bounded) - len(bad)} of {len(bounded)} figures with a bound are within it."
    if bad:
        summary += " Outside: " + "; ".join(row.what for row in bad) + "."
    parts = [INTRODUCTION.strip(), f"{made} {summary}"]
    for section in sections:
        repeat = f"`crazysim validate --only {section.name}{' --data FOLDER' * section.logs}`"
        parts += [f"## {section.title}", section.text, f"Repeat: {repeat}."]
        if section.missing:
            parts.append(f"Not measured: {section.missing}.")
            continue
        if section.name in pictures:
            parts.append(f"![{section.axes[1]}]({pictures[section.name]})")
        own = [row for row in rows if row.section == section.name]
        cells = {name: [cell(row) for row in own] for name, cell in COLUMNS.items()}
        cells = {name: column for name, column in cells.items() if any(column)}
        lines = [list(cells), ["---"] * len(cells), *zip(*cells.values(), strict=True)]
        parts.append("\n".join(f"| {' | '.join(line)} |".replace("  ", " ") for line in lines))
    return "\n\n".join(parts) + "\n"


def bound_text(bound: tuple[float, float] | None) -> str:
    """Return the bound in words, or an empty text."""
    if bound is None:
        return ""
    low, high = bound
    if low <= 0:
        return f"at most {high:.2g}"
    return f"at least {low:.3g}" if high == math.inf else f"{low:.3g} to {high:.3g}"
