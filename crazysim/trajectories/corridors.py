"""Minimum-derivative polynomials that stay near the straight lines between their waypoints."""

from __future__ import annotations

import numpy as np

from crazysim.errors import ConfigError
from crazysim.trajectories import interpolation
from crazysim.trajectories.interpolation import Floats

N_SAMPLES = 65
"""Number of times at which the deviation of each piece is sampled, and of those around each maximum."""
MARGIN = 0.01
"""Part of the radius that is kept free, so that the iteration ends; half of it is left at the end."""
N_ROUNDS = 100
"""Largest number of rounds; a few are typical."""


def fill_in_corridors(nodes: Floats, durations: Floats, radii: Floats) -> Floats:
    """Return the derivatives at all waypoints that minimise the cost within corridors.

    The corridor of a piece contains all points up to its radius from the line segment between its waypoints. Being
    convex, it is the intersection of half-spaces. In each round, those that touch it where the curve is farthest
    outside are added to a quadratic program over the free derivatives, until the curve stays inside (cutting planes,
    Kelley 1960). The program is one of least distance in the metric of the cost, and thus of non-negative least squares
    (Lawson and Hanson, *Solving Least Squares Problems*, 1974, section 23.4).

    Args:
        nodes: Derivatives at each waypoint, NaN where free. (n_pieces + 1, k, 3)
        durations: Length of each piece, s. (n_pieces,)
        radii: Radius of each corridor, m; infinite for none. (n_pieces,)

    Raises:
        ConfigError: If fixed derivatives lead out of the corridor.
    """
    unit = float(np.mean(durations))
    powers = unit ** np.arange(nodes.shape[1])[:, None]
    scaled, lengths = nodes * powers, durations / unit
    filled = interpolation.fill(scaled, lengths)
    program = _Program(scaled, filled, lengths)
    inner, limit = radii * (1 - MARGIN), radii * (1 - MARGIN / 2)
    for _ in range(N_ROUNDS):
        paths = interpolation.unit_coefficients(filled, lengths)
        piece, u = _maxima(paths, nodes[:, 0], radii)
        outside, nearest, distance = _deviation(paths[piece], nodes[piece, 0], nodes[piece + 1, 0], u)
        leaves = distance > limit[piece]
        if not np.any(leaves):
            return filled / powers
        piece, normal = piece[leaves], outside[leaves] / distance[leaves, None]
        reach = np.sum(normal * nearest[leaves], axis=-1) + inner[piece]
        program.add(piece, u[leaves], normal, reach)
        filled = program.solve()
    raise ConfigError(
        f"expected a curve inside its corridors after {N_ROUNDS} rounds, got one that leaves the corridor of piece "
        f"{piece[0]}. Make the corridor wider, or add a waypoint."
    )


