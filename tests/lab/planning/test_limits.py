"""Limits and their check: peaks against dense samples, circles by hand, reports and errors."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from crazysim import load_airframe
from crazysim.lab.planning.peaks import QUANTITIES, find_peaks
from crazysim.lab.planning.piece_table import PieceTable
from crazysim.trajectories import Limits, Trajectory, check, circle, line, spline


def fly_straight(begin, end, duration):
    begin, end = np.asarray(begin, float), np.asarray(end, float)
    return Trajectory.of_pieces([duration], np.stack([begin, (end - begin) / duration], axis=-1)[None])


def fly_from_derivatives(*derivatives):
    """Return a flight of 1 s with these derivatives of position and yaw at its start, the zeroth first."""
    factorials = np.cumprod([1, *range(1, len(derivatives))])
    return Trajectory.of_pieces([1.0], (np.array(derivatives, float).T / factorials)[None])


@given(seed=st.integers(0, 10_000))
def test_peaks_agree_with_dense_samples(seed):
    rng = np.random.default_rng(seed)
    trajectories = [
        spline(np.cumsum(rng.uniform(0.8, 2.0, n)), rng.normal(size=(n, 3)), rng.choice([3, 5, 7]), rng.normal(size=n))
        for n in rng.integers(2, 7, 3)
    ]
    table = PieceTable.create(trajectories, rng.uniform(0, 2, 3))
    result = find_peaks(table, [name for name in QUANTITIES if name != "body_rate"])
    times = np.linspace(0, table.duration, 20_001)[:-1]
    for name, peak in result.items():
        quantity = QUANTITIES[name]
        for k in range(3):
            derivatives = [table.evaluate(np.full(len(times), k), times, order) for order in quantity.orders]
            dense = np.max(quantity.sign * quantity.compute(*derivatives))
            found_peak = quantity.sign * peak.value[k]
            assert dense - 1e-7 * abs(dense) - 1e-12 <= found_peak <= dense * (1 + 0.01 * np.sign(dense)) + 1e-6, name
            # Where pieces meet, the record has the derivatives of either side.
            times_around = peak.time[k] + np.array([-1e-6, 0.0, 1e-6])
            derivatives = [table.evaluate(np.full(3, k), times_around, order) for order in quantity.orders]
            assert np.min(np.abs(quantity.compute(*derivatives) - peak.value[k])) < 1e-3 * (1 + abs(found_peak)), name


def test_body_rate_peaks_agree_with_dense_samples():
    rng = np.random.default_rng(1)
    table = PieceTable.create(
        [spline(np.arange(5.0), 0.5 * rng.normal(size=(5, 3)), 7, rng.normal(size=5)) for _ in range(3)]
    )
    peak = find_peaks(table, ["body_rate"])["body_rate"]
    quantity, times = QUANTITIES["body_rate"], np.linspace(0, 4, 40_001)
    for k in range(3):
        derivatives = [table.evaluate(np.full(len(times), k), times, order) for order in quantity.orders]
        np.testing.assert_allclose(peak.value[k], np.max(quantity.compute(*derivatives)), rtol=1e-6)


def test_peaks_by_hand():
    """Derivatives at the start, largest there or constant: 3-4-5 triangles, and 0.75 g sideways."""
    g = 9.81
    moving = fly_from_derivatives([0, 0, 1, 0], [3, 0, -4, -0.5])
    result = check(moving, Limits()).peaks
    for name, value in (("speed", 5), ("horizontal_speed", 3), ("vertical_speed", 4), ("yaw_rate", 0.5), ("height", 1)):
        np.testing.assert_allclose(result[name].value, [value], rtol=1e-6)
    np.testing.assert_allclose(result["body_rate"].value, [0.5], rtol=1e-6)  # hover that turns
    pushed = check(fly_from_derivatives([0] * 4, [0] * 4, [3 * g / 4, 0, 0, 0]), Limits()).peaks
    np.testing.assert_allclose(pushed["acceleration"].value, [0.75 * g], rtol=1e-6)
    np.testing.assert_allclose([pushed["thrust"].value[0], pushed["min_thrust"].value[0]], 1.25, rtol=1e-6)
    # The thrust tilts at the rate jerk / g.
    leaning = check(fly_from_derivatives([0] * 4, [0] * 4, [0] * 4, [2.0, 0, 0, 0]), Limits()).peaks
    np.testing.assert_allclose(leaning["jerk"].value, [2.0], rtol=1e-5)
    np.testing.assert_allclose(leaning["body_rate"].value, [2.0 / g], rtol=1e-5)


def test_violations_name_limit_drone_time_and_value():
    slow, fast = fly_straight([0, 0, 1], [1, 0, 1], 2.0), fly_straight([0, 3, 1], [0, 1, 1], 1.0)
    report = check([slow, fast], Limits(speed=1.0, separation=1.5), starts=[0.0, 1.0], names=["ada", "bob"])
    speed, separation = report.violations
    assert not report.ok
    assert (speed.limit, speed.drones, speed.names, speed.allowed) == ("speed", (1,), ("bob",), 1.0)
    np.testing.assert_allclose(speed.value, 2.0, rtol=1e-6)
    assert 1.0 <= speed.time <= 2.0
    assert (separation.limit, separation.drones, separation.names) == ("separation", (0, 1), ("ada", "bob"))
    # At t = 1 + s Ada is at (0.5 + s / 2, 0), Bob at (0, 3 - 2 s): nearest at the end, (1, 0) and (0, 1).
    np.testing.assert_allclose([separation.value, separation.time], [np.sqrt(2), 2.0], rtol=1e-6)
    text = str(report)
    for part in ("2 drones, 2.00 s", "2 violations", "bob: speed 2 m/s at", "above the limit of 1", "ada and bob: sep"):
        assert part in text, text


def test_several_starts_of_one_trajectory_are_as_many_drones():
    """On a circle of 2 m in 8 s, 1 s is an eighth of a round: neighbours are 2 r sin(pi / 8) from each other."""
    report = check(circle(2.0, period=8.0), Limits(separation=1.6), starts=-np.arange(3.0))
    assert [pair.drones for pair in report.closest] in ([(0, 1), (1, 2), (0, 2)], [(1, 2), (0, 1), (0, 2)])
    distances = [pair.distance for pair in report.closest]
    np.testing.assert_allclose(distances, 4 * np.sin(np.pi / np.array([8, 8, 4])), atol=2e-3)  # tolerance of check
    assert [v.limit for v in report.violations] == ["separation"] * 2


def test_a_trajectory_at_its_limit_is_fine_and_one_above_is_not():
    flight = fly_straight([0, 0, 1], [2, 0, 1], 1.0)
    assert check(flight, Limits(speed=2.0)).ok
    assert not check(flight, Limits(speed=1.999)).ok
    assert "no violations" in str(check(flight, Limits(speed=2.0)))


def test_every_limit_can_be_exceeded():
    wild = [
        fly_from_derivatives([0, 0, 1, 0], [2, 2, 2, 2], [5, 5, -8, 1], [9, 9, 9, 1]),
        fly_straight([0, 0, 1], [1, 0, 1], 1.0),
    ]
    tight = Limits(0.1, 0.1, 0.1, 0.1, 0.1, 1.01, 0.99, 0.1, 0.1, 0.7, 0.5, floor=0.6)
    result = {violation.limit for violation in check(wild, tight).violations}
    assert result == set(tight.as_dict())
    loose = Limits(*[1000.0] * 6, 1e-3, 1000.0, 1000.0, 1000.0, 1e-9)
    assert check([wild[0], wild[0].moved([9, 0, 0])], loose).ok


def test_an_airframe_limits_the_thrust():
    airframe = load_airframe("cf21B_500")
    limits = Limits(speed=3.0).of_airframe(airframe)
    np.testing.assert_allclose(limits.thrust, 4 * 0.2 / (0.0434 * 9.81))
    assert limits.speed == 3.0
    assert Limits(thrust=1.1).of_airframe(airframe).thrust == 1.1
    climb = fly_from_derivatives([0] * 4, [0] * 4, [0, 0, 10.0, 0])
    assert check(climb, Limits()).ok
    (violation,) = check(climb, Limits(), airframe).violations
    assert violation.limit == "thrust"
    np.testing.assert_allclose(violation.value, 1 + 10 / 9.81, rtol=1e-6)


def test_the_floor_is_at_zero_unless_it_is_set():
    descent = line([0, 0, 1], [1, 0, -1], duration=4.0)
    (violation,) = check(descent, Limits(height=2.0), "cf21B_500").violations
    assert str(violation) == "drone 0: floor -1 m at 4.00 s, below the limit of 0"
    assert not check(descent, Limits(floor=-0.9)).ok
    assert check(descent, Limits(floor=-1.0)).ok
    assert check(descent, Limits(floor=None)).ok
    assert check(line([0, 0, 0], [1, 0, 0], duration=1.0), Limits()).ok
