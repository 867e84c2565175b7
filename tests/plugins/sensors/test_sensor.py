"""Rate, delay, jitter and loss of measurements, with a sensor that measures the number of the step."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import ConfigError, RangeFinder, Sim
from crazysim.plugins.sensors import Barometer, Camera, Sensor, White


class Clock(Sensor):
    _: dataclasses.KW_ONLY
    name: str = "clock"

    channels: ClassVar = {"step": 1}

    def ideal(self, data):
        return jnp.full(1, -7.0)

    def measure(self, data, key):
        return data.core.steps[None].astype(jnp.float32), self


def record_clock(n_steps, n_worlds=1, n_drones=1, **settings):
    """Return the last measurement after every step and its age, (n_steps, n_worlds, n_drones), and the simulation."""
    sim = Sim(n_worlds, n_drones, control="rotor_vel", engine="interpret", rng_key=2)
    clock = sim.add(Clock(**settings))
    values, age = [], []
    for _ in range(n_steps):
        sim.step()
        values.append(np.asarray(sim.plugins.observations(sim.data)["clock.step"])[..., 0])
        age.append(np.asarray(clock.age(sim.data))[..., 0] * sim.freq)
    return np.array(values), np.array(age), sim


def test_a_measurement_is_held_until_the_next_one():
    values, age, sim = record_clock(12, freq=100)
    np.testing.assert_array_equal(values[:, 0, 0], [0] * 5 + [5] * 5 + [10] * 2)
    np.testing.assert_allclose(age[:, 0, 0], np.arange(12) % 5, atol=1e-5)
    assert "clock_arrival" not in sim.step_pipeline


def test_a_measurement_arrives_after_the_delay_of_its_drone():
    delay = np.array([[0.0, 0.006], [0.01, 0.025]])  # 0, 3, 5 and 12.5 steps, which are rounded to 12
    values, age, _ = record_clock(24, 2, 2, freq=100, delay=delay)
    steps = np.arange(24)[:, None, None]
    delay_steps = np.array([[0, 3], [5, 12]])
    expected = np.where(steps >= delay_steps, (steps - delay_steps) // 5 * 5, -7)
    np.testing.assert_array_equal(values, expected)
    np.testing.assert_allclose(age[expected >= 0], (steps - expected)[expected >= 0], atol=1e-4)


def test_jitter_delays_within_its_bounds_and_never_goes_back():
    values, age, _ = record_clock(60, 100, delay=0.004, jitter=0.01)
    has_arrived = values >= 0
    assert has_arrived[7:].all()
    assert (np.diff(values[7:], axis=0) >= 0).all()
    assert age[has_arrived].min() >= 2 - 1e-4
    assert age[has_arrived].max() <= 7 + 1e-4
    # Every step sends a measurement: the last one is the newest whose delay of 2 + round(5 u) steps is over.
    probability = np.array([0.1, 0.2, 0.2, 0.2, 0.2, 0.1])
    expected = np.cumsum(probability) * np.concatenate([[1], np.cumprod(1 - np.cumsum(probability))[:-1]])
    result = [np.mean(np.isclose(age[10:], 2 + k)) for k in range(6)]
    np.testing.assert_allclose(result, expected, atol=4 * np.sqrt(0.25 / 5000) * 2)  # neighbours are correlated


def test_lost_measurements_leave_the_last_one():
    for delay in (0.0, 0.004):
        values, _, _ = record_clock(40, 200, dropout=0.3, delay=delay)
        changed = np.diff(values[5:], axis=0) > 0
        assert abs(changed.mean() - 0.7) < 4 * np.sqrt(0.21 / changed.size)
    values, _, _ = record_clock(3, dropout=1.0)
    assert (values == -7).all()


def test_a_default_rate_adapts_and_a_rate_of_the_user_is_refused():
    assert [Barometer().rate(freq) for freq in (500, 250, 240, 30)] == [50, 50, 48, 30]
    sim = Sim(control="attitude", freq=250, estimator="complementary", plugins=[RangeFinder(), Camera(2, 1)])
    assert sim.plugins["complementary"].freq == 250
    with pytest.raises(ConfigError, match="divisor near 50 Hz, the default of freq of 'barometer'"):
        Barometer().rate(251)


def test_a_sensor_without_channels_is_an_error_that_names_it():
    class Incomplete(Sensor):
        """Defines nothing."""

    with pytest.raises(ConfigError, match="expected channels of Incomplete, got none"):
        Sim().add(Incomplete())


class Short(Sensor):
    name: str = "short"
    channels: ClassVar = {"vel": 3}
    chains: ClassVar = {"vel": []}

    def ideal(self, data):
        return data.states.vel[2:]


class Misspelt(Short):
    chains: ClassVar = {"velocity": []}


@pytest.mark.parametrize("kind, words", [
    (Short, r"of 'short' .*{'vel': 3}, got shape \(1,\)"),
    (Misspelt, "expected chains of 'short' for channels vel, got velocity"),
])  # fmt: skip
def test_law_09_truth_and_errors_fit_the_channels(kind, words):
    with pytest.raises(ConfigError, match=words):
        Sim(plugins=[kind()]).step()


@pytest.mark.parametrize(
    ("chain", "message"),
    [
        ([White("nois")], "expected a number or a state in the chain of 'step', got 'nois'. Add nois: Param"),
        (White("delay"), r"expected the chain of 'step' as a tuple of errors.*Use \(White"),
    ],
)
def test_law_09_a_chain_that_does_not_fit_its_sensor_is_named(chain, message):
    class Noisy(Clock):
        chains: ClassVar = {"step": chain}

    with pytest.raises(ConfigError, match=message):
        Sim(plugins=[Noisy()])
    with pytest.raises(ConfigError, match=r"expected names of .*White, got 0\.1"):
        White(0.1)
