"""Readers of point clouds, triangle meshes and splats: ``.ply``, ``.pcd``, ``.stl`` and ``.obj``, in NumPy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crazysim.errors import ConfigError, require
from crazysim.storage import read_bytes, wrap_read_errors

MAX_FILE_BYTES = 2**32
"""Largest file, bytes. A scene of five million splats has 1.2 GB."""
MAX_HEADER_BYTES = 2**16
"""Largest header of a ``.ply`` or ``.pcd`` file, bytes; usual headers have less than 2,000."""
READ_REMEDY = "Save it again, as .ply, .pcd, .stl or .obj."
"""End of the message about a file that cannot be read."""

PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
"""NumPy's name of each type of a ``.ply`` file."""
Columns = dict[str, Any]
"""Properties of an element by name: arrays with an entry per row, or lists with an array per row."""
PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
"""NumPy's byte order of each binary ``.ply`` format."""


class MapFile(NamedTuple):
    """Contents of a point cloud or a mesh."""

    points: NDArray[np.float64]
    """Points of a cloud, or vertices of a mesh, in the units of the file. (n_points, 3)"""
    triangles: NDArray[np.int64] | None
    """Triangles of a mesh, as indices of its vertices; None for a point cloud. (n_triangles, 3)"""


def read_map(path: str | Path) -> MapFile:
    """Return the contents of a point cloud or a mesh.

    Args:
        path: A ``.ply``, ``.pcd``, ``.stl`` or ``.obj`` file.

    Raises:
        DamagedFileError: If the file is damaged, cut off, or of another kind.
    """
    reader = MAP_READERS.get(Path(path).suffix.lower())
    if reader is None:
        raise ConfigError(f"expected a file {', '.join(MAP_READERS)}, got {str(path)!r}. Convert it to one of these.")
    with wrap_read_errors(path, "a point cloud or mesh", READ_REMEDY):
        points, triangles = reader(read_bytes(path, MAX_FILE_BYTES))
        points = np.asarray(points, np.float64).reshape(-1, 3)
        if triangles is not None:
            triangles = np.asarray(triangles, np.int64).reshape(-1, 3)
            if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(points):
                raise ValueError(
                    f"expected triangles of {len(points)} vertices, got {triangles.min()} to {triangles.max()}"
                )
    require(len(points), f"expected points, got {str(path)!r}, which has none. {READ_REMEDY}")
    return MapFile(points, triangles if triangles is not None and len(triangles) else None)


def read_ply(content: bytes) -> dict[str, Columns]:
    """Return the properties of each element of a ``.ply`` file, by the names of element and property.

    A list property is an array (n, n_entries), or a list of arrays if its entries differ in number.

    Raises:
        ValueError: If the file is damaged, cut off, or of another kind.
    """
    header, body = _split_header(content, b"end_header")
    require(header and header[0] == ["ply"], "expected 'ply' in the first line", ValueError)
    layout, elements = "", []
    for line in header[1:]:
        if line[0] == "format":
            layout = line[1]
        elif line[0] == "element":
            elements.append((line[1], _parse_count(line[2]), []))
        elif line[0] == "property":
            elements[-1][2].append((line[-1], *(PLY_TYPES[kind] for kind in line[1:-1] if kind != "list")))
    if layout == "ascii":
        table = _AsciiTable(body)
    elif layout in PLY_ORDERS:
        table = _BinaryTable(body, PLY_ORDERS[layout])
    else:
        raise ValueError(f"expected format ascii or {' or '.join(PLY_ORDERS)}, got {layout[:30]!r}")
    return {name: table.read(count, properties) for name, count, properties in elements}


def _read_ply_map(content: bytes) -> tuple[NDArray, NDArray | None]:
    elements = read_ply(content)
    vertex, face = elements["vertex"], elements.get("face", {})
    points = np.stack([vertex[axis] for axis in "xyz"], axis=-1)
    polygons = face.get("vertex_indices", face.get("vertex_index"))
    return points, None if polygons is None else _triangulate(polygons)


