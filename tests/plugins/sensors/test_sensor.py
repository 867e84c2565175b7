"""Rate, delay, jitter and loss of measurements, with a sensor that measures the number of the step."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from crazysim import ConfigError, PyTree, Sim
from crazysim.plugins.sensors import Samples, Sensor


class ClockData(PyTree):
    samples: Samples


class Clock(Sensor):
    """Measures the number of the step."""

    _: dataclasses.KW_ONLY
    name: str = "clock"

    @property
    def channels(self):
        return {"step": 1}

    def record(self, sim):
        return ClockData(self.samples(sim))

    def ideal(self, data):
        return jnp.full(1, -7.0)

    def measure(self, data, record, key):
        return data.core.steps[None].astype(jnp.float32), record


def watch(n_steps, n_worlds=1, n_drones=1, **settings):
    """Return the measurement that is held after every step, and its age in steps. (n_steps, n_worlds, n_drones) each"""
    sim = Sim(n_worlds, n_drones, control="rotor_vel", engine="interpret", rng_key=2)
    clock = sim.add(Clock(**settings))
    held, age = [], []
    for _ in range(n_steps):
        sim.step()
        held.append(np.asarray(sim.plugins.observations(sim.data)["clock.step"])[..., 0])
        age.append(np.asarray(clock.age(sim.data))[..., 0] * sim.freq)
    return np.array(held), np.array(age), sim


def test_a_measurement_is_held_until_the_next_one():
    held, age, sim = watch(12, freq=100)
    np.testing.assert_array_equal(held[:, 0, 0], [0] * 5 + [5] * 5 + [10] * 2)
    np.testing.assert_allclose(age[:, 0, 0], np.arange(12) % 5, atol=1e-5)
    assert "clock_arrival" not in sim.step_pipeline


def test_it_arrives_after_the_delay_of_each_drone():
    delay = np.array([[0.0, 0.006], [0.01, 0.025]])  # 0, 3, 5 and 12.5 steps, which are rounded to 12
    held, age, _ = watch(24, 2, 2, freq=100, delay=delay)
    steps = np.arange(24)[:, None, None]
    late = np.array([[0, 3], [5, 12]])
    expected = np.where(steps >= late, (steps - late) // 5 * 5, -7)
    np.testing.assert_array_equal(held, expected)
    np.testing.assert_allclose(age[expected >= 0], (steps - expected)[expected >= 0], atol=1e-4)


def test_a_reset_empties_the_queue_of_its_world():
    sim = watch(10, 2, freq=100, delay=0.01)[2]
    sim.reset(np.array([False, True]))
    np.testing.assert_array_equal(np.asarray(sim.plugins.observations(sim.data)["clock.step"])[:, 0, 0], [0, -7])
    sim.step(6)
    np.testing.assert_array_equal(np.asarray(sim.plugins.observations(sim.data)["clock.step"])[:, 0, 0], [10, 0])


def test_jitter_delays_within_its_bounds_and_never_goes_back():
    held, age, _ = watch(60, 100, delay=0.004, jitter=0.01)
    known = held >= 0
    assert known[7:].all()
    assert (np.diff(held[7:], axis=0) >= 0).all()
    assert age[known].min() >= 2 - 1e-4
    assert age[known].max() <= 7 + 1e-4
    # Measurements of all steps are on their way: the newest of those whose delay of 2 + round(5 u) is over.
    late = np.array([0.1, 0.2, 0.2, 0.2, 0.2, 0.1])
    expected = np.cumsum(late) * np.concatenate([[1], np.cumprod(1 - np.cumsum(late))[:-1]])
    found = [np.mean(np.isclose(age[10:], 2 + k)) for k in range(6)]
    np.testing.assert_allclose(found, expected, atol=4 * np.sqrt(0.25 / 5000) * 2)  # neighbours are correlated


def test_lost_measurements_leave_the_last_one():
    for delay in (0.0, 0.004):
        held, _, _ = watch(40, 200, dropout=0.3, delay=delay)
        changed = np.diff(held[5:], axis=0) > 0
        assert abs(changed.mean() - 0.7) < 4 * np.sqrt(0.21 / changed.size)
    held, _, _ = watch(3, dropout=1.0)
    assert (held == -7).all()


def test_another_delay_compiles_nothing_with_room_for_it():
    sim = watch(20, delay=0.0, max_delay=0.02)[2]
    step = sim.step_fn
    sim.replace(Clock(delay=0.01, max_delay=0.02))
    assert sim.step_fn is step
    sim.step(8)
    assert np.asarray(sim.plugins.observations(sim.data)["clock.step"]).item() == 22


@pytest.mark.parametrize("settings, message", [
    ({"freq": 300}, "expected freq of 'clock' to divide"),
    ({"delay": -0.1, "max_delay": 0.1}, "expected delay"),
    ({"delay": 1.0}, "expected a delay of 'clock' of zero to 62 measurements"),
    ({"delay": np.nan}, "expected delay of Clock to be from 0 to 100, got nan"),
    ({"delay": 0.02, "max_delay": 0.01}, "expected delay"),
    ({"max_delay": -1.0}, "expected max_delay of Clock to be from 0 to 100, got -1"),
    ({"dropout": 1.5}, "expected dropout"),
])  # fmt: skip
def test_law_09_wrong_settings(settings, message):
    with pytest.raises(ConfigError, match=message):
        watch(0, **settings)


def test_a_sensor_without_a_record_says_what_it_lacks():
    class Bare(Sensor):
        """Defines nothing."""

    with pytest.raises(NotImplementedError, match="Bare needs kind, the class of its record"):
        Sim().add(Bare())
