"""Due times of control steps by a clock of the test, and statistics of their lateness."""

import numpy as np
import pytest
from waiting import Clock

from crazysim.errors import ConfigError
from crazysim.lab.live.pace import BIN_WIDTH, MAX_LAG, Pace


@pytest.fixture
def clock():
    return Clock()


def test_due_times_do_not_depend_on_the_duration_of_steps(clock):
    pace = Pace(0.01, 0.5, clock)
    for k in range(5):
        np.testing.assert_allclose(10.0 + 0.02 * k - clock.now, pace.time_until_due(), atol=1e-12)
        clock.now += max(pace.time_until_due(), 0.0)
        pace.record_step(0.01 * k)
        clock.now += 0.013
    assert pace.n_steps == 5
    assert pace.n_late_steps == 0
    assert pace.max_lateness < 1e-9


def test_a_late_step_is_counted_and_caught_up(clock):
    pace = Pace(0.01, 1.0, clock)
    pace.record_step(0.0)
    clock.now += 0.025
    np.testing.assert_allclose(pace.record_step(0.01), 0.015)
    assert pace.time_until_due() < 0, "the next one is due at once"
    np.testing.assert_allclose(pace.record_step(0.02), 0.005)
    assert pace.time_until_due() > 0
    assert (pace.n_late_steps, pace.lost_s) == (2, 0.0)
    np.testing.assert_allclose((pace.max_lateness, pace.max_lateness_time), (0.015, 0.01))


def test_a_lag_beyond_the_limit_is_not_caught_up(clock):
    pace = Pace(0.01, 1.0, clock)
    pace.record_step(0.0)
    clock.now += 1.01
    pace.record_step(0.01)
    np.testing.assert_allclose(pace.lost_s, 1.0)
    np.testing.assert_allclose(pace.time_until_due(), 0.01)
    assert MAX_LAG < 1.0


def test_quantiles_of_lateness(clock):
    """999 of 1000 steps are on time, and one step is 7 ms late."""
    pace = Pace(1.0, 1.0, clock)
    for k in range(1000):
        clock.now = 10.0 + k + (0.007 if k == 500 else 0.0)
        pace.record_step(k)
    assert pace.quantile(0.999) <= BIN_WIDTH + 1e-9
    np.testing.assert_allclose(pace.quantile(1.0), 0.007, atol=1e-9)


def test_as_fast_as_possible_nothing_is_late(clock):
    pace = Pace(0.01, "max", clock)
    for k in range(10):
        assert pace.time_until_due() == 0
        clock.now += 1.0
        pace.record_step(k)
    assert (pace.n_late_steps, pace.max_lateness, pace.quantile(0.999)) == (0, 0.0, 0.0)


def test_a_change_of_speed_takes_effect_at_once(clock):
    pace = Pace(0.01, 1.0, clock)
    pace.record_step(0.0)
    clock.now += 0.004
    pace.speed = 0.1
    assert pace.time_until_due() == 0
    pace.record_step(0.01)
    np.testing.assert_allclose(pace.time_until_due(), 0.1)


@pytest.mark.parametrize("speed", [0, -1, float("nan"), float("inf"), "fast", True])
def test_wrong_speeds(speed):
    with pytest.raises(ConfigError, match="positive speed or 'max'"):
        Pace(0.01, speed)