def _read_pcd(content: bytes) -> tuple[NDArray, None]:
    header, body = _split_header(content, b"DATA")
    table = {line[0]: line[1:] for line in header if not line[0].startswith("#")}
    n, layout = _parse_count(table["POINTS"][0]), table["DATA"][0]
    counts = [_parse_count(x) for x in table.get("COUNT", ["1"] * len(table["FIELDS"]))]
    kinds = [t.lower() + size for t, size in zip(table["TYPE"], table["SIZE"], strict=True)]
    fields = [
        (name, f"<{kind}", (count,))
        for name, kind, count in zip(_number_padding_columns(table["FIELDS"]), kinds, counts, strict=True)
    ]
    if layout == "binary":
        values = np.frombuffer(body, np.dtype(fields), n)
        points = np.stack([values[axis][:, 0] for axis in "xyz"], axis=-1)
    elif layout == "ascii":
        rows = _parse_numbers(body.split(), n * sum(counts)).reshape(n, -1)
        first_columns = dict(zip([name for name, *_ in fields], np.cumsum([0, *counts]), strict=False))
        points = rows[:, [first_columns[axis] for axis in "xyz"]]
    else:
        raise ConfigError(f"expected DATA ascii or binary in a .pcd file, got {layout[:30]!r}. Save it as binary.")
    return points[np.isfinite(points).all(axis=1)], None


def _read_stl(content: bytes) -> tuple[NDArray, NDArray]:
    n = int.from_bytes(content[80:84], "little")
    if len(content) == 84 + 50 * n and n:
        rows = np.frombuffer(content, np.dtype([("normal", "<f4", 3), ("corners", "<f4", 9), ("rest", "<u2")]), n, 84)
        corners = rows["corners"].reshape(-1, 3)
    elif content.lstrip()[:5].lower() == b"solid" and b"endsolid" in content:
        lines = [line.split() for line in content.lower().splitlines()]
        corners = np.array([line[1:4] for line in lines if line[:1] == [b"vertex"]], np.float64)
    else:
        raise ValueError(f"expected {84 + 50 * n} bytes for {n} triangles, got {len(content)}")
    return corners, np.arange(len(corners)).reshape(-1, 3)


def _read_obj(content: bytes) -> tuple[NDArray, NDArray | None]:
    vertices, polygons = [], []
    for line in content.decode("utf-8", "replace").splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            vertices.append([float(x) for x in words[:3]])
        elif kind == "f":
            numbers = [int(x.partition("/")[0]) for x in words]
            polygons.append(np.array([k - 1 if k > 0 else len(vertices) + k for k in numbers]))
    return np.array(vertices), _triangulate(polygons) if polygons else None


MAP_READERS: dict[str, Callable[[bytes], tuple[NDArray, NDArray | None]]] = {
    ".ply": _read_ply_map,
    ".pcd": _read_pcd,
    ".stl": _read_stl,
    ".obj": _read_obj,
}
"""Reader of each kind of file, by its suffix."""


def _split_header(content: bytes, last_keyword: bytes) -> tuple[list[list[str]], bytes]:
    lines, start = [], 0
    while start < min(len(content), MAX_HEADER_BYTES):
        end = content.find(b"\n", start)
        if end < 0:
            break
        line = content[start:end].strip()
        start = end + 1
        if line:
            lines.append(line.decode("ascii").split())
        if line.startswith(last_keyword):
            return lines, content[start:]
    raise ValueError(f"expected a header that ends with a line {last_keyword.decode()!r}")


def _parse_count(number: str | int) -> int:
    n = int(number)
    require(n >= 0, f"expected a number of entries, got {n}", ValueError)
    return n


def _number_padding_columns(names: list[str]) -> list[str]:
    return [f"{name}{k}" if name == "_" else name for k, name in enumerate(names)]


def _parse_numbers(words: list[bytes], n: int) -> NDArray[np.float64]:
    require(len(words) >= n, f"expected {n} numbers, got {len(words)}", ValueError)
    return np.array(words[:n], np.float64)


