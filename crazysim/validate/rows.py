"""Rows of comparisons, and the page that shows them."""

from __future__ import annotations

import dataclasses
import importlib.util
import math
from collections.abc import Callable, Iterable, Sequence

from crazysim.progress import progress


@dataclasses.dataclass(frozen=True)
class Row:
    """One comparison."""

    what: str
    """Quantity that is compared."""
    against: str
    """Reference and data."""
    figure: float = math.nan
    """Measured figure."""
    unit: str = ""
    """Unit of the figure."""
    bound: tuple[float, float] | None = None
    """Least and largest figure that passes; None for a figure without a bound."""
    beside: str = ""
    """Published or other figure to compare with."""
    problem: str = ""
    """Reason why the comparison failed to run."""

    @property
    def failed(self) -> bool:
        """True where the figure is out of its bound, or the comparison failed to run."""
        return bool(self.problem) or (self.bound is not None and not self.bound[0] <= self.figure <= self.bound[1])


@dataclasses.dataclass(frozen=True)
class Section:
    """Comparisons with one reference."""

    name: str
    """Name for ``--only``."""
    title: str
    """Heading on the page."""
    text: str
    """Paragraph below it: data and method."""
    checks: Sequence[Callable[[], Iterable[Row]]]
    """Functions that measure rows."""
    package: str = ""
    """Package that must be importable."""
    install: str = ""
    """Name of that package for pip."""
    absent: str = ""
    """Reason why the section is not measured."""

    @property
    def missing(self) -> str:
        """Reason why the section cannot be measured, or an empty text."""
        if self.package and importlib.util.find_spec(self.package) is None:
            return f"not installed; run `pip install {self.install}`"
        return self.absent


def measure(sections: Sequence[Section]) -> dict[str, list[Row]]:
    """Return the rows of each section, by name; a check that raises an error is a row that failed."""
    found: dict[str, list[Row]] = {section.name: [] for section in sections}
    tasks = [(section, check) for section in sections if not section.missing for check in section.checks]
    for section, check in progress(tasks, "validating", "check"):
        try:
            found[section.name] += check()
        except Exception as error:  # one broken comparison must not hide the others
            label = getattr(check, "__name__", section.name).replace("_", " ")
            text = f"{type(error).__name__}: {error}".partition("\n")[0][:200]
            found[section.name].append(Row(label, "", problem=text))
    return found


def page(sections: Sequence[Section], rows: dict[str, list[Row]], made: str) -> str:
    """Return the page in Markdown.

    Args:
        sections: Sections, in the order of the page.
        rows: Rows of each, by name.
        made: Sentence with date, commit, machine, versions and command.
    """
    every = [row for section in sections for row in rows[section.name]]
    bounded = [row for row in every if row.bound is not None or row.problem]
    bad = [row for row in bounded if row.failed]
    summary = f"{len(bounded) - len(bad)} of {len(bounded)} figures with a bound are within it."
    if bad:
        summary += " Outside: " + "; ".join(row.what for row in bad) + "."
    parts = [
        "# Validation",
        "Comparisons of crazysim with closed forms, other simulators and real flights. "
        "`crazysim validate --data FOLDER` measures them and writes this page; rows with bad figures stay. FOLDER has "
        "logs of IDSIA's benchmark in `idsia/` and of NanoBench in `nanobench/`, as `.npz` files. Other programs are "
        "compared where they are installed.",
        f"{made} {summary}",
        "A bound says what passes; where there is none, the row reports a figure. Each section says how to repeat it.",
    ]
    for section in sections:
        parts += [f"## {section.title}", section.text]
        if section.missing:
            parts.append(f"Not measured: {section.missing}.")
            continue
        head = ["| Compared | With | Figure | Bound | Beside it |", "| --- | --- | --- | --- | --- |"]
        parts.append("\n".join(head + [_line(row) for row in rows[section.name]]))
    return "\n\n".join(parts) + "\n"


def _line(row: Row) -> str:
    figure = f"failed: {row.problem}" if row.problem else f"{row.figure:.3g} {row.unit}".strip()
    figure = f"**{figure}**" if row.failed else figure
    return f"| {row.what} | {row.against} | {figure} | {_bound(row.bound)} | {row.beside} |".replace("  ", " ")


def _bound(bound: tuple[float, float] | None) -> str:
    if bound is None:
        return ""
    low, high = bound
    if low <= 0:
        return f"at most {high:g}"
    return f"at least {low:g}" if high == math.inf else f"{low:g} to {high:g}"
