"""Rows of comparisons, and the sections that group them."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import math
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence

from crazysim.errors import ConfigError
from crazysim.progress import progress_bar


@dataclasses.dataclass(frozen=True)
class Row:
    """One comparison."""

    quantity: str
    """Quantity that is compared."""
    reference: str
    """Reference and data."""
    figure: float = math.nan
    """Measured figure."""
    unit: str = ""
    """Unit of the figure."""
    bound: tuple[float, float] | None = None
    """Least and largest figure that passes; None for a figure without a bound."""
    remark: str = ""
    """Other figures to compare with, such as published figures."""
    problem: str = ""
    """Reason why the comparison failed to run."""
    series: str = ""
    """Name of the line or the points in the section's picture that include the figure; empty for none."""
    x: float | str = ""
    """Coordinate along the horizontal axis of that picture: a number or the name of a group."""
    section: str = ""
    """Name of the section."""

    @property
    def failed(self) -> bool:
        """Whether the figure is out of its bound, or the comparison failed to run."""
        return bool(self.problem) or (self.bound is not None and not self.bound[0] <= self.figure <= self.bound[1])

    @property
    def text(self) -> str:
        """Figure with its unit, or the problem."""
        return f"failed: {self.problem}" if self.problem else f"{self.figure:.3g} {self.unit}".strip()


@dataclasses.dataclass(frozen=True)
class Section:
    """Comparisons with one reference."""

    name: str
    """Name for ``--only``."""
    title: str
    """Heading on the page."""
    text: str
    """Paragraph below the heading: data and method."""
    checks: Sequence[Callable[[], Iterable[Row]]]
    """Functions that measure rows."""
    packages: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Modules that must be importable, with the requirement for pip of each."""
    peers: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Modules of other simulators, with the requirement for pip of each. Rows of simulators that are not importable are
    left out."""
    data_problem: str = ""
    """Reason why the section's data are missing; empty if they are not."""
    needs_logs: bool = False
    """Whether the section needs logs of real flights."""
    axes: tuple[str, str] = ("", "")
    """Labels of the axes of the section's picture; empty for none."""

    @property
    def problem(self) -> str:
        """Reason why the section cannot be measured, or an empty string if it can."""
        return _install_advice(self.packages) or self.data_problem

    @property
    def missing_peers(self) -> str:
        """Command that installs the simulators whose rows are left out; empty if no rows are left out."""
        return _install_advice(self.peers)


def _install_advice(packages: Mapping[str, str]) -> str:
    missing = [name for package, name in packages.items() if importlib.util.find_spec(package) is None]
    return f"run `pip install {shlex.join(missing)}`" if missing else ""


def measure_sections(sections: Sequence[Section]) -> list[Row]:
    """Return the rows of all sections; a check that raises an error is a row that failed."""
    rows: list[Row] = []
    tasks = [(section, check) for section in sections if not section.problem for check in section.checks]
    for section, check in progress_bar(tasks, "validating", "check"):
        measured: list[Row] = []
        try:
            measured += check()
        except Exception as error:  # one broken comparison must not hide the others
            check_fn = check.func if isinstance(check, functools.partial) else check
            label = getattr(check_fn, "__name__", section.title).replace("_", " ")
            text = str(error).partition("\n")[0][:300] or type(error).__name__
            measured.append(
                Row(label, "", problem=text if isinstance(error, ConfigError) else f"{type(error).__name__}: {text}")
            )
        rows += [dataclasses.replace(row, section=section.name) for row in measured]
    return rows