def _triangulate(polygons: NDArray | list[NDArray]) -> NDArray[np.int64]:
    if isinstance(polygons, np.ndarray):
        polygons = list(polygons[None].astype(np.int64)) if polygons.size else []
    else:
        by_size = {n: [p for p in polygons if len(p) == n] for n in {len(p) for p in polygons}}
        polygons = [np.array(group, np.int64) for group in by_size.values()]
    fans = [group[:, [0, k, k + 1]] for group in polygons for k in range(1, group.shape[1] - 1)]
    return np.concatenate([np.zeros((0, 3), np.int64), *fans])


Property = tuple[str, ...]
"""Name and type of a property; for a list, its name, the type of its length, and the type of its entries."""


class _AsciiTable:
    """Rows of numbers in text, read from the first to the last."""

    def __init__(self, body: bytes):
        self._words, self._position = body.split(), 0

    def read(self, n: int, properties: list[Property]) -> Columns:
        if all(len(p) == 2 for p in properties):
            rows = _parse_numbers(
                self._words[self._position : self._position + n * len(properties)], n * len(properties)
            )
            self._position += n * len(properties)
            return {p[0]: column for p, column in zip(properties, rows.reshape(n, len(properties)).T, strict=True)}
        return _join_columns(properties, [[self._read_entry(p) for p in properties] for _ in range(n)])

    def _read_entry(self, p: Property) -> NDArray:
        n = 1 if len(p) == 2 else _parse_count(self._take_words(1)[0].decode())
        return _parse_numbers(self._take_words(n), n)

    def _take_words(self, n: int) -> list[bytes]:
        words = self._words[self._position : self._position + n]
        require(len(words) >= n, f"expected {n} numbers, got {len(words)}", ValueError)
        self._position += n
        return words


class _BinaryTable:
    """Rows of numbers in bytes, read from the first to the last."""

    def __init__(self, body: bytes, order: str):
        self._body, self._order, self._position = body, order, 0

    def read(self, n: int, properties: list[Property]) -> Columns:
        if n and any(len(p) == 3 for p in properties):
            return self._read_lists(n, properties)
        return self._read_rows(n, [(p[0], self._order + p[1]) for p in properties])

    def _read_rows(self, n: int, fields: list[tuple]) -> dict[str, NDArray]:
        rows = np.frombuffer(self._body, np.dtype(fields), n, self._position)
        self._position += rows.nbytes
        return {name: rows[name] for name in rows.dtype.names or ()}

    def _read_lists(self, n: int, properties: list[Property]) -> Columns:
        start, fields = self._position, []
        lengths = {p[0]: len(self._read_entry(p)) for p in properties}
        for p in properties:
            if len(p) == 3:
                fields.append((f"length of {p[0]}", self._order + p[1]))
            fields.append((p[0], self._order + p[-1], lengths[p[0]] if len(p) == 3 else ()))
        self._position = start
        if start + n * np.dtype(fields).itemsize <= len(self._body):
            table = self._read_rows(n, fields)
            if all((table[f"length of {p[0]}"] == lengths[p[0]]).all() for p in properties if len(p) == 3):
                return table
        self._position = start
        return _join_columns(properties, [[self._read_entry(p) for p in properties] for _ in range(n)])

    def _read_entry(self, p: Property) -> NDArray:
        n = 1 if len(p) == 2 else self._read_rows(1, [("n", self._order + p[1])])["n"][0]
        return self._read_rows(_parse_count(n), [("x", self._order + p[-1])])["x"]


def _join_columns(properties: list[Property], rows: list[list[NDArray]]) -> Columns:
    columns = {p[0]: [row[k] for row in rows] for k, p in enumerate(properties)}
    return {
        p[0]: np.concatenate(columns[p[0]]) if len(p) == 2
        else np.array(columns[p[0]]) if len({len(x) for x in columns[p[0]]}) <= 1
        else columns[p[0]]
        for p in properties
    }  # fmt: skip
