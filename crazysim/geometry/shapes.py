"""Shapes of drones and obstacles, as compile-time constants."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from crazysim.arguments import check_arguments
from crazysim.errors import ConfigError, require
from crazysim.tables import MAX_NUMBER, read_floats

N_SIZES = {"plane": 0, "sphere": 1, "capsule": 2, "box": 3, "cylinder": 2, "ellipsoid": 3, "mesh": 0, "hfield": 4,
           "rectangle": 2}  # fmt: skip
"""Number of entries of ``Shape.size`` for each kind."""
MAX_HULL_VERTICES = 64
"""Largest number of vertices for which ``hull`` computes the convex hull; it tries every triangle."""
UNBOUNDED_LENGTH = 1e18
"""Half length of unbounded shapes in ``bounding_box``, m; float32 can hold its square."""


@dataclasses.dataclass(frozen=True, eq=False)
class Shape:
    """Solid in its own frame. It is static for JAX: compared and hashed by content, and a new one recompiles.

    Sizes follow MuJoCo, half lengths in m:

    - ``plane``: none; the half space below z = 0.
    - ``rectangle``: half lengths along x and y, of a part of the plane z = 0, for rays only.
    - ``sphere``: radius.
    - ``capsule``, ``cylinder``: radius, half length along the axis z, which excludes the caps of a capsule.
    - ``box``: half lengths along x, y and z.
    - ``ellipsoid``: semi-axes along x, y and z.
    - ``mesh``: none; the convex hull of its vertices. Made by ``hull``.
    - ``hfield``: half extents along x and y, largest height, depth of the ground below z = 0. Made by ``hfield``.
    """

    kind: str
    """Kind of the shape, a key of ``N_SIZES``."""
    size: tuple[float, ...] = ()
    """Size in the convention of the kind, m; further entries, as in MuJoCo's ``geom_size``, are ignored."""
    vertices: np.ndarray | None = None
    """Vertices of the convex hull of a mesh, m. (n_vertices, 3)"""
    faces: np.ndarray | None = None
    """Triangles of the hull as indices of vertices, counter-clockwise from outside. (n_faces, 3)"""
    normals: np.ndarray | None = None
    """Distinct unit outward normals of the planes of the hull. (n_planes, 3)"""
    offsets: np.ndarray | None = None
    """Distances of these planes from the origin along their normals, m. (n_planes,)"""
    triangles: np.ndarray | None = None
    """Triangles of a mesh with a texture that has coordinates: three corners, m, then u and v at each. (n, 15)"""
    heights: np.ndarray | None = None
    """Heights of a height field, rows along y and columns along x, m. (n_rows, n_columns)"""

    def __post_init__(self) -> None:
        require(
            isinstance(self.kind, str) and self.kind in N_SIZES,
            f"expected a shape of kind {', '.join(N_SIZES)}, got {self.kind!r}; use one of these",
        )
        n_sizes = N_SIZES[self.kind]
        numbers = read_floats("size", self.size).reshape(-1)
        size = numbers[:n_sizes]
        if len(size) < n_sizes or not np.all(np.isfinite(size)) or not np.all(size > 0):
            raise ConfigError(
                f"expected {n_sizes} positive, finite numbers as the size of a {self.kind}, m, got "
                f"{tuple(numbers.tolist())}; use MuJoCo's conventions"
            )
        for name, kind, maker in (("vertices", "mesh", "hull"), ("heights", "hfield", "hfield")):
            require(
                self.kind != kind or getattr(self, name) is not None,
                f"expected a {kind} with {name}, got none; make it with geometry.{maker}",
            )
        object.__setattr__(self, "size", tuple(size.tolist()))

    def array(self, name: str) -> np.ndarray:
        """Return an array of the shape by name."""
        values = getattr(self, name)
        require(values is not None, f"expected a shape with {name}, got a {self.kind}, which has none", TypeError)
        return values

    def _content(self) -> tuple[object, ...]:
        arrays = (self.vertices, self.faces, self.normals, self.offsets, self.triangles, self.heights)
        return (self.kind, self.size, *(None if a is None else (a.shape, a.tobytes()) for a in arrays))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Shape) and self._content() == other._content()

    def __hash__(self) -> int:
        return hash(self._content())


