"""Airframes from names, files and dicts, with the bases that they extend."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazysim.drones.airframe import TUNED_TABLES, Airframe, AirframeSource, airframe_names
from crazysim.drones.airframe_checks import check_airframe
from crazysim.drones.keys import LAYOUT
from crazysim.storage import is_file
from crazysim.tables import extend_bases, read_source

AIRFRAME_FOLDER = Path(__file__).parent
BODY_KEYS = (
    "rigid_body.mass",
    "rigid_body.inertia",
    "rotors.position",
    "rotors.yaw_torque_sign",
    "rotors.thrust_max",
    "rotors.thrust_curve",
)
"""Numbers on which the gains and fits of an airframe depend."""


def load_airframe(source: AirframeSource) -> Airframe:
    """Load an airframe by its name, from a TOML file anywhere on disk, or from a dict of the same tables.

    A number is written plainly, or as ``{ value = ..., unit = "...", source = "..." }`` as in the built-in files. The
    key ``base`` is the name or path of another airframe, from which missing numbers are inherited. If one of
    ``BODY_KEYS`` differs from the base, gains and fits (``TUNED_TABLES``) are not inherited, except for
    ``controller.thrust2torque`` if neither the thrust curve nor the torque curve is given.

    Args:
        source: Name of a built-in airframe, path of a ``.toml`` file, dict, or an airframe, which is returned
            unchanged.

    Raises:
        UnknownNameError: If the source is neither the name of an airframe nor a file.
        ConfigError: If the file has an unknown table or key, or numbers with which no drone can fly.
    """
    return _load(source, ())


def is_airframe_file(source: object) -> bool:
    """Return True for the path of a file, and False for a name of a built-in airframe or anything else."""
    return isinstance(source, (str, Path)) and str(source) not in airframe_names() and is_file(source)


def _load(source: Any, bases: tuple[str, ...]) -> Airframe:
    if isinstance(source, Airframe):
        return source
    bases = extend_bases(bases, source)
    stem, origin, tables = read_source(source, "drone", "an Airframe", AIRFRAME_FOLDER, airframe_names(), LAYOUT.guide)
    name = str(tables.get("name", stem))
    numbers, reason = dict(LAYOUT.numbers(f"airframe {name!r}{origin}", tables)), ""
    if tables.get("base") is not None:
        inherited_numbers, reason = _inherit(_load(tables["base"], bases), numbers)
        numbers = inherited_numbers | numbers
    airframe = Airframe(name, numbers, reason)
    check_airframe(airframe)
    return airframe


def _inherit(base: Airframe, changes: Mapping[str, NDArray]) -> tuple[dict[str, NDArray[np.float64]], str]:
    base_values = base.values
    changed_paths = [
        path
        for path in BODY_KEYS
        if path in changes and not np.array_equal(changes[path], base_values.get(path, np.nan))
    ]
    lost_tables = [table for table in TUNED_TABLES if table in base.tables]
    if not changed_paths or not lost_tables:
        return dict(base_values), base.not_inherited_reason
    numbers = {path: x for path, x in base_values.items() if path.partition(".")[0] not in TUNED_TABLES}
    ratio_path = "controller.thrust2torque"
    if ratio_path in base_values and not {"rotors.thrust_curve", "rotors.torque_curve"} & set(changes):
        numbers[ratio_path] = base_values[ratio_path]  # it depends on the propellers only
    names = _join_names(f"[{table}]" for table in lost_tables)
    reason = (
        f"Its base {base.name!r} has {names}, which fit another {_join_names(changed_paths)} and are not inherited."
    )
    return numbers, reason


def _join_names(names: Iterable[str]) -> str:
    *first_names, last_name = names
    return f"{', '.join(first_names)} and {last_name}" if first_names else last_name
