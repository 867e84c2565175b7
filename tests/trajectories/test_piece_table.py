"""The table of the pieces of several trajectories on the host, against the trajectories one by one."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazysim import ConfigError
from crazysim.trajectories import Trajectory, spline
from crazysim.trajectories.piece_table import PieceTable

RNG = np.random.default_rng(2)
TRAJECTORIES = [
    spline(np.cumsum(RNG.uniform(0.5, 2.0, n)), RNG.normal(size=(n, 3)), degree, yaw=RNG.normal(size=n))
    for n, degree in ((4, 7), (2, 5), (6, 3))
]
TRAJECTORIES[1] = TRAJECTORIES[1].replace(repeats=np.bool_(True))
STARTS = np.array([0.5, 0.0, 2.0])
"""Time at which each drone starts, s."""
TABLE = PieceTable.create(TRAJECTORIES, STARTS, duration=12.0)
STACK = Trajectory.stack(TRAJECTORIES)
evaluate = jax.jit(lambda k, t: STACK.evaluate_one(k, t))


@given(drone=st.integers(0, 2), t=st.floats(0.01, 11.99))
def test_the_table_evaluates_as_the_trajectories(drone, t):
    setpoint = evaluate(drone, t - STARTS[drone])
    np.testing.assert_allclose(TABLE.evaluate(drone, t), [*setpoint.pos, *setpoint.yaw], atol=1e-4)
    end = STARTS[drone] + float(TRAJECTORIES[drone].duration)
    if abs(t - end) > 1e-3 and abs(t - STARTS[drone]) > 1e-3:  # there the derivatives jump
        for order, expected in enumerate((setpoint.vel, setpoint.acc, setpoint.jerk), start=1):
            np.testing.assert_allclose(TABLE.evaluate(drone, t, order)[:3], expected, atol=5e-3, rtol=1e-3)


EARLY_STARTS = np.array([-1.3, -7.7, -60.0])
EARLY_TABLE = PieceTable.create(TRAJECTORIES, EARLY_STARTS, duration=12.0)


@given(drone=st.integers(0, 2), t=st.floats(0.0, 12.0))
def test_drones_that_started_before_zero_are_in_the_middle(drone, t):
    """A trajectory that repeats is in one of its rounds; a trajectory that has ended stays at its end."""
    setpoint = evaluate(drone, t - EARLY_STARTS[drone])
    np.testing.assert_allclose(EARLY_TABLE.evaluate(drone, t), [*setpoint.pos, *setpoint.yaw], atol=1e-4)
    assert EARLY_TABLE.start[EARLY_TABLE.first_pieces].tolist() == [0.0, 0.0, 0.0]
    assert np.all(np.diff(EARLY_TABLE._keys) > 0)


def test_a_batch_is_evaluated_as_one_by_one():
    drones, times = np.repeat([0, 1, 2], 7), np.tile(np.linspace(0, 12, 7), 3)
    batch = TABLE.evaluate(drones, times, 1)
    one_by_one = [TABLE.evaluate(int(d), float(t), 1) for d, t in zip(drones, times, strict=True)]
    np.testing.assert_array_equal(batch, one_by_one)


def test_padding_adds_no_pieces():
    padded = TRAJECTORIES[0].padded(9, 7)
    assert len(PieceTable.create([padded]).start) == 3


def test_the_default_duration_ends_with_the_last_drone():
    ends = [float(t.duration) + s for t, s in zip(TRAJECTORIES, STARTS, strict=True)]
    assert PieceTable.create(TRAJECTORIES, STARTS).duration == max(ends)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (([],), "at least one"),
        ((TRAJECTORIES, [0.0, 1.0]), "each of 3 drones"),
        ((TRAJECTORIES, np.nan), "finite start"),
        ((TRAJECTORIES[:1], -100.0), "positive, finite duration.*end at -"),
        ((TRAJECTORIES, 0.0, np.nan), "positive, finite duration"),
    ],
)
def test_law_09_wrong_fleets_are_errors(arguments, message):
    with pytest.raises(ConfigError, match=message):
        PieceTable.create(*arguments)
