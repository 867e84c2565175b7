"""Minimum-derivative polynomials inside corridors around the lines between waypoints, and between two heights.

The cost that is minimised is the integral of a squared derivative, as in ``interpolation``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from crazysim.errors import ConfigError
from crazysim.trajectories import interpolation
from crazysim.trajectories.interpolation import Floats

Deviations = tuple[Floats, Floats, Floats]
"""Vectors from the nearest points of line segments to curves, these nearest points, and the lengths of the vectors."""

N_SAMPLES = 65
"""Number of times at which the deviation is sampled along each piece, and again around each maximum."""
RADIUS_MARGIN = 0.01
"""Fraction of the radius by which half-spaces are inside the corridor. Curves may exceed the half-spaces by half of
this fraction, so that the iteration ends."""
HEIGHT_TOLERANCE = 2e-5
"""Distance by which a curve may be below the smallest height or above the largest one, m."""
MAX_ITERATIONS = 100
"""Largest number of iterations; a few are typical."""


class OutsideError(ConfigError):
    """Error for waypoints and derivatives that lead out of their corridors or heights."""


def fill_in_corridors(
    nodes: Floats, durations: Floats, radii: Floats, heights: tuple[float, float] = (-np.inf, np.inf)
) -> Floats:
    """Return the derivatives at all waypoints that minimise the cost within corridors and heights. (n_pieces + 1, k, 3)

    The corridor of a piece contains all points up to its radius from the line segment between its waypoints. A corridor
    is convex, and therefore an intersection of half-spaces; so is the space between two heights. Each iteration adds
    the half-spaces where the curve is farthest outside to a quadratic program over the free derivatives, until the
    curve stays inside (cutting planes, Kelley 1960). The program finds the point of least distance in the metric of the
    cost. This reduces to non-negative least squares (Lawson and Hanson, *Solving Least Squares Problems*, 1974, section
    23.4).

    Args:
        nodes: Derivatives at each waypoint, NaN where free. (n_pieces + 1, k, 3)
        durations: Length of each piece, s. (n_pieces,)
        radii: Radius of each corridor, m; infinite for none. (n_pieces,)
        heights: Smallest and largest height, m; infinite for none.

    Raises:
        OutsideError: If fixed derivatives lead out of the corridor or beyond a height, or if the curve is still outside
            after ``MAX_ITERATIONS`` iterations.
    """
    # Pieces about one unit of time long, which is better conditioned.
    time_unit = float(np.mean(durations))
    powers = time_unit ** np.arange(nodes.shape[1])[:, None]
    scaled_nodes, lengths = nodes * powers, durations / time_unit
    filled_nodes = interpolation.fill_derivatives(scaled_nodes, lengths)
    program = _QuadraticProgram(scaled_nodes, filled_nodes, lengths)
    inner_radii, max_radii = radii * (1 - RADIUS_MARGIN), radii * (1 - RADIUS_MARGIN / 2)
    for _ in range(MAX_ITERATIONS):
        coefficients = interpolation.unit_coefficients(filled_nodes, lengths)

        def deviation(piece: np.ndarray, u: Floats, coefficients: Floats = coefficients) -> Deviations:
            return _deviation(coefficients[piece], nodes[piece, 0], nodes[piece + 1, 0], u)

        # Half-spaces where the curve is outside.
        piece, u = _find_maxima(lambda piece, u: deviation(piece, u)[2], 0.5 * radii)
        offset, nearest, distance = deviation(piece, u)
        is_outside = distance > max_radii[piece]
        piece, normal = piece[is_outside], offset[is_outside] / distance[is_outside, None]
        half_spaces = [
            (piece, u[is_outside], normal, np.sum(normal * nearest[is_outside], axis=-1) + inner_radii[piece])
        ]
        half_spaces += [
            _height_half_spaces(coefficients[:, 2], height, sign) for height, sign in zip(heights, (-1, 1), strict=True)
        ]
        piece, u, normal, bound = (np.concatenate(parts) for parts in zip(*half_spaces, strict=True))
        if not len(piece):
            return filled_nodes / powers
        # The nearest curve inside all half-spaces so far.
        program.add_half_spaces(piece, u, normal, bound)
        filled_nodes = program.solve()
    raise OutsideError(
        f"expected a curve inside its corridors and heights after {MAX_ITERATIONS} iterations, got one whose piece "
        f"{piece[0]} is not. Make the corridor wider, or add a waypoint."
    )


def _height_half_spaces(coefficients: Floats, limit: float, sign: int) -> tuple[np.ndarray, Floats, Floats, Floats]:
    def height_excess(piece: np.ndarray, u: Floats) -> Floats:
        return sign * (
            np.einsum("n...k,nk->n...", u[..., None] ** np.arange(coefficients.shape[-1]), coefficients[piece]) - limit
        )

    piece, u = _find_maxima(height_excess, np.full(len(coefficients), -np.inf if np.isfinite(limit) else np.inf))
    is_beyond = height_excess(piece, u) > HEIGHT_TOLERANCE
    n = int(np.sum(is_beyond))
    return piece[is_beyond], u[is_beyond], np.tile([0.0, 0.0, float(sign)], (n, 1)), np.full(n, sign * limit)


def _deviation(coefficients: Floats, start: Floats, end: Floats, u: Floats) -> Deviations:
    u, segment = np.asarray(u), end - start
    shape = (len(u), *[1] * (u.ndim - 1), 3)
    start, segment = start.reshape(shape), segment.reshape(shape)
    pos = np.einsum("n...k,nak->n...a", u[..., None] ** np.arange(coefficients.shape[-1]), coefficients)
    square = np.sum(segment**2, axis=-1)
    segment_fraction = np.sum((pos - start) * segment, axis=-1) / np.where(square > 0, square, 1.0)
    nearest_point = start + np.clip(segment_fraction, 0.0, 1.0)[..., None] * segment
    return pos - nearest_point, nearest_point, np.linalg.norm(pos - nearest_point, axis=-1)


def _find_maxima(quantity: Callable[[np.ndarray, Floats], Floats], thresholds: Floats) -> tuple[np.ndarray, Floats]:
    samples = np.linspace(0.0, 1.0, N_SAMPLES)
    sampled_values = quantity(np.arange(len(thresholds)), np.broadcast_to(samples, (len(thresholds), N_SAMPLES)))
    padded = np.pad(sampled_values, ((0, 0), (1, 1)), constant_values=-np.inf)
    is_peak = (
        (sampled_values >= padded[:, :-2]) & (sampled_values >= padded[:, 2:]) & (sampled_values > thresholds[:, None])
    )
    piece, sample = np.nonzero(is_peak)
    fine_times = np.clip(samples[sample][:, None] + (2 * samples - 1) / (N_SAMPLES - 1), 0.0, 1.0)
    return piece, fine_times[np.arange(len(piece)), np.argmax(quantity(piece, fine_times), axis=-1)]


class _QuadraticProgram:
    """Quadratic program of least distance to the unconstrained minimum, in the metric of the cost."""

    def __init__(self, nodes: Floats, filled_nodes: Floats, durations: Floats) -> None:
        self.filled_nodes, self.is_free = filled_nodes, np.isnan(nodes)
        self.order = nodes.shape[1]
        self.powers = durations[:, None] ** np.tile(np.arange(self.order), 2)
        size = nodes.shape[0] * self.order
        matrix = np.zeros((size, size))
        for p, block in enumerate(interpolation.cost_matrices(durations, self.order)):
            part = slice(p * self.order, (p + 2) * self.order)
            matrix[part, part] += block
        free_masks = [self.is_free[..., axis].ravel() for axis in range(3)]
        # Cholesky factor of the cost matrix of the free derivatives of each axis.
        self.factors = [np.linalg.cholesky(matrix[np.ix_(mask, mask)]) for mask in free_masks]
        # Half-spaces ``row . x <= slack``; a step x from the minimum adds |x|^2 to the cost.
        self.rows, self.slack = np.zeros((0, sum(map(np.sum, free_masks)))), np.zeros(0)

    def add_half_spaces(self, piece: np.ndarray, u: Floats, normal: Floats, bound: Floats) -> None:
        # ``normal . pos <= bound`` at one time ``u`` within each piece. (n,), (n,), (n, 3), (n,)
        n = len(piece)
        weights = u[:, None] ** np.arange(2 * self.order) @ interpolation.hermite_basis(self.order)
        rows = np.zeros((n, self.is_free.shape[0], self.order, 3))
        values = ((weights * self.powers[piece])[..., None] * normal[:, None]).reshape(n, 2, self.order, 3)
        rows[np.arange(n), piece], rows[np.arange(n), piece + 1] = values[:, 0], values[:, 1]
        slack = bound - np.einsum("nika,ika->n", rows, self.filled_nodes)
        columns = [
            np.linalg.solve(factor, rows[..., axis].reshape(n, -1)[:, self.is_free[..., axis].ravel()].T)
            for axis, factor in enumerate(self.factors)
        ]
        new_rows = np.concatenate(columns, axis=0).T
        row_norms = np.linalg.norm(new_rows, axis=-1)
        if np.any((row_norms < 1e-9) & (slack < 0)):
            raise _infeasible_error()
        row_norms = np.maximum(row_norms, 1e-9)
        self.rows = np.concatenate([self.rows, new_rows / row_norms[:, None]])
        self.slack = np.concatenate([self.slack, slack / row_norms])

    def solve(self) -> Floats:
        # The derivatives inside all half-spaces that are nearest to the minimum. (n_pieces + 1, k, 3)
        from scipy.optimize import nnls  # a fifth of a second to import

        scale = float(np.max(np.abs(self.slack)))
        system = np.concatenate([-self.rows.T, -self.slack[None] / scale])
        rhs = np.append(np.zeros(len(system) - 1), 1.0)
        residual = system @ nnls(system, rhs, maxiter=30 * system.shape[1])[0] - rhs
        if -residual[-1] < 1e-12:
            raise _infeasible_error()
        step = -residual[:-1] / residual[-1] * scale
        filled_nodes, index = self.filled_nodes.copy(), 0
        for axis, factor in enumerate(self.factors):
            part = step[index : index + len(factor)]
            values = filled_nodes[..., axis]
            values[self.is_free[..., axis]] += np.linalg.solve(factor.T, part)
            index += len(factor)
        return filled_nodes


def _infeasible_error() -> OutsideError:
    return OutsideError(
        "expected a curve inside its corridors and heights, got fixed derivatives that lead out of them. Leave them "
        "free, or make the corridors wider."
    )
