"""Comparison of simulated with logged flights, on logs of flights that were simulated."""

import numpy as np
import pytest

from crazysim import ConfigError
from crazysim.lab.validate.closed_loop import (
    Flight,
    compare_tracking,
    laboratory_estimator,
    read_flight,
    simulate_flights,
)


@pytest.fixture(scope="module")
def circling_flight():
    """Return a setpoint that rises to 1 m and circles, and the flight of a simulated drone that follows it."""
    t = np.arange(0, 9, 0.01)
    angle = np.clip(t - 3, 0, None)
    setpoint = np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), np.clip(t / 2, 0.01, 1), 0.3 + 0 * t], axis=-1)
    resting_flight = Flight("still", setpoint, np.tile([0.5, 0.0, 0.0], (len(t), 1)))
    return setpoint, simulate_flights([resting_flight])[:, 0]


def write_log(path, setpoint, pos, rest=0.06, before=100):
    """Write a log in which the tracked body rests at a height, m, for ``before`` samples before the first setpoint."""
    n = len(pos) + before
    t = 1.7e9 + 0.01 * np.arange(n)
    setpoints = np.zeros((n, 4))
    setpoints[before:] = setpoint * [1, 1, 1, 180 / np.pi] + [0, 0, rest, 0]
    pos = np.concatenate([np.tile(pos[:1], (before, 1)), pos]) + [0, 0, rest]
    columns = {f"p{k}": pos[:, i] for i, k in enumerate("xyz")}
    columns |= {f"sp_ctrltarget_{k}": setpoints[:, i] for i, k in enumerate(("x", "y", "z", "yaw"))}
    np.savez(path, t=t, **columns)
    return path


def test_a_flight_of_the_simulation_is_matched(circling_flight, tmp_path):
    """The simulation repeats its own flight: equal positions, error and lag; the filter adds little error and lag."""
    path = write_log(tmp_path / "own.npz", *circling_flight)
    flight = read_flight(path)
    np.testing.assert_allclose(
        flight.pos, circling_flight[1][: len(flight.pos)], rtol=0, atol=2e-3
    )  # times of 1.7e9 s are rounded to 0.2 us
    (row,) = compare_tracking([flight])
    assert row.logged_error > 0.1
    assert abs(row.ratio - 1) < 0.01
    assert row.logged_lag == row.simulated_lag == pytest.approx(0.5, abs=0.1)  # 1 / kp of the position loop
    assert not row.failed
    (row,) = compare_tracking([flight], estimator=laboratory_estimator())
    assert 1.0 < row.ratio < 1.3


def test_a_flight_that_fails_is_marked(circling_flight, tmp_path):
    setpoint, pos = circling_flight
    departing_pos = pos + np.where(np.arange(len(pos)) > 700, 3.0, 0.0)[:, None]
    rows = compare_tracking(
        [read_flight(write_log(tmp_path / f"{k}.npz", setpoint, p)) for k, p in enumerate((pos, departing_pos))]
    )
    assert [row.failed for row in rows] == [False, True]
    assert rows[1].ratio < 0.5


def test_a_table_of_text_is_the_same_flight(circling_flight, tmp_path):
    path = write_log(tmp_path / "own.npz", *circling_flight)
    with np.load(path) as file:
        columns = dict(file)
    text = np.stack([*columns.values()], axis=-1)
    np.savetxt(tmp_path / "own.csv", text, delimiter=",", header=",".join(columns), comments="")
    from_npz, from_csv = read_flight(path), read_flight(tmp_path / "own.csv")
    np.testing.assert_allclose(from_csv.pos, from_npz.pos, rtol=0, atol=1e-12)
    np.testing.assert_allclose(from_csv.setpoint, from_npz.setpoint, rtol=0, atol=1e-12)


def test_other_logs_are_refused(tmp_path):
    np.savez(tmp_path / "other.npz", t=0.01 * np.arange(9))
    with pytest.raises(ConfigError, match="got no px"):
        read_flight(tmp_path / "other.npz")
    with pytest.raises(ConfigError, match="setpoint above the floor"):
        read_flight(write_log(tmp_path / "still.npz", np.full((50, 4), -1.0), np.zeros((50, 3))))
