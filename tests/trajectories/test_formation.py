"""Formations: distances between neighbours, centres, and turns."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazysim.trajectories import formation

SHAPES = {"line": formation.line, "grid": formation.grid, "circle": formation.circle}


def distances(positions):
    return np.linalg.norm(positions[:, None] - positions, axis=-1)[np.triu_indices(len(positions), 1)]


@pytest.mark.parametrize("name", SHAPES)
@given(n=st.integers(1, 30), spacing=st.floats(0.1, 10.0), yaw=st.floats(-4, 4))
def test_neighbours_are_one_spacing_from_each_other(name, n, spacing, yaw):
    positions = SHAPES[name](n, spacing, center=(1.0, -2.0, 0.5), yaw=yaw)
    assert positions.shape == (n, 3)
    np.testing.assert_array_equal(positions[:, 2], 0.5)
    if n > 1:
        np.testing.assert_allclose(distances(positions).min(), spacing, rtol=1e-9)
    if name != "grid" or round(n**0.5) ** 2 == n:  # a grid that is not full leaves out its last corners
        np.testing.assert_allclose(positions.mean(axis=0), [1.0, -2.0, 0.5], atol=1e-9)
    level = SHAPES[name](n, spacing, center=(0.0, 0.0, 0.0))
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    np.testing.assert_allclose(positions[:, :2] - [1.0, -2.0], level[:, :2] @ turn.T, atol=1e-9)


def test_line_circle_and_grid_by_hand():
    np.testing.assert_allclose(formation.line(3, 0.5), [[-0.5, 0, 1], [0, 0, 1], [0.5, 0, 1]])
    np.testing.assert_allclose(
        formation.circle(4, radius=2.0, center=(0, 0, 1)), [[2, 0, 1], [0, 2, 1], [-2, 0, 1], [0, -2, 1]], atol=1e-12
    )
    assert sorted(map(tuple, formation.grid(4, 1.0, center=(0, 0, 0)).tolist())) == [
        (-0.5, -0.5, 0), (-0.5, 0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0)
    ]  # fmt: skip


@given(n=st.integers(2, 12), seed=st.integers(0, 10**6))
def test_matched_targets_keep_straight_flights_clear(n, seed):
    """The bound of Turpin and others, at 101 moments of flights of random formations."""
    a, b = np.random.default_rng(seed).normal(size=(2, n, 3))
    targets = formation.matched(a, b)
    assert sorted(map(tuple, targets)) == sorted(map(tuple, b))
    closest = min(distances(a + u * (targets - a)).min() for u in np.linspace(0, 1, 101))
    assert closest >= min(distances(a).min(), distances(b).min()) / np.sqrt(2) - 1e-9
