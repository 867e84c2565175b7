"""Minimum snap and minimum jerk, against two independent solutions, with limits, corridors and durations."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import make_interp_spline
from scipy.optimize import minimize

from crazysim import ConfigError
from crazysim.lab.planning.piece_table import PieceTable
from crazysim.trajectories import (
    Limits,
    check,
    minimum_jerk,
    minimum_snap,
)

WAYPOINTS = np.array([[0, 0, 1], [2, 0, 1], [2, 2, 1.5], [0, 2, 1], [-1, 0, 1.0]])
DURATIONS = np.array([1.5, 1.2, 1.4, 1.0])
LIMITS = Limits(speed=2.0, acceleration=4.0)
METHODS = {minimum_snap: 4, minimum_jerk: 3}
"""Order of the derivative that each planner minimises."""


def pieces(trajectory):
    """Return the coefficients of x, y, z by time in seconds. (n_pieces, 3, degree + 1)"""
    c, lengths = np.asarray(trajectory.coefficients, float), np.diff(np.asarray(trajectory.ends, float), prepend=0)
    return c[:, :3] / lengths[:, None, None] ** np.arange(c.shape[-1])


def derivative_rows(t, size):
    """Return the derivatives of the monomials at a time. (n_derivatives, size)"""
    factors = [[np.prod(np.arange(j - k + 1, j + 1.0)) if j >= k else 0.0 for j in range(size)] for k in range(size)]
    return np.array([[f * t ** max(j - k, 0) for j, f in enumerate(row)] for k, row in enumerate(factors)])


def coefficients_by_kkt(waypoints, durations, order, velocity):
    """Return the coefficients of the optimal polynomials. (n_pieces, 3, 2 order)

    Waypoints and continuity are equality constraints, and the KKT system is solved.
    """
    size, n = 2 * order, len(durations)
    cost = np.zeros((n * size, n * size))
    for p, h in enumerate(durations):
        for i in range(order, size):
            for j in range(order, size):
                factor = np.prod(np.arange(i - order + 1, i + 1.0)) * np.prod(np.arange(j - order + 1, j + 1.0))
                cost[p * size + i, p * size + j] = factor * h ** (i + j - 2 * order + 1) / (i + j - 2 * order + 1)
    solution = np.zeros((n, 3, size))
    for axis in range(3):
        rows, right = [], []

        def add_constraint(terms, value, rows=rows, right=right):
            """Require that the rows in ``terms`` times the coefficients of their pieces sum to a value."""
            row = np.zeros(n * size)
            for p, part in terms:
                row[p * size : (p + 1) * size] += part
            rows.append(row), right.append(value)

        for k in range(1, order):
            add_constraint([(0, derivative_rows(0.0, size)[k])], 0.0)
            add_constraint([(n - 1, derivative_rows(durations[-1], size)[k])], 0.0)
        for p, h in enumerate(durations):
            add_constraint([(p, derivative_rows(0.0, size)[0])], waypoints[p, axis])
            add_constraint([(p, derivative_rows(h, size)[0])], waypoints[p + 1, axis])
            for k in range(1, order if p + 1 < n else 0):
                add_constraint([(p, derivative_rows(h, size)[k]), (p + 1, -derivative_rows(0.0, size)[k])], 0.0)
        if np.isfinite(velocity[axis]):
            add_constraint([(1, derivative_rows(0.0, size)[1])], velocity[axis])
        a = np.array(rows)
        system = np.block([[cost, a.T], [a, np.zeros((len(a), len(a)))]])
        result = np.linalg.lstsq(system, np.concatenate([np.zeros(len(cost)), right]), rcond=None)[0]
        solution[:, axis] = result[: n * size].reshape(n, size)
    return solution


@pytest.mark.parametrize("velocity", [[np.nan] * 3, [1.0, np.nan, -0.5]])
@pytest.mark.parametrize("method", METHODS)
def test_the_plan_is_the_solution_of_the_kkt_system(method, velocity, x64):
    velocities = np.full_like(WAYPOINTS, np.nan)
    velocities[[0, -1]], velocities[1] = 0.0, velocity
    trajectory = method(WAYPOINTS, DURATIONS, velocities=velocities)
    expected = coefficients_by_kkt(WAYPOINTS, DURATIONS, METHODS[method], velocity)
    np.testing.assert_allclose(pieces(trajectory), expected, atol=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize("method", METHODS)
def test_sixty_pieces_equal_the_spline_of_scipy(method, x64):
    rng = np.random.default_rng(7)
    waypoints, durations = np.cumsum(rng.normal(size=(61, 3)), axis=0), rng.uniform(0.3, 3.0, 60)
    order, knot_times = METHODS[method], np.concatenate([[0.0], np.cumsum(durations)])
    rest = [(k, np.zeros(3)) for k in range(1, order)]
    expected = make_interp_spline(knot_times, waypoints, k=2 * order - 1, bc_type=(rest, rest))
    times = np.linspace(0, knot_times[-1], 500)
    table = PieceTable.create([method(waypoints, durations)])
    for k in range(3):
        values = expected.derivative(k)(times) if k else expected(times)
        result = table.evaluate(np.zeros(500, int), times, k)[:, :3]
        np.testing.assert_allclose(result, values, atol=1e-8 * np.abs(values).max())


@settings(max_examples=10)
@pytest.mark.parametrize("method", METHODS)
@given(seed=st.integers(0, 10_000), n=st.integers(2, 9))
def test_planned_flights_pass_the_waypoints_at_rest_within_tight_limits(method, seed, n):
    rng = np.random.default_rng(seed)
    waypoints = rng.uniform(-3, 3, (n, 3))
    limits = Limits(
        speed=rng.uniform(0.5, 5),
        acceleration=rng.uniform(1, 10),
        jerk=rng.uniform(5, 100),
        thrust=rng.uniform(1.1, 2),
        floor=None,
    )
    trajectory = method(waypoints, limits=limits, yaw=rng.uniform(-3, 3, n))
    report = check(trajectory, limits)
    assert report.ok, str(report)
    usage = [report.peaks[name].value[0] / limit for name, limit in limits.as_dict().items()]
    assert max(usage) > 0.999
    ends = np.concatenate([[0.0], trajectory.ends])
    table = PieceTable.create([trajectory])
    np.testing.assert_allclose(table.evaluate(np.zeros(n, int), ends)[:, :3], waypoints, atol=1e-4)
    for order in (1, 2):
        at_ends = table.evaluate(np.zeros(2, int), ends[[0, -1]], order)[:, :3]
        np.testing.assert_allclose(at_ends, 0.0, atol=1e-3 * max(limits.acceleration, limits.speed))


@pytest.mark.parametrize("name, value", [("body_rate", 1.0), ("yaw_rate", 0.5), ("vertical_speed", 0.3)])
def test_a_single_limit_sets_the_duration(name, value):
    limits = Limits(**{name: value})
    report = check(minimum_snap(WAYPOINTS, limits=limits, yaw=[0, 1, 2, 3, 4]), limits)
    assert report.ok
    np.testing.assert_allclose(report.peaks[name].value, value, rtol=1e-3)


def test_a_smallest_thrust_bounds_how_fast_a_climb_ends():
    limits = Limits(min_thrust=0.5)
    report = check(minimum_snap([[0, 0, 1], [0, 0, 3]], limits=limits), limits)
    assert report.ok
    np.testing.assert_allclose(report.peaks["min_thrust"].value, 0.5, rtol=1e-3)
    np.testing.assert_allclose(report.peaks["thrust"].value, 1.5, rtol=1e-3)  # the climb is symmetric


def test_ratios_of_the_durations_minimise_snap():
    trajectory = minimum_snap(WAYPOINTS, limits=LIMITS)
    durations = np.diff(np.asarray(trajectory.ends, float), prepend=0)

    def cost(durations):
        durations = durations * np.sum(DURATIONS) / np.sum(durations)
        c, lengths = pieces(minimum_snap(WAYPOINTS, durations)), durations
        snap = c[..., 4:] * [24, 120, 360, 840]
        weights = [[1 / (i + j + 1) for i in range(4)] for j in range(4)]
        scaled = snap * lengths[:, None, None] ** (np.arange(4) + 0.5)
        return np.einsum("pai,ij,paj->", scaled, weights, scaled)

    min_cost = cost(durations)
    assert min_cost < 0.8 * cost(DURATIONS)
    rng = np.random.default_rng(0)
    assert all(cost(durations * np.exp(0.05 * rng.normal(size=4))) > min_cost for _ in range(20))


def test_fixed_derivatives_are_met_and_the_others_are_free():
    velocities = np.full_like(WAYPOINTS, np.nan)
    velocities[[0, -1]], velocities[2] = 0.0, [0.0, 1.0, 0.5]
    trajectory = minimum_snap(WAYPOINTS, limits=LIMITS, velocities=velocities)
    assert check(trajectory, LIMITS).ok
    table, time = PieceTable.create([trajectory]), float(trajectory.ends[1])
    np.testing.assert_allclose(table.evaluate(0, time, 1)[:3], velocities[2], atol=1e-4)
    passing = minimum_snap(WAYPOINTS[:2], [1.0], velocities=[[1, 0, 0], [1, 0, 0]], jerks=np.full((2, 3), np.nan))
    np.testing.assert_allclose(PieceTable.create([passing]).evaluate(0, 1.0, 1)[:3], [1, 0, 0], atol=1e-5)


def test_yaw_turns_the_shorter_way_and_ends_at_rest(x64):
    trajectory = minimum_snap(WAYPOINTS, DURATIONS, yaw=[3.0, -3.0, -2.0, 0.0, 1.0])
    expected = np.unwrap([3.0, -3.0, -2.0, 0.0, 1.0])
    table, knot_times = PieceTable.create([trajectory]), np.concatenate([[0], np.cumsum(DURATIONS)])
    np.testing.assert_allclose(table.evaluate(np.zeros(5, int), knot_times)[:, 3], expected, atol=1e-9)
    np.testing.assert_allclose(table.evaluate(np.zeros(2, int), knot_times[[0, -1]], 1)[:, 3], 0.0, atol=1e-9)
    rest = [(1, 0.0)]
    spline = make_interp_spline(knot_times, expected, k=3, bc_type=(rest, rest))
    np.testing.assert_allclose(table.evaluate(0, 2.0)[3], spline(2.0), atol=1e-9)


def deviations(trajectory, waypoints):
    """Return the largest distance of each piece from its line segment, m."""
    table, result = PieceTable.create([trajectory]), []
    for p, (a, b) in enumerate(pairwise(waypoints)):
        pos = table.evaluate_pieces(np.full(2001, p), np.linspace(0, 1, 2001))[:, :3]
        part = np.clip((pos - a) @ (b - a) / max((b - a) @ (b - a), 1e-12), 0, 1)
        result.append(np.linalg.norm(pos - a - part[:, None] * (b - a), axis=-1).max())
    return np.array(result)


@settings(max_examples=15)
@pytest.mark.parametrize("method", METHODS)
@given(seed=st.integers(0, 1000), n=st.integers(2, 7), radius=st.floats(0.01, 0.5))
def test_flights_stay_in_their_corridors(method, seed, n, radius):
    rng = np.random.default_rng(seed)
    waypoints = rng.uniform(-2, 2, (n, 3))
    radii = radius * rng.uniform(0.5, 1.5, n - 1)
    trajectory = method(waypoints, rng.uniform(0.5, 2.0, n - 1), corridors=radii)
    result = deviations(trajectory, waypoints)
    assert np.all(result <= radii + 1e-5)


def test_a_wide_corridor_changes_nothing_and_a_single_piece_may_be_bounded():
    free = minimum_snap(WAYPOINTS, DURATIONS)
    wide = minimum_snap(WAYPOINTS, DURATIONS, corridors=10.0)
    np.testing.assert_array_equal(wide.coefficients, free.coefficients)
    bounded = deviations(minimum_snap(WAYPOINTS, DURATIONS, corridors=[np.inf, 0.1, np.inf, np.inf]), WAYPOINTS)
    assert bounded[1] <= 0.1 < 0.3 < deviations(free, WAYPOINTS)[1]
    assert bounded[[0, 2, 3]].max() > 0.1


def test_the_cost_in_a_corridor_is_the_optimum_of_scipy(x64):
    """Two pieces in a plane; SciPy minimises the same cost, with a bound on the distances at 61 times of each piece."""
    waypoints, durations, radius = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1.0]]), np.array([1.0, 1.0]), 0.05
    result = pieces(minimum_snap(waypoints, durations, corridors=radius))

    def coefficients(x):
        solved = []
        for axis in range(2):
            ends = np.array([derivative_rows(t, 8)[k] for t in (0.0, 1.0) for k in range(4)])
            middle = [waypoints[1, axis], *x[3 * axis : 3 * axis + 3]]
            first = np.linalg.solve(ends, [waypoints[0, axis], 0, 0, 0, *middle])
            solved.append([first, np.linalg.solve(ends, [*middle, waypoints[2, axis], 0, 0, 0])])
        return np.swapaxes(solved, 0, 1)

    def cost(c):
        snap = c[..., 4:] * [24, 120, 360, 840]
        return np.einsum("pai,ij,paj->", snap, [[1 / (i + j + 1) for i in range(4)] for j in range(4)], snap)

    powers = np.linspace(0, 1, 61)[:, None] ** np.arange(8)
    base = coefficients(np.zeros(6))
    parts = np.array([coefficients(e) - base for e in np.eye(6)])

    def clearance(x):
        """Return the square of the radius, less 0.75%, minus the squared distances to the segments.

        The planner leaves 0.5% to 1% of the radius unused (``RADIUS_MARGIN``).
        """
        pos = np.einsum("uk,pak->pua", powers, base + np.tensordot(x, parts, 1))
        begin, along = waypoints[:2, None, :2], np.diff(waypoints, axis=0)[:, None, :2]
        nearest = begin + np.clip(np.sum((pos - begin) * along, axis=-1), 0, 1)[..., None] * along
        return ((0.9925 * radius) ** 2 - np.sum((pos - nearest) ** 2, axis=-1)).ravel()

    bound = {"type": "ineq", "fun": clearance}
    min_cost = 1e4 * minimize(lambda x: cost(coefficients(x)) / 1e4, np.zeros(6), constraints=bound, method="SLSQP").fun
    free = cost(pieces(minimum_snap(waypoints, durations))[:, :2])
    assert free < 0.7 * min_cost  # the corridor matters
    np.testing.assert_allclose(cost(result[:, :2]), min_cost, rtol=3e-3)


BENT = [[0, 0, 1], [1, 0, 1], [1, 1, 1]]
"""Waypoints of a path with a right angle."""


@settings(max_examples=5)
@pytest.mark.parametrize("method", METHODS)
@given(seed=st.integers(0, 10_000), n=st.integers(2, 8), has_velocity=st.booleans())
def test_planned_flights_stay_between_floor_and_height(method, seed, n, has_velocity):
    """Many waypoints are on the floor or at the height; velocities are free or fixed."""
    rng = np.random.default_rng(seed)
    waypoints = rng.uniform(-3, 3, (n, 3))
    waypoints[:, 2] = rng.choice([0.5, 0.6, 1.5, 2.0], n)
    velocities = np.full((n, 3), np.nan)
    velocities[[0, -1]] = 0.0
    if has_velocity and n > 2:
        velocities[1] = [1.0, -1.0, 0.0]
    limits = Limits(speed=3.0, acceleration=8.0, floor=0.5, height=2.0)
    report = check(method(waypoints, limits=limits, velocities=velocities), limits)
    assert report.ok, str(report)


def test_a_plan_through_high_gates_does_not_dip_below_the_floor():
    gates = [[0, 0, 1], [0, 0, 3], [1, 0, 0.8], [6, 0, 0.8], [7, 0, 3], [7, 0, 1]]
    free = minimum_snap(gates, limits=Limits(speed=3.0, floor=None))
    assert check(free, Limits(floor=None)).peaks["floor"].value < -0.1
    limited = minimum_snap(gates, limits=Limits(speed=3.0))
    assert check(limited, Limits()).ok
    assert check(limited, Limits()).peaks["floor"].value < 1e-3  # the flight reaches the floor


def test_durations_times_the_factor_of_the_error_meet_the_limits():
    with pytest.raises(ConfigError, match="Multiply the durations by") as caught:
        minimum_snap(BENT, [0.5, 0.5], limits=LIMITS)
    factor = float(str(caught.value).split("durations by ")[1].split(",")[0])
    report = check(minimum_snap(BENT, [0.5 * factor, 0.5 * factor], limits=LIMITS), LIMITS)
    assert max(report.peaks[name].value[0] / LIMITS.as_dict()[name] for name in ("speed", "acceleration")) > 0.99
