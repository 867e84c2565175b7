"""Trajectories from splines: through points at given times, and from Bezier control points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazysim.arguments import check_flag
from crazysim.errors import ConfigError, expect, require
from crazysim.tables import read_floats
from crazysim.trajectories import interpolation
from crazysim.trajectories.bezier import power_coefficients
from crazysim.trajectories.trajectory import MAX_SIZE, Trajectory, ends_of

SPLINE_ORDERS = {3: 2, 5: 3, 7: 4}
"""Order of the derivative that a spline minimises (the integral of its square), by the degree of the spline."""


def spline(
    times: ArrayLike, points: ArrayLike, degree: int = 5, yaw: ArrayLike = 0.0, at_rest: bool = True
) -> Trajectory:
    """Fit the smoothest spline through points at given times.

    Of all curves through the points, the spline of degree 3, 5 or 7 minimises the integral of the squared acceleration,
    jerk or snap, respectively. Its derivatives are continuous up to the second, fourth or sixth.

    Args:
        times: Time of each point, s, ascending. The trajectory starts at the first. (n_points,)
        points: Positions, world frame, m. (n_points, 3)
        degree: Degree of the polynomials: 3, 5 or 7.
        yaw: Yaw, rad: one value for all points, or one per point. The drone turns the shorter way between points. () or
            (n_points,)
        at_rest: Whether to start and end at rest; else the spline is natural, with free derivatives at both ends.
    """
    require(
        isinstance(degree, (int, np.integer)) and degree in SPLINE_ORDERS,
        f"expected a spline of degree 3, 5 or 7, got {degree!r}. Use spline(times, points, 7).",
    )
    knots, x = read_floats("times", times), read_floats("points", points)
    require(
        knots.ndim == 1 and x.shape == (len(knots), 3),
        f"expected times (n_points,) and points (n_points, 3), got shapes {knots.shape} and {x.shape}. Pass one "
        "time per point.",
    )
    n_min = 2 if check_flag("at_rest", at_rest) else SPLINE_ORDERS[degree]
    require(
        len(knots) >= n_min,
        f"expected at least {n_min} points for a spline of degree {degree}, got {len(knots)}. Add points, or lower "
        "the degree.",
    )
    durations = np.diff(knots)
    ends_of(durations)
    # Positions and yaw at the points; derivatives are free, or zero at rest.
    nodes = np.full((len(knots), SPLINE_ORDERS[degree], 4), np.nan)
    nodes[:, 0] = np.concatenate([require_finite(x, "points"), unwrap_yaw(yaw, len(knots))[:, None]], axis=1)
    if at_rest:
        nodes[[0, -1], 1:] = 0.0
    filled_nodes = interpolation.fill_derivatives(nodes, durations)
    return trajectory_from_unit_pieces(durations, interpolation.unit_coefficients(filled_nodes, durations))


def of_bezier(ends: ArrayLike, control_points: Sequence[ArrayLike], repeats: bool = False) -> Trajectory:
    """Join a sequence of Bezier curves.

    The Bernstein polynomials are expanded in float64: ``c_k = C(n, k) sum_i (-1)^(k - i) C(k, i) P_i``.

    Args:
        ends: End of each curve, s since the start of the trajectory, ascending. (n_pieces,)
        control_points: Control points of each curve, including its ends: x, y, z, m, and optionally yaw, rad. Yaw is in
            all curves or in none. The degrees may differ. n_pieces times (degree + 1, 3) or (degree + 1, 4)
        repeats: Whether to start again after the end.
    """
    end_times = read_floats("ends", ends)
    expect(
        isinstance(control_points, (list, tuple, np.ndarray)) and getattr(control_points, "ndim", 1),
        "control points as a list with an array per curve",
        control_points,
    )
    curves = [read_floats("control points", points) for points in control_points]
    shapes = [curve.shape for curve in curves]
    require(
        end_times.shape == (len(curves),) and curves,
        f"expected ends (n_pieces,) for {len(curves)} curves, at least one, got shape {end_times.shape}. Pass the "
        "time at which each ends.",
    )
    is_curve = [len(shape) == 2 and shape[0] > 0 and shape[1] in (3, 4) for shape in shapes]
    require(
        all(is_curve) and len({shape[1] for shape in shapes}) == 1,
        f"expected control points (degree + 1, 3) for all curves or (degree + 1, 4) for all, got {shapes}. Give "
        "all curves a yaw, or none.",
    )
    # Polynomials of equal degree.
    durations = np.diff(end_times, prepend=0.0)
    ends_of(durations)
    degree = max(len(curve) for curve in curves) - 1
    pieces = [
        interpolation.pad_degree(power_coefficients(require_finite(curve, "control points")), degree)
        for curve in curves
    ]
    return trajectory_from_unit_pieces(durations, np.stack(pieces), repeats)


def trajectory_from_unit_pieces(durations: ArrayLike, coefficients: ArrayLike, repeats: bool = False) -> Trajectory:
    """Return the trajectory of polynomials in the time since the start of each piece, divided by its length.

    Args:
        durations: Length of each piece, s. (n_pieces,)
        coefficients: Constant term first. (n_pieces, 3 or 4, degree + 1)
        repeats: Whether to start again after the end.
    """
    c, lengths = np.asarray(coefficients, float), np.asarray(durations, float)
    return Trajectory.of_pieces(lengths, c / lengths[:, None, None] ** np.arange(c.shape[-1]), repeats)


def unwrap_yaw(yaw: ArrayLike, n_points: int) -> NDArray[np.float64]:
    """Return the yaw at each point, rad, unwrapped so that neighbours differ by at most pi. (n_points,)

    Args:
        yaw: One yaw for all points, or one per point, rad. () or (n_points,)
    """
    angles = require_finite(read_floats("yaw", yaw), "yaw")
    require(
        angles.shape in ((), (n_points,)),
        f"expected one yaw, or one for each of {n_points} points, got shape {angles.shape}. Pass a number, or an "
        "array of that length.",
    )
    return np.unwrap(np.broadcast_to(angles, (n_points,)))


def require_finite(values: NDArray[np.float64], name: str, limit: float = MAX_SIZE) -> NDArray[np.float64]:
    """Return the values after a check that all are finite and of a size up to ``limit``, so that no product overflows.

    Args:
        values: Numbers. (...)
        limit: Largest absolute value.
    """
    is_wrong = ~(np.abs(values) <= limit)
    if np.any(is_wrong):
        index = np.argwhere(is_wrong)[0].tolist()
        raise ConfigError(
            f"expected finite {name} of a size up to {limit:g}, got {values[tuple(index)]:g} at index {index}. Remove "
            "or replace it."
        )
    return values
