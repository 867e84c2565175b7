"""Race tracks in the YAML files of TOGT-Planner, and those of this package by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from crazysim.envs.tracks import Points, Track, rotation_matrices
from crazysim.errors import ConfigError, expect, optional_import, require
from crazysim.storage import MAX_TEXT_BYTES, as_path, is_file, read_text
from crazysim.tables import ANY_NUMBER, COORDINATE, LENGTH, LENGTH_OR_ZERO, read_numbers

TRACK_FOLDER = Path(__file__).parent / "race_tracks"
DEFAULT_TRACK = "lsy_drone_racing"
"""Name of ``Track()``."""
ARENA_MARGIN = 5.0
"""Distance of the limits of the arena from gates, start and finish, m. Track files have no limits."""
UNUSED_KEYS = ("name", "midpoints", "stationary")
"""Keys of gates in TOGT-Planner's files that change no flight here."""


def track_names() -> tuple[str, ...]:
    """Return the names of the built-in tracks."""
    return (DEFAULT_TRACK, *sorted(path.stem for path in TRACK_FOLDER.glob("*.yaml")))


def load_track(source: str | Path) -> Track:
    """Load a race track by its name, or from a YAML file in the format of TOGT-Planner.

    The file names the gates in the order of the race (``orders``), and has their types, positions, m, and ``rpy``,
    degrees. Types are ``SingleBall``, and prisms of a rectangle, a triangle, a pentagon or a hexagon, such as
    ``RectanglePrisma``. A drone flies through a prism against the z axis of its ``rpy``. The flight starts at
    ``initState`` and ends at ``endState``.

    Raises:
        ConfigError: If there is no such track, or the file is no track.
    """
    if str(source) == DEFAULT_TRACK:
        return Track()
    path = TRACK_FOLDER / f"{source}.yaml" if str(source) in track_names() else as_path(source)
    require(
        is_file(path),
        f"expected a track as one of {', '.join(track_names())}, or a YAML file, got {str(source)!r}: no file.",
    )
    with optional_import("race tracks need", "yaml", "racing"):
        import yaml
    text = read_text(path, MAX_TEXT_BYTES)
    try:
        tables = yaml.safe_load(text)
    except (yaml.YAMLError, ArithmeticError, RecursionError, ValueError) as error:  # wrong dates, for example
        raise ConfigError(f"expected YAML in {path}, got: {error}. Correct the file.") from error
    return _read_track(tables, path.name)


def _read_track(tables: Any, owner: str) -> Track:
    orders = tables.get("orders") if isinstance(tables, dict) else None
    is_list = isinstance(orders, list) and bool(orders) and all(isinstance(name, (str, int)) for name in orders)
    expect(is_list, f"{owner} with the names of gates in 'orders'", tables if orders is None else orders)
    gates = [_read_gate(name, tables, owner) for name in orders]
    pos = np.array([gate["position"] for gate in gates])
    start, finish = (
        read_numbers(f"pos of {name}", _table(name, tables, owner).get("pos"), COORDINATE, ((3,),), owner=owner)
        for name in ("initState", "endState")
    )
    # Balls have no direction: they get that of the way past them.
    way = np.concatenate([[start], pos, [finish]])
    yaw = np.degrees(np.arctan2(*(way[2:] - way[:-2])[:, 1::-1].T))
    rot = rotation_matrices(np.deg2rad([gate.get("rpy", (0, -90, y)) for gate, y in zip(gates, yaw, strict=True)]))
    # Our gates lie in the y-z plane, with x ahead and z up; theirs in the x-y plane, with x up and z backwards.
    x, y, z = -rot[..., 2], rot[..., 1], rot[..., 0]
    rpy = np.stack([np.arctan2(y[:, 2], z[:, 2]), -np.arcsin(x[:, 2].clip(-1, 1)), np.arctan2(x[:, 1], x[:, 0])], -1)
    points = np.concatenate([pos, [start, finish]])
    low, high = points.min(axis=0) - ARENA_MARGIN, points.max(axis=0) + ARENA_MARGIN
    return Track(
        gates_pos=_as_tuples(pos),
        gates_rpy=_as_tuples(rpy),
        obstacles_pos=(),
        start=_as_tuples(start),
        low=(*low[:2].tolist(), 0.0),
        high=_as_tuples(high),
        openings=tuple(gate["opening"] for gate in gates),
        frames=tuple(gate["frame"] for gate in gates),
        lengths=tuple(float(gate.get("length", 0.0)) for gate in gates),
        finish=_as_tuples(finish),
    )


