"""Motors: forces and torques of weak and failed rotors, calculated from the airframe's numbers, and the times at which
rotors fail."""

import jax
import numpy as np
import pytest
from cases import hover_rotor_state, with_states

from crazysim import MotorFailure, Sim

DT = 1 / 500


def build(n_worlds=3, n_drones=2, **kwargs):
    sim = Sim(n_worlds=n_worlds, n_drones=n_drones, control="rotor_vel", rng_key=1)
    sim.data = with_states(sim.data, pos=[0, 0, 10.0], rotor_vel=hover_rotor_state(sim.data))
    sim.build_default_data()
    sim.add(MotorFailure(**kwargs))
    sim.rotor_vel_control(np.asarray(sim.data.states.rotor_vel))
    return sim


def effectiveness(sim):
    return np.asarray(sim.data.plugins["motors"].effectiveness)


@pytest.fixture(scope="module")
def weak_sim():
    effectiveness = np.ones((3, 2, 4))
    effectiveness[0, 0] = 0.0  # all gone
    effectiveness[0, 1, 2] = 0.0  # rotor 2 gone
    effectiveness[1, 0] = 0.5
    effectiveness[1, 1] = 0.9, 1.0, 0.7, 1.0
    return build(effectiveness=effectiveness)


def test_a_failed_rotor_gives_no_thrust_and_a_weak_one_its_fraction(weak_sim):
    """One step from hover: v = g dt (mean effectiveness - 1), and J w' = the torque that remains."""
    sim, before = weak_sim, weak_sim.data
    sim.step()
    after, sim.data = sim.data, before
    states = jax.device_get(after.states)
    e = effectiveness(sim)
    np.testing.assert_allclose(states.vel[..., 2], 9.81 * DT * (e.mean(axis=-1) - 1), rtol=1e-5, atol=1e-7)  # float32
    p, speed = before.params, np.asarray(before.states.rotor_vel, np.float64)
    thrust = e * 0.0434 * 9.81 / 4
    arm, J = 0.035355, np.array([25e-6, 28e-6, 49e-6])
    y, x, spin = np.array([-1, -1, 1, 1]), np.array([1, -1, -1, 1]), np.array([-1, 1, -1, 1])
    np.testing.assert_allclose(states.ang_vel[..., 0], DT / J[0] * (arm * y * thrust).sum(-1), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(states.ang_vel[..., 1], DT / J[1] * (-arm * x * thrust).sum(-1), rtol=1e-4, atol=1e-5)
    # About z: the propellers' drag, and what rotors that run down give back to the body.
    drag = e * (1.65886356219615e-9 * speed + 2.4693477924534137e-12 * speed**2)
    slow_down = np.where(e > 0, 0.0, -5.933168530682111 * speed - 0.00031951312393561264 * speed**2)
    torque = (spin * (drag + 38.93e-9 * 2 * np.pi / 60 * slow_down)).sum(-1)
    np.testing.assert_allclose(states.ang_vel[..., 2], DT / J[2] * torque, rtol=1e-4, atol=1e-5)
    assert np.array_equal(p.rpm2thrust, after.params.rpm2thrust)


def test_rotors_fail_in_their_step_until_a_reset():
    fail_step = np.full((3, 2, 4), -1)
    fail_step[0, 0, 1], fail_step[1, 1] = 4, [7, -1, 0, 9]
    sim = build(fail_step=fail_step)
    for step in range(12):
        sim.step()
        np.testing.assert_array_equal(effectiveness(sim), np.where((fail_step >= 0) & (fail_step <= step), 0.0, 1.0))
    sim.reset(np.array([False, True, False]))
    np.testing.assert_array_equal(effectiveness(sim)[1], 1.0)
    assert effectiveness(sim)[0, 0, 1] == 0


def test_rotors_fail_at_random_at_their_rate():
    """After t a fraction exp(-rate t) still works; failed rotors stay failed."""
    n = 2048
    sim = build(n_worlds=n, n_drones=1, rate=[0.0, 5.0, 20.0, 5.0])
    sim.step(20)
    early = effectiveness(sim)
    sim.step(30)
    for steps, result in ((20, early), (50, effectiveness(sim))):
        working = np.exp(-np.array([0.0, 5.0, 20.0, 5.0]) * steps * DT)
        # four standard errors of a binomial fraction
        np.testing.assert_array_less(np.abs((result == 1).mean(axis=(0, 1)) - working), 4 * np.sqrt(0.25 / n))
    assert np.all(effectiveness(sim) <= early)
    assert set(np.unique(effectiveness(sim))) == {0.0, 1.0}
    pairs = (effectiveness(sim)[:, 0, 1] == 1) & (effectiveness(sim)[:, 0, 3] == 1)
    assert abs(pairs.mean() - np.exp(-1.0)) < 4 * np.sqrt(0.25 / n), "rotors fail independently"


def test_fail_stops_the_rotors_of_its_mask(weak_sim):
    before = weak_sim.data
    mask = np.zeros((3, 2, 4), bool)
    mask[2, 1, 3] = True
    weak_sim.data = weak_sim.plugins["motors"].fail(weak_sim.data, mask)
    changed, weak_sim.data = effectiveness(weak_sim), before
    np.testing.assert_array_equal(changed != effectiveness(weak_sim), mask)
    assert changed[2, 1, 3] == 0
