"""Comparisons with closed forms, other simulators, the compiled firmware and logs of real flights."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from crazysim.errors import ConfigError, require
from crazysim.lab.validate.any_airframe import load_network
from crazysim.lab.validate.by_sight import load_pilot, sees_forest
from crazysim.lab.validate.rows import Row, measure_sections
from crazysim.lab.validate.sections import NAMES, sections

__all__ = ["NAMES", "Row", "validate"]


def validate(
    data: str | Path | None = None, only: Sequence[str] = NAMES, policy: str | Path | None = None
) -> list[Row]:
    """Compute the rows that ``crazysim validate`` writes to its page.

    Sections whose package is not installed, or whose logs are missing, have no rows. A comparison that raises an error
    is a row with a ``problem``.

    Args:
        data: Folder with logs of real flights in ``idsia`` and ``nanobench``, and trainings in ``policies``; None
            for none.
        only: Names of sections.
        policy: Policy of the section ``any``: a checkpoint of rl-tools (.tar) or the folder of a run; None for the one
            of the package. A run of the task ``forest`` is for the section ``sight``.
    """
    if unknown_names := [name for name in only if name not in NAMES]:
        raise ConfigError(f"expected sections of {', '.join(NAMES)}, got {unknown_names[0]!r}")
    folder = None if data is None else Path(data)
    require(
        folder is None or folder.is_dir(),
        f"expected a folder with logs, got {str(data)!r}. Give one with folders idsia or nanobench in it.",
    )
    source = None if policy is None else Path(policy)
    if source is not None:  # wrong files are refused before the work
        (load_pilot if "sight" in only and (sees_forest(source) or "any" not in only) else load_network)(source)
    return measure_sections([section for section in sections(folder, source) if section.name in only])
