"""Ground effect: that of Cheeseman and Bennett where their formula holds, and bounded elsewhere."""

import jax
import numpy as np
from cases import hover_rotor_state, with_states

from crazysim import GroundEffect, Sim
from crazysim.plugins.effects import ground_effect

R = 0.0275
"""Radius of a propeller, m."""


thrust_gain = jax.jit(ground_effect.thrust_gain)


def gain(height, upright=1.0):
    return np.asarray(thrust_gain(*[np.float32([x]) for x in (height, upright, R)]), np.float64)[0]


def test_the_gain_is_that_of_cheeseman_and_bennett_from_one_radius_on():
    for z in (1.0, 1.5, 2.0, 4.0):
        expected = 1 / (1 - (1 / (4 * z)) ** 2)
        assert expected - 0.0145 < gain(z * R) <= expected
    np.testing.assert_allclose(gain(4 * R), 1 / (1 - 1 / 256), rtol=1e-4)
    np.testing.assert_allclose(gain(R), 1 / (1 - 1 / 16 / 1.25), rtol=1e-6)
    np.testing.assert_allclose(gain(1.0), 1.0, atol=1e-4)


def test_the_gain_is_bounded_on_the_floor_below_it_and_upside_down():
    for z in (0.0, -0.001, -1.0):
        np.testing.assert_allclose(gain(z), 4 / 3, rtol=1e-6)
    assert gain(0.0, -1.0) == 1
    gains = np.array([gain(z) for z in np.linspace(0, 0.2, 50)])
    assert np.all(np.diff(gains) < 0)


def test_a_drone_that_hovers_near_the_floor_is_lifted_and_levelled():
    """One step at hover speed: v = g dt (gain - 1); the lower rotors of a tilted drone push more and turn it back."""
    sim = Sim(n_worlds=3, control="rotor_vel")
    pos, quat = np.zeros((3, 1, 3)), np.zeros((3, 1, 4))
    pos[:, 0, 2] = 5.0, R, 0.05
    quat[..., 3] = 1.0
    quat[2, 0] = np.sin(0.1), 0, 0, np.cos(0.1)
    sim.data = with_states(sim.data, pos=pos, quat=quat, rotor_vel=hover_rotor_state(sim.data))
    sim.add(GroundEffect())
    sim.rotor_vel_control(np.asarray(sim.data.states.rotor_vel))
    sim.step()
    v, w = np.asarray(sim.data.states.vel)[:, 0, 2], np.asarray(sim.data.states.ang_vel)[:, 0]
    np.testing.assert_allclose(v[:2], [0, 0.002 * 9.81 * (1 / 0.95 - 1)], rtol=1e-4, atol=1e-6)  # float32 hover
    y = 0.035355 * np.array([-1, -1, 1, 1])
    gains = [gain(0.05 + np.sin(0.2) * a, np.cos(0.2)) for a in y]
    torque = np.sum(y * np.array(gains)) * 0.0434 * 9.81 / 4
    assert torque < -1e-5
    np.testing.assert_allclose(w[2, 0], 0.002 * torque / 25e-6, rtol=1e-4)
    np.testing.assert_allclose(w[:2], 0.0, atol=1e-6)
    assert sim.data.params.rpm2thrust.shape == (1, 3)
