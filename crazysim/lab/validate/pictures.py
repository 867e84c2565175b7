"""Pictures of comparisons."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

from crazysim.errors import optional_import
from crazysim.lab.validate.rows import Row, Section
from crazysim.storage import open_replacement


def draw_section(section: Section, rows: Sequence[Row], path: Path) -> None:
    """Write a picture of the rows with a series, one panel for each unit.

    If ``Row.x`` is a number, each series is a line, and the vertical axis is logarithmic. If it is a name, each series
    is a set of points, and the range of figures that pass is shaded.

    Args:
        section: Section with labels of the axes.
        path: File to write, ``.png``.

    Raises:
        ImportError: If matplotlib is not installed.
    """
    with optional_import("pictures need", "matplotlib", "demo"):
        from matplotlib.figure import Figure
    from PIL import Image

    rows = [row for row in rows if row.series and not row.problem]
    units = list(dict.fromkeys(row.unit for row in rows))
    colors = {series: f"C{k}" for k, series in enumerate(dict.fromkeys(row.series for row in rows))}
    has_names = isinstance(rows[0].x, str)
    figure = Figure(figsize=(9, 4 if has_names else 4.8), layout="constrained")
    for ax, unit in zip(figure.subplots(1, len(units), squeeze=False)[0], units, strict=True):
        unit_rows = [row for row in rows if row.unit == unit]
        x_values = list(dict.fromkeys(row.x for row in unit_rows))
        for series in dict.fromkeys(row.series for row in unit_rows):
            points = [
                (x_values.index(row.x) if has_names else row.x, row.figure) for row in unit_rows if row.series == series
            ]
            line = "" if has_names else "--" if series.startswith("published") else "-"
            style = {"marker": "o", "linestyle": line, "markersize": 4, "linewidth": 1.2}
            ax.plot(*zip(*points, strict=True), label=series, color=colors[series], **style)
        if has_names:
            ax.set_xticks(range(len(x_values)), x_values, rotation=90 if len(x_values) > 12 else 20, fontsize=7)
            low, high = next(row.bound for row in unit_rows if row.bound is not None)
            ax.axhspan(max(low, 0), high, color="0.93", zorder=0, label="passes")
            ax.legend(fontsize=7)
        else:
            ax.set(yscale="log", xticks=x_values, xticklabels=[f"{x:g}" for x in x_values])
            ax.yaxis.set_major_formatter("{x:g}")
            ax.yaxis.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:e}"[0] in "25" else "")
            ax.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.15))
        ax.set(xlabel=section.axes[0], ylabel=f"{section.axes[1]}, {unit}".removesuffix(", "))
        ax.grid(alpha=0.3)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110)
    path.parent.mkdir(exist_ok=True)
    with open_replacement(path) as file:
        Image.open(buffer).convert("RGB").quantize(64).save(file, format="PNG", optimize=True)
