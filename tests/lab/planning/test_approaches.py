"""Closest approaches, against dense samples and by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazysim.lab.planning.approaches import closest_approaches
from crazysim.lab.planning.piece_table import PieceTable
from crazysim.trajectories import Trajectory, spline

TOLERANCE = 1e-3
"""Tolerance of the distances, m."""


def fly_straight(begin, end, duration):
    begin, end = np.asarray(begin, float), np.asarray(end, float)
    return Trajectory.of_pieces([duration], np.stack([begin, (end - begin) / duration], axis=-1)[None])


def distances(table, i, j, times):
    return np.linalg.norm(
        (table.evaluate(np.full(len(times), i), times) - table.evaluate(np.full(len(times), j), times))[:, :3], axis=-1
    )


@given(seed=st.integers(0, 10_000), n_drones=st.integers(2, 4))
def test_distances_agree_with_dense_samples(seed, n_drones):
    rng = np.random.default_rng(seed)
    trajectories = [
        spline(np.cumsum(rng.uniform(0.3, 2.0, n)), rng.normal(size=(n, 3)), rng.choice([3, 5, 7]))
        for n in rng.integers(2, 6, n_drones)
    ]
    table = PieceTable.create(trajectories, rng.uniform(0, 3, n_drones))
    result = closest_approaches(table, TOLERANCE)
    assert sorted(x.drones for x in result) == [(i, j) for i in range(n_drones) for j in range(i + 1, n_drones)]
    assert [x.distance for x in result] == sorted(x.distance for x in result)
    times = np.linspace(0, table.duration, 20_001)
    for x in result:
        assert x.distance <= distances(table, *x.drones, times).min() + TOLERANCE
        np.testing.assert_allclose(x.distance, distances(table, *x.drones, np.array([x.time]))[0], rtol=1e-12)


def test_crossing_flights_by_hand():
    """The drones pass the crossing half a second apart, at 1 m/s and at right angles: sqrt(2) / 4 m."""
    first = fly_straight([-5, 0, 1], [5, 0, 1], 10.0)
    second = fly_straight([0, -5.5, 1], [0, 4.5, 1], 10.0)
    (approach,) = closest_approaches(PieceTable.create([first, second]))
    np.testing.assert_allclose(approach.distance, 0.5 / np.sqrt(2), atol=1e-3)
    np.testing.assert_allclose(approach.time, 5.25, atol=0.01)


@pytest.mark.parametrize("smooth", [False, True])
def test_a_dash_within_a_cell_is_found(smooth):
    """A drone at rest dashes to another and back in 0.16 s, between the ends of a cell and off its middle."""

    def dash(begin, end):
        return spline([0.0, 0.08], [begin, end], 7) if smooth else fly_straight(begin, end, 0.08)

    home, away = np.array([0, 0, 1.0]), np.array([1, 0, 1.0])
    first = (
        fly_straight(home, home, 0.82)
        .then(dash(home, away))
        .then(dash(away, home))
        .then(fly_straight(home, home, 3.02))
    )
    second = fly_straight(away + [0.02, 0, 0], away + [0.02, 0, 0], 4.0)
    (approach,) = closest_approaches(PieceTable.create([first, second]))
    np.testing.assert_allclose(approach.distance, 0.02, atol=1e-3)
    np.testing.assert_allclose(approach.time, 0.9, atol=0.01)


def test_a_jump_of_the_position_has_no_points_in_between():
    """The result is the smaller of the distances before and after the jump."""
    jumps = fly_straight([-2, 0, 0], [-2, 0, 0], 1.05).then(fly_straight([1, 0, 0], [1, 0, 0], 1.0))
    stays = fly_straight([0, 0, 0], [0, 0, 0], 2.05)
    (approach,) = closest_approaches(PieceTable.create([jumps, stays]))
    np.testing.assert_allclose(approach.distance, 1.0, atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("table", [0, 10**6])
def test_blocks_and_tables_do_not_change_the_result(table, seed, monkeypatch):
    from crazysim.lab.planning import approaches

    rng = np.random.default_rng(seed)
    pieces = PieceTable.create([spline(np.arange(4.0), rng.normal(size=(4, 3))) for _ in range(4)])
    expected = closest_approaches(pieces)
    monkeypatch.setattr(approaches, "MAX_TABLE_CELLS", table)
    monkeypatch.setattr(approaches, "CELLS_PER_BATCH", 7)
    result = closest_approaches(pieces)
    assert [x.drones for x in result] == [x.drones for x in expected]
    np.testing.assert_allclose([x.distance for x in result], [x.distance for x in expected], atol=TOLERANCE)
