"""Built-in stages: drones stand at their start, take off, land and fall."""

import numpy as np
import pytest
from cases import hover_rotor_state, weight, with_states

from crazysim import Sim
from crazysim.core import remove_fn
from crazysim.core.integration import FLOOR_HEIGHT, Integrator


@pytest.mark.parametrize("integrator", list(Integrator))
def test_a_drone_stands_at_its_start_takes_off_and_lands(integrator):
    """The floor carries it at the height of its start, and 1 mm lower once it has landed."""
    sim = Sim(2, control="rotor_vel", integrator=integrator, engine="plain")
    hover, start = hover_rotor_state(sim.data), sim.data.states
    push = [0.2 * weight(sim.data), 0, 0]
    sim.data = with_states(sim.data, force=push, torque=[1e-5, 0, 1e-4])
    for share in (0.0, 0.7):
        sim.rotor_vel_control(np.full((2, 1, 4), share * hover))
        sim.step(100)
        for name in ("pos", "quat", "vel", "ang_vel"):
            np.testing.assert_array_equal(getattr(sim.data.states, name), getattr(start, name), err_msg=name)
    sim.data = with_states(sim.data, force=0.0, torque=0.0)
    sim.rotor_vel_control(np.full((2, 1, 4), 1.2 * hover))
    sim.step(250)
    assert np.asarray(sim.data.states.pos)[..., 2].min() > 0.2
    sim.rotor_vel_control(np.zeros((2, 1, 4)))
    sim.step(1000)
    np.testing.assert_array_equal(np.asarray(sim.data.states.pos)[..., 2], np.float32(FLOOR_HEIGHT))
    np.testing.assert_array_equal(sim.data.states.vel, 0)


def test_a_drone_without_a_floor_falls_from_its_start():
    sim = Sim()
    remove_fn(sim.step_pipeline, "clip_floor_pos")
    sim.step(100)
    assert float(sim.data.states.pos[0, 0, 2]) < -0.15  # g t^2 / 2 = 0.196 m, less drag
