"""Voxels of point clouds and triangles, merged into boxes.

Voxel (i, j, k) is the cube whose centre is (i, j, k) times the edge length. A surface at a multiple of the edge length
therefore lies in the middle of its voxels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MAX_CANDIDATES = 1 << 20
"""Largest number of pairs of triangle and voxel that are tested at a time."""
TOLERANCE = 1e-6
"""Length by which voxels are enlarged for triangles, as a fraction of their edge."""


def voxels_of_points(points: NDArray, resolution: float, min_points: int = 1) -> NDArray[np.int64]:
    """Return the voxels that contain points. (n, 3)

    Args:
        points: Points, m. (n_points, 3)
        resolution: Edge of a voxel, m.
        min_points: Number of points that a voxel must contain.
    """
    voxels, counts = np.unique(np.floor(points / resolution + 0.5).astype(np.int64), axis=0, return_counts=True)
    return voxels[counts >= min_points]


def count_candidates(corners: NDArray, resolution: float) -> int:
    """Return the number of voxels that ``voxels_of_triangles`` tests: all voxels of the boxes around the triangles."""
    return int(np.prod(_voxel_range(corners / resolution)[1].astype(np.float64), axis=1).sum())


def _voxel_range(corners: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    first = np.floor(corners.min(axis=1) + 0.5).astype(np.int64)
    return first, np.floor(corners.max(axis=1) + 0.5).astype(np.int64) - first + 1


def voxels_of_triangles(corners: NDArray, resolution: float) -> NDArray[np.int64]:
    """Return the voxels that triangles meet. (n, 3)

    A triangle meets a cube unless one of 13 axes separates them: the normals of both, and the cross products of edges
    of the triangle and edges of the cube (Akenine-Möller 2001, Fast 3D triangle-box overlap testing).

    Args:
        corners: Corners of the triangles, m. (n_triangles, 3, 3)
        resolution: Edge of a voxel, m.
    """
    corners = corners / resolution
    first, size = _voxel_range(corners)
    n_candidates = np.prod(size, axis=1)
    end, voxels_met, start = np.cumsum(n_candidates), [np.zeros((0, 3), np.int64)], 0
    while start < len(corners):
        n_tested = end[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(end, n_tested + MAX_CANDIDATES, side="right")))
        triangle = np.repeat(np.arange(start, stop), n_candidates[start:stop])
        candidate = np.arange(len(triangle)) - np.repeat(
            end[start:stop] - n_candidates[start:stop] - n_tested, n_candidates[start:stop]
        )
        ny, nz = size[triangle, 1], size[triangle, 2]
        voxels = first[triangle] + np.stack([candidate // (ny * nz), candidate // nz % ny, candidate % nz], axis=-1)
        voxels_met.append(np.unique(voxels[_meets_cube(corners[triangle] - voxels[:, None])], axis=0))
        start = stop
    return np.unique(np.concatenate(voxels_met), axis=0)


def _meets_cube(corners: NDArray) -> NDArray[np.bool_]:
    n = len(corners)
    near = np.arange(len(corners))

    def reject(axis: NDArray) -> None:
        nonlocal corners, near
        projections = np.einsum("nkc,nc->nk", corners, axis)
        half_width = np.abs(axis).sum(axis=1) * (0.5 + TOLERANCE) + TOLERANCE
        meets = (projections.min(axis=1) <= half_width) & (projections.max(axis=1) >= -half_width)
        corners, near = corners[meets], near[meets]

    # The normal first: it separates most of them, so that few are left for the other axes.
    reject(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1]))
    for i in range(3):
        for k in range(3):
            reject(np.cross(np.eye(3)[i], corners[:, (k + 1) % 3] - corners[:, k]))
    result = np.zeros(n, bool)
    result[near] = True
    return result


def merge_voxels(voxels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return boxes that fill the same space as voxels without overlap: first and last voxel of each box. (n, 6)

    Neighbouring voxels along a first axis are joined to bars. Neighbouring bars with the same ends are joined along a
    second axis to plates, and neighbouring plates with the same outline to boxes. Of the six orders of axes, the order
    with the fewest boxes is chosen.

    Args:
        voxels: Distinct voxels. (n_voxels, 3)
    """
    unit_boxes = np.concatenate([voxels, voxels], axis=1)
    orders = ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))
    results = []
    for order in orders:
        boxes = unit_boxes
        for axis in order:
            boxes = _merge_along(boxes, axis)
        results.append(boxes)
    return min(results, key=len)


def _merge_along(boxes: NDArray[np.int64], axis: int) -> NDArray[np.int64]:
    other_columns = [k for k in range(6) if k % 3 != axis]
    order = np.lexsort((boxes[:, axis], *boxes[:, other_columns].T))
    boxes = boxes[order]
    is_next = (boxes[1:, other_columns] == boxes[:-1, other_columns]).all(axis=1) & (
        boxes[1:, axis] == boxes[:-1, axis + 3] + 1
    )
    is_first = np.concatenate([[True], ~is_next])
    merged = boxes[is_first]
    merged[:, axis + 3] = boxes[np.concatenate([is_first[1:], [True]]), axis + 3]
    return merged
