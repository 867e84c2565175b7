"""Race tracks in the YAML files of TOGT-Planner, and those of this package by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from crazysim.envs.tracks import Points, Track, rotation_matrices
from crazysim.errors import ConfigError, expect, optional_import, require
from crazysim.storage import MAX_TEXT_BYTES, as_path, is_file, read_text

TRACK_FOLDER = Path(__file__).parent / "race_tracks"
DEFAULT_TRACK = "lsy_drone_racing"
"""Name of ``Track()``."""
ARENA_MARGIN = 5.0
"""Distance of the limits of the arena from gates, start and finish, m. Track files have no limits."""

Shape = Callable[[Mapping[str, Any], float], Points | float]


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
        is_file(path), f"expected a track as one of {', '.join(track_names())}, or a YAML file, got {str(source)!r}."
    )
    with optional_import("race tracks need", "yaml", "racing"):
        import yaml
    try:
        tables = yaml.safe_load(read_text(path, MAX_TEXT_BYTES))
    except yaml.YAMLError as error:
        raise ConfigError(f"expected YAML in {path}, got: {error}. Correct the file.") from error
    try:
        return _read_track(tables)
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(
            f"expected a track of TOGT-Planner in {path}, got {type(error).__name__}: {error}. Compare it with "
            f"{TRACK_FOLDER / 'split_s_gates.yaml'}."
        ) from error


def _read_track(tables: Any) -> Track:
    expect(isinstance(tables, dict) and tables.get("orders"), "a track with gates in 'orders'", tables)
    gates = [tables[name] for name in tables["orders"]]
    for name, gate in zip(tables["orders"], gates, strict=True):
        expect(gate["type"] in _SHAPES, f"gates of types {', '.join(_SHAPES)}", gate["type"])
        try:
            _SHAPES[gate["type"]](gate, 1.0)
        except KeyError as error:
            raise ConfigError(f"expected {error} of the gate {name!r}, got {', '.join(gate)}. Add it.") from error
    shapes = [_SHAPES[gate["type"]] for gate in gates]
    pos = np.array([gate["position"] for gate in gates], float)
    start, finish = (np.array(tables[name]["pos"], float) for name in ("initState", "endState"))
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
        openings=tuple(shape(gate, 1.0) for shape, gate in zip(shapes, gates, strict=True)),
        frames=tuple(shape(gate, 0.0) for shape, gate in zip(shapes, gates, strict=True)),
        lengths=tuple(float(gate.get("length", 0.0)) for gate in gates),
        finish=_as_tuples(finish),
    )


def _as_tuples(x: np.ndarray) -> Any:
    return tuple(map(_as_tuples, x)) if x.ndim > 1 else tuple(x.tolist())


def _ball(gate: Mapping[str, Any], margin: float) -> float:
    return float(gate["radius"] - margin * gate["margin"] / 2)


def _rectangle(gate: Mapping[str, Any], margin: float) -> Points:
    y, z = (gate["width"] - margin * gate["marginW"]) / 2, (gate["height"] - margin * gate["marginH"]) / 2
    return ((y, z), (y, -z), (-y, -z), (-y, z))


def _triangle(gate: Mapping[str, Any], margin: float) -> Points:
    y, z = ((gate[side] - margin * gate["margin"]) / 2 for side in ("width", "height"))
    return ((0.0, z), (y, -z), (-y, -z))


def _regular(radius_key: str, degrees: np.ndarray) -> Shape:
    def corners(gate: Mapping[str, Any], margin: float) -> Points:
        angles, radius = np.deg2rad(degrees), gate[radius_key] - margin * gate["margin"]
        return _as_tuples(radius * np.stack([np.sin(angles), np.cos(angles)], axis=-1))

    return corners


_SHAPES: dict[str, Shape] = {
    "SingleBall": _ball,
    "RectanglePrisma": _rectangle,
    "TrianglePrisma": _triangle,
    "PentagonPrisma": _regular("radius", 72.0 * np.arange(5)),
    "HexagonPrisma": _regular("side", 30.0 + 60.0 * np.arange(6)),
}
"""Function for each type of gate, from its table and the share of its margin that is kept, to its opening."""