def _deviation(paths: Floats, start: Floats, end: Floats, u: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the vectors from line segments to curves, their feet on the segments, and their lengths.

    Args:
        paths: Coefficients. (n, 3, degree + 1)
        start: First points of the segments, m. (n, 3)
        end: Last points, m. (n, 3)
        u: Time within each piece over its length. (n,) or (n, n_times)

    Returns:
        (n, 3) or (n, n_times, 3), twice, and the same without the last axis.
    """
    u, along = np.asarray(u), end - start
    shape = (len(u), *[1] * (u.ndim - 1), 3)
    start, along = start.reshape(shape), along.reshape(shape)
    pos = np.einsum("n...k,nak->n...a", u[..., None] ** np.arange(paths.shape[-1]), paths)
    square = np.sum(along**2, axis=-1)
    part = np.sum((pos - start) * along, axis=-1) / np.where(square > 0, square, 1.0)
    nearest = start + np.clip(part, 0.0, 1.0)[..., None] * along
    return pos - nearest, nearest, np.linalg.norm(pos - nearest, axis=-1)


def _maxima(paths: Floats, waypoints: Floats, radii: Floats) -> tuple[np.ndarray, Floats]:
    """Return pieces, and times within them, at which the deviation is largest and comes near the radius. (n,) each"""
    samples = np.linspace(0.0, 1.0, N_SAMPLES)
    u = np.broadcast_to(samples, (len(paths), N_SAMPLES))
    distance = _deviation(paths, waypoints[:-1], waypoints[1:], u)[2]
    padded = np.pad(distance, ((0, 0), (1, 1)))
    is_peak = (distance >= padded[:, :-2]) & (distance >= padded[:, 2:]) & (distance > 0.5 * radii[:, None])
    piece, at = np.nonzero(is_peak)
    around = np.clip(samples[at][:, None] + (2 * samples - 1) / (N_SAMPLES - 1), 0.0, 1.0)
    distance = _deviation(paths[piece], waypoints[piece], waypoints[piece + 1], around)[2]
    return piece, around[np.arange(len(piece)), np.argmax(distance, axis=-1)]


class _Program:
    """Quadratic program of least distance to the unconstrained minimum, in the metric of the cost."""

    def __init__(self, nodes: Floats, filled: Floats, durations: Floats) -> None:
        self.filled, self.is_free = filled, np.isnan(nodes)
        self.order = nodes.shape[1]
        self.powers = durations[:, None] ** np.tile(np.arange(self.order), 2)
        size = nodes.shape[0] * self.order
        matrix = np.zeros((size, size))
        for p, block in enumerate(interpolation.cost_matrices(durations, self.order)):
            part = slice(p * self.order, (p + 2) * self.order)
            matrix[part, part] += block
        free = [self.is_free[..., axis].ravel() for axis in range(3)]
        self.factors = [np.linalg.cholesky(matrix[np.ix_(f, f)]) for f in free]
        self.rows, self.slack = np.zeros((0, sum(map(np.sum, free)))), np.zeros(0)

    def add(self, piece: np.ndarray, u: Floats, normal: Floats, reach: Floats) -> None:
        """Add half-spaces: ``normal . pos <= reach`` at one time ``u`` within each piece. (n,), (n,), (n, 3), (n,)"""
        n = len(piece)
        weights = u[:, None] ** np.arange(2 * self.order) @ interpolation.hermite_basis(self.order)
        rows = np.zeros((n, self.is_free.shape[0], self.order, 3))
        values = ((weights * self.powers[piece])[..., None] * normal[:, None]).reshape(n, 2, self.order, 3)
        rows[np.arange(n), piece], rows[np.arange(n), piece + 1] = values[:, 0], values[:, 1]
        slack = reach - np.einsum("nika,ika->n", rows, self.filled)
        columns = [
            np.linalg.solve(factor, rows[..., axis].reshape(n, -1)[:, self.is_free[..., axis].ravel()].T)
            for axis, factor in enumerate(self.factors)
        ]
        new = np.concatenate(columns, axis=0).T
        size = np.linalg.norm(new, axis=-1)
        if np.any((size < 1e-9) & (slack < 0)):
            raise _infeasible()
        size = np.maximum(size, 1e-9)
        self.rows = np.concatenate([self.rows, new / size[:, None]])
        self.slack = np.concatenate([self.slack, slack / size])

    def solve(self) -> Floats:
        """Return the derivatives of the nearest point in all half-spaces."""
        from scipy.optimize import nnls  # a fifth of a second to import

        scale = float(np.max(np.abs(self.slack)))
        system = np.concatenate([-self.rows.T, -self.slack[None] / scale])
        right = np.append(np.zeros(len(system) - 1), 1.0)
        residual = system @ nnls(system, right, maxiter=30 * system.shape[1])[0] - right
        if -residual[-1] < 1e-12:
            raise _infeasible()
        step = -residual[:-1] / residual[-1] * scale
        filled, first = self.filled.copy(), 0
        for axis, factor in enumerate(self.factors):
            part = step[first : first + len(factor)]
            values = filled[..., axis]
            values[self.is_free[..., axis]] += np.linalg.solve(factor.T, part)
            first += len(factor)
        return filled


def _infeasible() -> ConfigError:
    return ConfigError(
        "expected a curve inside its corridors, got fixed derivatives that lead out of them. Leave them free, or make "
        "the corridors wider."
    )
