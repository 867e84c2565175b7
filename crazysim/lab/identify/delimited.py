"""Rows and numbers of text files whose cells are separated by commas."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, require
from crazysim.lab.identify.repairs import MAX_REPAIRED_SHARE

MAX_COLUMNS = 10_000
"""Largest number of columns of a file."""
MAX_TEXT = 40
"""Largest number of characters that are kept from a cell without a number."""


def read_delimited(path: Path, repairs: list[str]) -> dict[str, NDArray]:
    """Return the columns of a file whose first line names them; a column without numbers stays text.

    Args:
        repairs: List that descriptions of repairs are appended to.
    """
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        header, *lines = [*file] or [""]
    if (width := header.count(",") + 1) > MAX_COLUMNS:
        raise ConfigError(f"{path.name}: expected at most {MAX_COLUMNS} columns, got {width}. Export fewer of them.")
    names = [x.strip().strip('"') for x in header.split(",")]
    if len(names) < 2:
        other_separator = next(
            (separator for mark, separator in ((";", "semicolons"), ("\t", "tabs")) if mark in header), None
        )
        got = f"{other_separator} between them" if other_separator else repr(header.strip()[:40])
        raise ConfigError(
            f"{path.name}: expected names of columns in the first line, with commas between them, got {got}. "
            "Export the log with commas, decimal points and a header."
        )
    require(
        any(math.isnan(parse_number(x)) for x in names),
        f"{path.name}: expected names of columns in the first line, got numbers: {header.strip()[:40]}. "
        "Add a first line such as t,x,y,z,qx,qy,qz,qw.",
    )
    if duplicates := sorted(x for x, n in Counter(names).items() if n > 1):
        raise ConfigError(
            f"{path.name}: expected columns of different names, got {duplicates[0][:60]!r} twice. Rename one."
        )
    rows = split_rows(path.name, lines, len(names), 2, repairs, "Export the log again.")
    return {key: _parse_column(cells) for key, cells in zip(names, zip(*rows, strict=True), strict=True)}


def split_rows(
    name: str, lines: Iterable[str], width: int, first_line: int, repairs: list[str], remedy: str
) -> list[list[str]]:
    """Return the cells of the rows with as many cells as the header; drop up to ``MAX_REPAIRED_SHARE`` other rows.

    Args:
        lines: Lines after the header.
        width: Number of cells in the header.
        first_line: Line number of the first of these lines in the file, from 1.
        repairs: List that descriptions of repairs are appended to.
        remedy: Last sentence of the error.
    """
    rows, damaged_rows = [], []
    for number, line in enumerate(lines, first_line):
        cells = line.split(",")
        if len(cells) == width:
            rows.append(cells)
        elif line.strip():
            damaged_rows.append(f"{len(cells)} in line {number}")
    require(
        rows and len(damaged_rows) <= MAX_REPAIRED_SHARE * (len(rows) + len(damaged_rows)),
        f"{name}: expected rows of {width} cells, as in the header, got {len(rows)} such rows and "
        f"{len(damaged_rows)} others{f', the first with {damaged_rows[0]}' if damaged_rows else ''}. {remedy}",
    )
    if damaged_rows:
        repairs.append(
            f"dropped {len(damaged_rows)} rows that have another number of cells, the first {damaged_rows[0]}"
        )
    return rows


def parse_number(text: str) -> float:
    """Return the number in a cell, NaN if it has none."""
    try:
        return float(text.strip().strip('"'))
    except ValueError:
        return math.nan


def _parse_column(cells: Sequence[str]) -> NDArray:
    try:
        return np.array(cells, np.float64)
    except ValueError:
        values = np.array([parse_number(x) for x in cells])
        return (
            values if 2 * np.sum(np.isfinite(values)) > len(values) else np.array([x.strip()[:MAX_TEXT] for x in cells])
        )
