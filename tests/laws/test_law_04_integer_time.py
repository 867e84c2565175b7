"""Law 4: time is an integer step; controllers fire when ``step % period == 0``, and their rates divide ``freq``."""

import dataclasses

import numpy as np
import pytest
from cases import CHOSEN_PAIRS, command_in_force, hover_command, repeat_command, with_states

from crazysim import Cars, ConfigError, Sim
from crazysim.trajectories import circle

PERIOD = 5
COMPILED_PAIRS = (("first_principles", "state"), ("so_rpy_rotor_drag", "state"))
"""Pairs that contain the controllers of all others. They run on the default engine, the others on the interpreter."""
RATES = {f"{level}_freq": 100 for level in ("state", "attitude", "body_rate", "force_torque")}


@pytest.mark.parametrize("dynamics, control", CHOSEN_PAIRS)
def test_a_command_is_taken_over_at_its_tick(dynamics, control):
    """Law 4: every step gets another command; the last command at a tick of a world is in force there.

    A masked reset after seven steps puts the second world out of phase.
    """
    engine = "auto" if (dynamics, control) in COMPILED_PAIRS else "interpret"
    sim = Sim(2, dynamics=dynamics, control=control, freq=500, engine=engine, **RATES)
    sim.data = with_states(sim.data, pos=[0.0, 0.0, 5.0])
    period = 1 if control == "rotor_vel" else PERIOD
    hover = repeat_command(sim.data, hover_command(sim.data, (0.0, 0.0, 5.0)))
    steps, in_force = np.zeros(2, int), [None, None]
    for k in range(18):
        if k == 7:
            sim.reset(np.array([False, True]))
            steps[1] = 0
        command = (hover * (1 + 1e-3 * k)).astype(np.float32)
        getattr(sim, f"{control}_control")(command)
        fires = steps % period == 0
        np.testing.assert_array_equal(sim.controllable[:, 0], fires)
        sim.step()
        steps += 1
        for world in range(2):
            in_force[world] = command[world] if fires[world] else in_force[world]
            np.testing.assert_array_equal(command_in_force(sim.data)[world], in_force[world], err_msg=f"step {k}")
        np.testing.assert_array_equal(sim.data.core.steps[:, 0], steps)
    assert not np.array_equal(steps % PERIOD, steps[::-1] % PERIOD)  # the worlds did run out of phase
    assert sim.data.core.steps.dtype == np.int32
    np.testing.assert_allclose(sim.time[:, 0], steps / 500, rtol=1e-6)  # one float32 division


@pytest.mark.parametrize(
    "level, rate, nearest",
    [("state", 300, 250), ("attitude", 501, 500), ("body_rate", 1000, 500), ("force_torque", 99, 50)],
)
def test_a_rate_that_does_not_divide_names_the_nearest(level, rate, nearest):
    """Law 4: rates that would fire between steps are refused, with the next rate below that would do."""
    with pytest.raises(ConfigError, match=rf"{level}_freq is {rate} Hz.*nearest.*\b{nearest} Hz"):
        Sim(control=level, freq=500, **{f"{level}_freq": rate})


@pytest.mark.parametrize(
    "name, rate", [("freq", 0), ("freq", -100), ("freq", 100.0), ("attitude_freq", True), ("attitude_freq", "100")]
)
def test_a_rate_is_a_positive_whole_number(name, rate):
    with pytest.raises(ValueError, match=rf"{name}.*positive whole number"):
        Sim(**{name: rate})


@pytest.mark.parametrize(
    "settings, fragments",
    [
        ({"control": "state", "freq": 499}, ("near 100 Hz", "outer_freq", "got 499 Hz", "1 Hz", "freq=500")),
        ({"control": "state", "freq": 5}, ("near 100 Hz", "outer_freq", "got 5 Hz", "freq=100")),
        ({"freq": 5}, ("near 500 Hz", "freq of controller 'auto'", "got 5 Hz", "freq=100")),
        ({"control": "body_rate", "freq": 50}, ("near 500 Hz", "freq of controller 'auto'", "freq=100")),
        ({"control": "force_torque", "freq": 751}, ("near 500 Hz", "force_torque_freq", "freq=752")),
        (
            {"control": "state", "dynamics": "so_rpy", "freq": 5},
            ("near 100 Hz", "freq of controller 'auto'", "freq=50"),
        ),
        ({"control": "state", "controller": "pid", "freq": 499}, ("outer_freq of controller 'pid'", "freq=500")),
        ({"control": "state", "controller": "mellinger", "freq": 997}, ("freq of controller 'mellinger'", "freq=998")),
    ],
)
def test_a_default_rate_far_below_what_is_documented_names_the_nearest_good_freq(settings, fragments):
    """Law 4: at 499 Hz, a prime number, the state controller would run once a second."""
    with pytest.raises(ConfigError) as error:
        Sim(**settings)
    for fragment in fragments:
        assert fragment in str(error.value)
    Sim(**settings | {"freq": int(str(error.value).split("Use freq=")[1].split(",")[0])})


@pytest.mark.parametrize(
    "settings",
    [
        {"freq": 125},
        {"freq": 240, "control": "state"},
        {"freq": 499, "control": "state", "controller": "mellinger"},
        {"freq": 499, "control": "state", "state_freq": 1},
        {"freq": 20, "control": "rotor_vel"},
        {"freq": 50, "dynamics": "so_rpy_rotor"},
        {"freq": 20, "attitude_freq": 20},
        {"freq": 20, "control": "force_torque"},
    ],
)
def test_rates_near_the_default_and_rates_that_are_set_stay(settings):
    assert Sim(**settings).control_freq > 0


def test_a_default_rate_of_cars_is_checked_like_those_of_controllers():
    cars, path = Cars(1), circle(radius=1.0)
    with pytest.raises(ConfigError, match=r"near 50 Hz, the default of freq of 'cars', got 499 Hz.*1 Hz.*freq=500"):
        Sim(freq=499, control="rotor_vel").add(dataclasses.replace(cars, path=path))
    Sim(freq=499, control="rotor_vel").add(dataclasses.replace(cars, path=path, freq=1))