def _table(name: Any, tables: Mapping[Any, Any], owner: str) -> Mapping[str, Any]:
    expect(isinstance(tables.get(name), dict), f"{name!r} in {owner} as a table", tables.get(name, list(tables)))
    return tables[name]


def _read_gate(name: Any, tables: Mapping[Any, Any], owner: str) -> dict[str, Any]:
    # Checked numbers of a gate by their keys, its opening, and the inner edge of its frame.
    table = _table(name, tables, owner)
    kind: Any = table.get("type")
    expect(isinstance(kind, str) and kind in _SHAPES, f"{name!r} in {owner} of type {', '.join(_SHAPES)}", kind)
    shape = _SHAPES[kind]
    margins = dict.fromkeys(shape.margins.values(), LENGTH_OR_ZERO)
    keys = {"position": COORDINATE} | dict.fromkeys(shape.margins, LENGTH) | margins
    optional = {"rpy": ANY_NUMBER, "length": LENGTH_OR_ZERO} if kind.endswith("Prisma") else {}
    got = set(table) - {"type", *optional, *UNUSED_KEYS}
    wrong = ", ".join(map(str, got - set(keys))) or "fewer"
    require(
        got == set(keys),
        f"expected the keys {', '.join(['type', *keys])} of {name!r} in {owner}, got {wrong}. Correct the keys.",
    )
    values = {
        key: read_numbers(
            f"{key} of {name!r}", table[key], allowed, ((3,),) if key in ("position", "rpy") else ((),), owner=owner
        )
        for key, allowed in (keys | optional).items()
        if key in table
    }
    sizes = [(float(values[size]), shape.share * float(values[margin])) for size, margin in shape.margins.items()]
    for size, (full, margin) in zip(shape.margins, sizes, strict=True):
        expect(margin < full, f"a margin of {name!r} in {owner} that leaves an opening", f"{size}: {full - margin:g}")
    frame, opening = (shape.corners(*(full - kept * margin for full, margin in sizes)) for kept in (0.0, 1.0))
    return values | {"frame": frame, "opening": opening}


def _as_tuples(x: np.ndarray) -> Any:
    return tuple(map(_as_tuples, x)) if x.ndim > 1 else tuple(x.tolist())


def _rectangle(width: float, height: float) -> Points:
    y, z = width / 2, height / 2
    return ((y, z), (y, -z), (-y, -z), (-y, z))


def _triangle(width: float, height: float) -> Points:
    y, z = width / 2, height / 2
    return ((0.0, z), (y, -z), (-y, -z))


def _regular(degrees: np.ndarray) -> Callable[[float], Points]:
    angles = np.deg2rad(degrees)
    return lambda radius: _as_tuples(radius * np.stack([np.sin(angles), np.cos(angles)], axis=-1))


class _Shape(NamedTuple):
    corners: Callable[..., Points | float]  # opening of a gate with these sizes
    margins: dict[str, str]  # key of the margin of each size
    share: float = 1.0  # of the margin that the size loses


_SHAPES = {
    "SingleBall": _Shape(float, {"radius": "margin"}, 0.5),
    "RectanglePrisma": _Shape(_rectangle, {"width": "marginW", "height": "marginH"}),
    "TrianglePrisma": _Shape(_triangle, {"width": "margin", "height": "margin"}),
    "PentagonPrisma": _Shape(_regular(72.0 * np.arange(5)), {"radius": "margin"}),
    "HexagonPrisma": _Shape(_regular(30.0 + 60.0 * np.arange(6)), {"side": "margin"}),
}
