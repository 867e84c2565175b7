"""The clock of a race, against straight flights that are timed by hand."""

import jax
import numpy as np
import pytest

from crazysim import ConfigError
from crazysim.envs import RaceClock, Track, time_flight

SQUARE = [(0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5)]


def track(**changes):
    """A square gate along x at x = 1, and a ball of 0.5 m at x = 3."""
    settings = {"gates_pos": [(1, 0, 1), (3, 0, 1)], "gates_rpy": [(0, 0, 0)] * 2, "openings": [SQUARE, 0.5]}
    return Track(**settings | changes)


def fly(*points, laps=1, course=None, missed=None):
    """Fly straight from point to point, 1 s each, in steps of 10 ms that no gate begins or ends."""
    course, times = course or track(), np.linspace(0, len(points) - 1, 100 * (len(points) - 1) + 1)
    pos = np.stack([np.interp(times, np.arange(len(points)), np.array(points)[:, k]) for k in range(3)], axis=-1)
    return time_flight(course, times, pos, laps, missed), course


def test_times_are_those_of_the_crossing_within_a_step():
    """From x = 0 to 3.1 in 1 s: the gate at 1 / 3.1 s, and the ball, 0.3 m beside its middle, 0.4 m before it."""
    clock, course = fly((0, 0.3, 1), (3.1, 0.3, 1))
    np.testing.assert_allclose(clock.times, [1 / 3.1, 2.6 / 3.1], atol=2e-6)  # float32
    assert bool(clock.finished)
    np.testing.assert_allclose(clock.lap_times(course), [2.6 / 3.1], atol=2e-6)
    np.testing.assert_allclose(clock.splits(course), [[1 / 3.1, 1.6 / 3.1]], atol=2e-6)
    np.testing.assert_allclose(clock.add_penalty(2.0).add_penalty(0.5).time, 2.6 / 3.1 + 2.5, atol=2e-6)


@pytest.mark.parametrize(
    ("points", "passed"),
    [
        ([(0, 0.6, 1), (3, 0.6, 1)], 0),  # beside the gate
        ([(2, 0, 1), (0, 0, 1)], 0),  # backwards
        ([(3, 0, 1), (2, 0, 1)], 0),  # the ball first
        ([(0, 0, 1), (2.4, 0, 1), (2.4, 3, 1)], 1),  # short of the ball
        ([(0, 0, 1), (2, 0, 1), (3, -0.49, 1)], 2),
    ],
)
def test_gates_count_in_their_order_and_direction_within_their_openings(points, passed):
    clock, _ = fly(*points)
    assert int(clock.passed) == passed
    assert bool(clock.finished) == (passed == 2)
    assert np.isinf(clock.times[passed:]).all()


def test_a_missed_gate_costs_a_penalty_when_the_gate_after_it_is_passed():
    """Beside the gate and through two balls, twice; the last gate cannot be missed, and none of two."""
    three = track(
        gates_pos=[(1, 0, 1), (3, 0, 1), (3, 4, 1)], gates_rpy=[(0, 0, 0)] * 3, openings=[SQUARE, 0.5, 0.5]
    )  # fmt: skip
    ways = [(0, 0, 1), (0, 2, 1), (3, 2, 1), (3, 0, 1), (3, 4, 1), (3, 0, 1)]
    clock, _ = fly(*ways, laps=2, course=three, missed=2.0)
    np.testing.assert_allclose(clock.times, [2.75, 2.75, 3.875, 4.875, 4.875, np.inf], atol=5e-6)
    assert (float(clock.penalty), int(clock.passed)) == (4.0, 5)
    clock, _ = fly(*ways, (3, 4, 1), laps=2, course=three, missed=2.0)
    np.testing.assert_allclose(clock.time, 5.875 + 4.0, atol=5e-6)
    np.testing.assert_allclose(clock.lap_times(three), [3.875, 2.0], atol=5e-6)
    for course, missed in ((three, None), (track(), 2.0)):
        clock, _ = fly(*ways, laps=2, course=course, missed=missed)
        assert (float(clock.penalty), int(clock.passed)) == (0.0, 0)


def test_laps_count_the_same_gates_again():
    round_trip = [(0, 0, 1), (4, 0, 1), (4, 3, 1), (0, 3, 1)]
    clock, course = fly(*round_trip, *round_trip[:2], laps=2)
    np.testing.assert_allclose(clock.times, [0.25, 0.625, 4.25, 4.625], atol=5e-6)
    np.testing.assert_allclose(clock.lap_times(course), [0.625, 4.0], atol=5e-6)
    assert clock.splits(course).shape == (2, 2)


def test_a_gate_with_a_length_is_passed_at_its_end():
    clock, _ = fly((0, 0, 1), (4, 0, 1), course=track(lengths=[1.0, 0.0]))
    np.testing.assert_allclose(clock.times[0], 1.5 / 4, atol=2e-6)


def test_clocks_of_many_drones_advance_in_one_call():
    """Law 1: as each by itself."""
    course, clock = track(), RaceClock.start(track())
    before = np.array([[0.9, 0, 1], [0.9, 0.6, 1], [1.1, 0, 1]], np.float32)
    advance = jax.vmap(lambda a, b: clock.advance(course, a, b, 0.0, 0.1))
    together = advance(before, before + np.float32([0.2, 0, 0]))
    np.testing.assert_array_equal(together.passed, [1, 0, 0])


def test_law_09_no_lap_is_named():
    with pytest.raises(ConfigError, match="at least one lap"):
        RaceClock.start(track(), laps=0)
