"""Law 4: time is an integer step; controllers fire when ``step % period == 0``, and their rates divide ``freq``."""

import numpy as np
import pytest
from cases import PAIRS, command_in_force, hover_command, to_all, with_states

from crazysim import ConfigError, Sim

PERIOD = 5
COMPILED = (("first_principles", "state"), ("so_rpy_rotor_drag", "state"))
"""Pairs with the controllers of all others: they run on the engine that users get, the others with nothing compiled."""
RATES = {f"{level}_freq": 100 for level in ("state", "attitude", "body_rate", "force_torque")}


@pytest.mark.kernels
@pytest.mark.parametrize("dynamics, control", PAIRS)
def test_a_command_is_taken_over_at_its_tick(dynamics, control):
    """Law 4: every step brings another command; in force is the last one that met a tick of its own world.

    A masked reset after seven steps puts the second world out of phase.
    """
    engine = "auto" if (dynamics, control) in COMPILED else "interpret"
    sim = Sim(2, dynamics=dynamics, control=control, freq=500, engine=engine, **RATES)
    sim.data = with_states(sim.data, pos=[0.0, 0.0, 5.0])
    period = 1 if control == "rotor_vel" else PERIOD
    hover = to_all(sim.data, hover_command(sim.data, (0.0, 0.0, 5.0)))
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


@pytest.mark.parametrize("level", ["state", "attitude", "body_rate", "force_torque"])
@pytest.mark.parametrize("rate, nearest", [(300, 250), (501, 500), (1000, 500), (99, 50)])
def test_a_rate_that_does_not_divide_names_the_nearest(level, rate, nearest):
    """Law 4: rates that would fire between steps are refused, with the next rate below that would do."""
    with pytest.raises(ConfigError, match=rf"{level}_freq is {rate} Hz.*nearest.*\b{nearest} Hz"):
        Sim(control=level, freq=500, **{f"{level}_freq": rate})


@pytest.mark.parametrize("rate", [0, -100, 100.0, True, "100"])
@pytest.mark.parametrize("name", ["freq", "attitude_freq"])
def test_a_rate_is_a_positive_whole_number(name, rate):
    """Law 4: no other rate has a period in steps."""
    with pytest.raises(ValueError, match=rf"{name}.*positive whole number"):
        Sim(**{name: rate})