@check_arguments
def hull(vertices: ArrayLike, faces: ArrayLike | None = None) -> Shape:
    """Make a convex mesh.

    Args:
        vertices: Vertices, m. (n_vertices, 3)
        faces: Triangles of the convex hull as indices of vertices, in any orientation, as in a compiled MuJoCo model.
            None computes the hull, for up to 64 vertices. (n_faces, 3)
    """
    v = np.asarray(vertices, np.float64)
    require(
        v.ndim == 2 and v.shape[1] == 3 and len(v) >= 4 and np.all(np.abs(v) <= MAX_NUMBER),
        f"expected four or more finite vertices, (n_vertices, 3), of a size up to {MAX_NUMBER:g} m, got {v.shape}",
    )
    scale = float(np.max(np.ptp(v, axis=0)))
    thickness = np.linalg.svd(v - v.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(v))
    if thickness <= max(1e-9 * scale, 1 / MAX_NUMBER):
        raise ConfigError(f"expected vertices that span a volume, got {len(v)} in one plane; add one outside of it")
    triangles = _find_triangles(v, 1e-9 * scale) if faces is None else np.asarray(faces)
    require(
        triangles.ndim == 2 and triangles.shape[1] == 3 and triangles.dtype.kind in "iu",
        f"expected faces as integers, (n_faces, 3), got {triangles.dtype} {triangles.shape}",
    )
    if triangles.min() < 0 or triangles.max() >= len(v):
        raise ConfigError(f"expected faces of vertices 0 to {len(v) - 1}, got {triangles.min()} to {triangles.max()}")
    a, b, c = (v[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1)
    # A sliver has no normal; its neighbours close the hull.
    is_valid = area > 1e-12 * scale * scale
    triangles, normals = triangles[is_valid], normals[is_valid] / area[is_valid, None]
    is_outward = np.sum(normals * (v[triangles[:, 0]] - v.mean(axis=0)), axis=1) > 0
    normals = np.where(is_outward[:, None], normals, -normals)
    triangles = np.where(is_outward[:, None], triangles, triangles[:, ::-1])
    offsets = np.sum(normals * v[triangles[:, 0]], axis=1)
    gap = float(np.max(v @ normals.T - offsets)) if len(offsets) else np.inf
    if gap > 1e-4 * scale or (is_valid.all() and not _is_closed(triangles)):
        raise ConfigError(
            f"expected the triangles of the convex hull, got faces that are not closed or leave a vertex {gap:.3g} m "
            f"outside; omit faces for up to {MAX_HULL_VERTICES} vertices, and they are computed"
        )
    # Coplanar triangles share a plane through the outermost vertex, so that all vertices are inside.
    plane_normals = _unique_normals(normals)
    offsets = np.max(v @ plane_normals.T, axis=0)
    used_vertices, indices = np.unique(triangles, return_inverse=True)
    return Shape("mesh", (), *map(_read_only_copy, (v[used_vertices], indices.reshape(-1, 3), plane_normals, offsets)))


@check_arguments
def hfield(heights: ArrayLike, size: Sequence[float]) -> Shape:
    """Make the ground below a surface of triangles over a rectangular grid, two per cell.

    As in MuJoCo, the diagonal of a cell joins its corners of smallest and of largest x and y.

    Args:
        heights: Heights of the surface, rows along y and columns along x, m. (n_rows, n_columns)
        size: Half extents along x and y, largest height, depth of the ground below z = 0, m. (4,)
    """
    h = np.asarray(heights, np.float64)
    require(h.ndim == 2 and min(h.shape) >= 2, f"expected heights of two or more rows and columns, got shape {h.shape}")
    shape = Shape("hfield", tuple(np.ravel(size)), heights=_read_only_copy(h))
    if not np.all(np.isfinite(h)) or h.min() < 0 or h.max() > shape.size[2] * (1 + 1e-6):
        raise ConfigError(f"expected heights between 0 and {shape.size[2]} m, got {h.min()} to {h.max()}")
    return shape


def bounding_box(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Return centre and half lengths of the box around a shape, along the axes of its frame, m. (3,) each"""
    size = shape.size
    match shape.kind:
        case "mesh" | "hfield":
            if shape.kind == "mesh":
                low, high = shape.array("vertices").min(axis=0), shape.array("vertices").max(axis=0)
            else:
                x, y, _, base = size
                low, high = np.array([-x, -y, -base]), np.array([x, y, max(0.0, float(shape.array("heights").max()))])
            return (low + high) / 2, (high - low) / 2
        case "plane":
            half = [UNBOUNDED_LENGTH] * 3
        case "rectangle":
            half = [*size, 0.0]
        case "sphere":
            half = [size[0]] * 3
        case "capsule":
            half = [size[0], size[0], size[0] + size[1]]
        case "cylinder":
            half = [size[0], size[0], size[1]]
        case _:
            half = list(size)
    return np.zeros(3), np.array(half)


def _find_triangles(v: np.ndarray, tolerance: float) -> np.ndarray:
    require(
        len(v) <= MAX_HULL_VERTICES,
        f"expected faces for more than {MAX_HULL_VERTICES} vertices, got {len(v)} vertices and no faces; pass the "
        f"triangles of the convex hull",
    )
    i, j, k = np.array([(i, j, k) for i in range(len(v)) for j in range(i) for k in range(j)]).T
    normals = np.cross(v[j] - v[i], v[k] - v[i])
    length = np.linalg.norm(normals, axis=1)
    is_flat = length <= tolerance * np.max(np.ptp(v, axis=0))
    normals = normals / np.where(is_flat, 1.0, length)[:, None]
    heights = v @ normals.T - np.sum(normals * v[i], axis=1)
    is_above, is_below = heights.min(axis=0) >= -tolerance, heights.max(axis=0) <= tolerance
    outward_normals = (
        normals[(is_above | is_below) & ~is_flat]
        * np.where(is_above[(is_above | is_below) & ~is_flat], -1.0, 1.0)[:, None]
    )
    triangles: list[tuple[int, int, int]] = []
    for normal in _unique_normals(outward_normals):
        heights_along = v @ normal
        side_vertices = np.flatnonzero(heights_along >= heights_along.max() - 2 * tolerance)
        axis = np.eye(3)[np.argmin(np.abs(normal))]
        x = np.cross(normal, axis)
        offsets = v[side_vertices] - v[side_vertices].mean(axis=0)
        angle = np.arctan2(offsets @ np.cross(normal, x), offsets @ x)
        side_vertices = side_vertices[np.argsort(angle)]
        triangles += [
            (side_vertices[0], side_vertices[n], side_vertices[n + 1]) for n in range(1, len(side_vertices) - 1)
        ]
    return np.array(triangles, np.int64).reshape(-1, 3)


def _is_closed(triangles: np.ndarray) -> bool:
    edges = {(t[k], t[(k + 1) % 3]) for t in triangles.tolist() for k in range(3)}
    return len(edges) == 3 * len(triangles) and all((b, a) in edges for a, b in edges)


def _unique_normals(normals: np.ndarray) -> np.ndarray:
    unique: list[np.ndarray] = []
    for n in normals:
        if not unique or np.min(np.linalg.norm(np.asarray(unique) - n, axis=1)) > 1e-6:
            unique.append(n)
    return np.asarray(unique).reshape(-1, 3)


def _read_only_copy(x: np.ndarray) -> np.ndarray:
    x = np.array(x)
    x.setflags(write=False)
    return x
