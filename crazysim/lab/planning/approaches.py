"""Closest approach of every pair of drones, with a bound of the error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from crazysim.lab.planning.piece_table import Floats, Ints, PieceTable
from crazysim.trajectories.bezier import bernstein_matrix

CELL_DURATION = 0.4
"""Length of the cells at the start of the search, s. A cell is an interval of time in the flight of one pair."""
N_SPLITS = 4
"""Number of cells into which a cell is split."""
CELLS_PER_BATCH = 500_000
"""Largest number of cells that are examined at once; it bounds the memory."""
MAX_TABLE_CELLS = 4_000_000
"""Largest number of cells of all drones for which the motion of each drone is tabulated; otherwise it is computed for
each pair."""
MIN_CELL_DURATION = 1e-6
"""Length below which the search ends, s. Only cells in which a position jumps become so short."""


@dataclass(frozen=True)
class Approach:
    """Closest approach of two drones."""

    drones: tuple[int, int]
    """Indices of the drones, ascending."""
    distance: float
    """Distance between their positions, m."""
    time: float
    """Time of the closest approach, s."""


def closest_approaches(pieces: PieceTable, tolerance: float = 1e-3) -> list[Approach]:
    """Return the closest approach of every pair, nearest pair first.

    In a cell, the relative motion deviates from its chord by at most ``dt^2 / 8`` times its largest acceleration, plus
    ``dt / 4`` times the jumps of the velocity, plus the jumps of the position. The distance to the chord minus this
    bound is a lower bound of the distance. If it is less than the pair's smallest distance so far minus the tolerance,
    the cell is split; otherwise it is dropped. The relative acceleration is bounded by acceleration and jerk in the
    middle of the cell and the largest snaps, so that drones in formation need no short cells.

    Args:
        tolerance: Largest error of a distance, m. Distances are never too small: they are evaluated at ``time``.
    """
    n = pieces.n_drones
    first, second = np.triu_indices(n, 1)
    if not len(first):
        return []
    min_distances, closest_times = np.full(len(first), np.inf), np.zeros(len(first))
    n_cells = int(np.ceil(pieces.duration / CELL_DURATION))
    dt, motion = pieces.duration / n_cells, _Motion(pieces)
    pair, cell = np.repeat(np.arange(len(first)), n_cells), np.tile(np.arange(n_cells), len(first))
    while len(pair) and dt > MIN_CELL_DURATION:
        uses_table = n_cells * pieces.n_drones <= min(MAX_TABLE_CELLS, len(pair))
        motion_table = motion.tabulate(n_cells, dt) if uses_table else None
        is_kept = np.zeros(len(pair), bool)
        for k in range(0, len(pair), CELLS_PER_BATCH):
            part = slice(k, k + CELLS_PER_BATCH)
            i, j = first[pair[part]], second[pair[part]]
            motion_i, motion_j = (motion.motion_in_cells(drone, cell[part], dt, motion_table) for drone in (i, j))
            lower_bound = _lower_bounds(
                pieces, motion_i, motion_j, (i, j), pair[part], cell[part], dt, min_distances, closest_times
            )
            is_kept[part] = lower_bound < min_distances[pair[part]] - tolerance
        pair, cell = (
            np.repeat(pair[is_kept], N_SPLITS),
            (cell[is_kept][:, None] * N_SPLITS + np.arange(N_SPLITS)).ravel(),
        )
        dt, n_cells = dt / N_SPLITS, n_cells * N_SPLITS
    order = np.argsort(min_distances, kind="stable")
    return [Approach((int(first[k]), int(second[k])), float(min_distances[k]), float(closest_times[k])) for k in order]


class _Motion:
    """Motion of single drones in cells: positions at both ends, derivatives in the middle, and a bound."""

    def __init__(self, pieces: PieceTable) -> None:
        self.pieces = pieces
        snap = pieces.derivative_coefficients(4)[:, :3]
        control_points = snap @ bernstein_matrix(snap.shape[-1] - 1).T  # a polynomial lies in their convex hull
        # Cumulative sum over the pieces of an upper bound of the snap in each piece.
        self.summed_snaps = np.cumsum(np.max(np.linalg.norm(control_points, axis=1), axis=-1))
        # Jumps of the derivatives of orders 0 to 3 from the previous piece to each piece.
        jumps = np.zeros((4, len(pieces.drone)))
        piece = np.flatnonzero(pieces.drone[1:] == pieces.drone[:-1])
        for order in range(4):
            end_values = pieces.evaluate_pieces(piece, np.ones(len(piece)), order)
            start_values = pieces.evaluate_pieces(piece + 1, np.zeros(len(piece)), order)
            jumps[order, piece + 1] = np.linalg.norm((start_values - end_values)[:, :3], axis=-1)
        self.summed_jumps = np.cumsum(jumps, axis=1)

    def tabulate(self, n_cells: int, dt: float) -> tuple[Floats, ...]:
        # (n_drones, n_cells, ...)
        return self.motion_in_cells(np.arange(self.pieces.n_drones)[:, None], np.arange(n_cells), dt, None)

    def motion_in_cells(
        self, drone: Ints, cell: Ints, dt: float, motion_table: tuple[Floats, ...] | None
    ) -> tuple[Floats, ...]:
        """Return positions at start and end, acceleration and jerk in the middle (..., 3), and a bound (...), per cell.

        The bound, m, is for the part of the deviation from the chord that is due to snap and jumps.
        """
        if motion_table is not None:
            return tuple(x[drone, cell] for x in motion_table)
        drone, cell = np.broadcast_arrays(drone, cell)
        start, end = cell * dt, (cell + 1) * dt
        a, b = self.pieces.find_pieces(drone, start), self.pieces.find_pieces(drone, end)
        summed_jumps = self.summed_jumps[:, b] - self.summed_jumps[:, a]
        # The sum over all pieces in the cell is at least the largest snap.
        snap = self.summed_snaps[b] - np.where(a > 0, self.summed_snaps[a - 1], 0.0)
        acc_change = dt / 2 * (dt / 2 * snap + summed_jumps[3]) + summed_jumps[2]
        bound = dt**2 / 8 * acc_change + dt / 4 * summed_jumps[1] + summed_jumps[0]
        times = ((start, 0), (end, 0), (start + dt / 2, 2), (start + dt / 2, 3))
        return *(self.pieces.evaluate(drone, t, order)[..., :3] for t, order in times), bound


def _lower_bounds(
    pieces: PieceTable,
    motion_i: tuple[Floats, ...],
    motion_j: tuple[Floats, ...],
    drones: tuple[Ints, Ints],
    pair: Ints,
    cell: Ints,
    dt: float,
    min_distances: Floats,
    closest_times: Floats,
) -> Floats:
    start, end, acc, jerk = (a - b for a, b in zip(motion_i[:4], motion_j[:4], strict=True))
    deviation = dt**2 / 8 * (_norm(acc) + dt / 2 * _norm(jerk)) + motion_i[4] + motion_j[4]
    step = end - start
    square = _dot(step, step)
    u = np.clip(-_dot(start, step) / np.where(square > 0, square, 1.0), 0.0, 1.0)
    chord_distance = _norm(start + u[:, None] * step)

    # The distance is evaluated only in the cell of each pair with the nearest chord.
    order = np.lexsort((chord_distance, pair))
    k = order[np.unique(pair[order], return_index=True)[1]]
    t = (cell[k] + u[k]) * dt
    distance = _norm((pieces.evaluate(drones[0][k], t) - pieces.evaluate(drones[1][k], t))[:, :3])
    is_closer = distance < min_distances[pair[k]]
    min_distances[pair[k[is_closer]]], closest_times[pair[k[is_closer]]] = distance[is_closer], t[is_closer]
    return chord_distance - deviation


def _dot(a: Floats, b: Floats) -> Floats:
    return np.einsum("...i,...i->...", a, b)


def _norm(a: Floats) -> Floats:
    return np.sqrt(_dot(a, a))
