"""The table of the pieces of several trajectories on the host, against the trajectories one by one."""

import jax
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from crazysim.lab.planning.piece_table import PieceTable
from crazysim.trajectories import Trajectory, spline

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
