"""Durations of the pieces of a trajectory: the cost determines their ratios, the limits their sum.

The cost is the integral of a squared derivative, as in ``interpolation``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from crazysim.errors import ConfigError
from crazysim.lab.planning.corridors import OutsideError
from crazysim.lab.planning.limits import Limits, tolerance_scale
from crazysim.lab.planning.peaks import QUANTITIES, find_peaks
from crazysim.lab.planning.piece_table import PieceTable
from crazysim.trajectories import interpolation
from crazysim.trajectories.interpolation import Floats

LIMIT_MARGIN = 1e-4
"""Fraction of a limit that is left unused to allow for rounding in float32. A height limit may instead be exceeded by
half of this fraction, since waypoints may be exactly at the limit."""
DURATION_TOLERANCE = 1e-5
"""Relative precision of the factor by which durations are scaled."""
DURATION_FACTOR = 1.25
"""Factor by which durations are multiplied until the limits are met, then divided until they are not."""
MAX_SCALINGS = 50
"""Largest number of multiplications, and of divisions, by ``DURATION_FACTOR``: together a factor of 70,000."""


def trapezoid_durations(distances: Floats, limits: Limits) -> Floats:
    """Return the shortest durations from rest to rest over distances at bounded speed and acceleration, s. (n_pieces,)

    Only the ratios matter. A missing speed limit is therefore replaced by 1 m/s, and a missing acceleration limit by
    the acceleration that reaches the speed limit in one second.
    """
    speed = limits.speed or 1.0
    acceleration = limits.acceleration or speed
    is_short = distances < speed**2 / acceleration
    return np.where(is_short, 2 * np.sqrt(distances / acceleration), distances / speed + speed / acceleration)


def optimal_durations(nodes: Floats, durations: Floats) -> Floats:
    """Return the durations that minimise the cost for the same total duration, s. (n_pieces,)

    A quasi-Newton method over the logarithms of the ratios to the total duration, with the exact gradient
    (``interpolation.cost_gradient``), finds a local minimum.

    Args:
        nodes: Derivatives at each waypoint, NaN where free. (n_pieces + 1, k, 3)
        durations: First guess, s. (n_pieces,)
    """
    from scipy.optimize import minimize  # a fifth of a second to import

    total = float(np.sum(durations))

    def durations_from_logarithms(log_ratios: Floats) -> Floats:
        weights = np.exp(log_ratios - np.max(log_ratios))
        return total * weights / np.sum(weights)

    def logarithm_of_cost(log_ratios: Floats) -> tuple[float, Floats]:
        trial_durations = durations_from_logarithms(log_ratios)
        filled_nodes = interpolation.fill_derivatives(nodes, trial_durations)
        cost = interpolation.derivative_cost(filled_nodes, trial_durations)
        slope = interpolation.cost_gradient(filled_nodes, trial_durations) * trial_durations
        return float(np.log(cost)), (slope - trial_durations / total * np.sum(slope)) / cost

    if len(durations) == 1:
        return durations
    result = minimize(logarithm_of_cost, np.log(durations / total), jac=True, method="L-BFGS-B")
    return durations_from_logarithms(result.x)


def violated_limits(durations: Floats, coefficients: Floats, limits: Limits) -> list[str]:
    """Return the names of the limits that polynomials exceed.

    Args:
        durations: Length of each piece, s. (n_pieces,)
        coefficients: Coefficients of x, y, z and yaw, in a piece's time divided by its length.
            (n_pieces, 4, degree + 1)
        limits: Limits; ``separation`` is not checked.
    """
    checked_limits = {name: limit for name, limit in limits.as_dict().items() if name in QUANTITIES}
    ends = np.cumsum(durations)
    drone = np.zeros(len(ends), int)  # all pieces belong to one drone
    table = PieceTable(float(ends[-1]), drone, ends - durations, durations, coefficients)
    peaks = find_peaks(table, tuple(checked_limits))
    excesses = {name: QUANTITIES[name].sign * (peaks[name].value[0] - limit) for name, limit in checked_limits.items()}
    margins = {
        name: -LIMIT_MARGIN if QUANTITIES[name].orders != (0,) else 0.5 * LIMIT_MARGIN for name in checked_limits
    }
    return [
        name for name, limit in checked_limits.items() if excesses[name] > margins[name] * tolerance_scale(name, limit)
    ]


def shortest_durations(solve: Callable[[Floats], Floats], durations: Floats, limits: Limits) -> Floats:
    """Return the shortest durations, in the same ratios, at which a trajectory meets its limits, s. (n_pieces,)

    The search slows the flight until the limits are met, then speeds it up until they are not. ``min_thrust`` can be
    violated at one speed and met again at a higher speed; the search does not find such a higher speed.

    Args:
        solve: Function from durations, s (n_pieces,), to coefficients (n_pieces, 4, degree + 1).
        durations: First guess, s. (n_pieces,)
    """

    def exceeded_limits(factor: float) -> list[str]:
        try:
            return violated_limits(durations * factor, solve(durations * factor), limits)
        except OutsideError:  # the fixed derivatives lead out of the corridors or heights
            return ["corridors or heights"]

    high = 1.0
    for _ in range(MAX_SCALINGS):
        names = exceeded_limits(high)
        if not names:
            break
        high *= DURATION_FACTOR
    else:
        raise ConfigError(
            f"expected waypoints that can be flown within the limits, got some that exceed {' and '.join(names)} "
            f"however slow the flight. Raise the limit, or change waypoints or fixed derivatives."
        )
    low = high / DURATION_FACTOR
    for _ in range(MAX_SCALINGS):
        if exceeded_limits(low):
            break
        low, high = low / DURATION_FACTOR, low
    else:
        raise ConfigError(
            f"expected limits that bound the speed of the flight, got {limits}. Set a limit of speed or acceleration, "
            f"or pass durations."
        )
    while high > low * (1 + DURATION_TOLERANCE):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if exceeded_limits(middle) else (low, middle)
    return durations * high
