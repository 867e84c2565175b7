"""Downwash: speeds by hand, momentum and symmetry of the jet, and which drones it reaches."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import hover_rotor_state, with_states

from crazysim import Downwash, Sim
from crazysim.plugins.effects import downwash

# Worlds: drones above each other, side by side, one tilted by 90 degrees (thrust along x), all at one point.
POS = np.array([
    [[0, 0, 2.0], [0, 0, 1.5], [0.1, 0, 1.0]],
    [[0, 0, 1.0], [0.3, 0, 1.0], [0, 0.3, 1.0]],
    [[0, 0, 1.0], [-0.5, 0, 1.0], [0, 0, 0.5]],
    [[0, 0, 1.0], [0, 0, 1.0], [0, 0, 1.0]],
])  # fmt: skip
SQRT_HALF = np.sqrt(0.5)


@pytest.fixture(scope="module")
def sim():
    sim = Sim(n_worlds=4, n_drones=3, control="rotor_vel")
    quat = np.zeros((4, 3, 4))
    quat[..., 3] = 1.0
    quat[2, 0] = 0, SQRT_HALF, 0, SQRT_HALF
    sim.data = with_states(sim.data, pos=POS, quat=quat, rotor_vel=hover_rotor_state(sim.data))
    sim.add(Downwash())
    return sim


@pytest.fixture(scope="module")
def air(sim):
    """Return the velocity of the air at the drones. (n_worlds, n_drones, 3)"""
    return np.asarray(air_velocity(sim, sim.data), np.float64)


jit_once = functools.cache(jax.jit)


def air_velocity(sim, data):
    """Return the velocity of the air at the drones. (n_worlds, n_drones, 3)"""
    return np.asarray(jit_once(sim.step_pipeline["downwash"])(data).plugins["downwash"].air_vel)


def jet_speed(below, radius, thrust=0.0434 * 9.81):
    """Return the speed of the jet of a Crazyflie 2.1 Brushless, d = sqrt(8) 27.5 mm = 77.8 mm, at sea level, m/s."""
    d = 0.07778
    start = np.sqrt(4 * thrust / (np.pi * 1.225)) / d
    return start / (1 + below / (5.8 * d)) / (1 + 0.41421 * (radius / (0.094 * (below + 5.8 * d))) ** 2) ** 2


def test_the_speed_of_the_jet_by_hand(air):
    """Half a metre below: 8.55 m/s at the rotors, over 1 + 0.5 / 0.451, is 4.06 m/s; half of that at 8.9 cm off."""
    assert abs(jet_speed(0.5, 0.0) - 4.06) < 0.01
    assert abs(jet_speed(0.5, 0.0894) / jet_speed(0.5, 0.0) - 0.5) < 0.002
    np.testing.assert_allclose(air[0, 1], [0, 0, -jet_speed(0.5, 0)], rtol=1e-4, atol=1e-6)  # numbers of four digits
    sum_of_jets = jet_speed(1.0, 0.1) + jet_speed(0.5, 0.1)
    np.testing.assert_allclose(air[0, 2], [0, 0, -sum_of_jets], rtol=1e-4, atol=1e-6)


def test_a_jet_reaches_neither_its_own_drone_nor_those_above_and_beside_it(air):
    np.testing.assert_array_equal(air[0, 0], 0.0)
    np.testing.assert_array_equal(air[1], 0.0)
    np.testing.assert_array_equal(air[3], 0.0)


def test_the_jet_is_opposite_to_the_thrust(air):
    """The jet of a drone on its side, with thrust along x, reaches the drone behind it, and not the one below it."""
    np.testing.assert_allclose(air[2, 1], [-jet_speed(0.5, 0), 0, 0], rtol=1e-4, atol=1e-6)
    # the jet is that of the level drone, half a metre aside; float32 turns the other jet by 1e-7
    np.testing.assert_allclose(air[2, 2], [0, 0, -jet_speed(0.5, 0.5)], rtol=1e-4, atol=1e-6)


def test_the_jet_carries_the_momentum_that_the_thrust_needs():
    """rho times the integral of u^2 over a level plane is T, at every depth; the measured B and S give 4 % less."""
    r = np.linspace(0, 3, 20001, dtype=np.float32)[:, None]
    parameters = [np.float32([x]) for x in (0.426, 0.0778, 1.225)]
    for depth in (0.3, 1.0, 2.0):
        offset = np.concatenate([r, 0 * r, 0 * r - np.float32(depth)], axis=-1)
        u = np.asarray(jax.jit(downwash.hover_jet_speed)(offset, np.float32([0, 0, 1.0]), *parameters), np.float64)[
            :, 0
        ]
        flux = 1.225 * 2 * np.pi * np.trapezoid(u**2 * r[:, 0], r[:, 0])
        assert 0.95 < flux / 0.426 < 0.965


def test_the_drag_pushes_the_lower_drone_down_and_the_force_of_the_user_stays(sim):
    """First step from rest in hover: v = -dt D_z u / m, D_z = 24.77 mN s/m, m = 43.4 g."""
    before = sim.data
    sim.data = with_states(before, force=[0.1, 0, 0])
    sim.rotor_vel_control(np.asarray(before.states.rotor_vel))
    sim.step()
    states = jax.device_get(sim.data.states)
    sim.data = before
    fall = 0.002 * 0.02477 / 0.0434 * jet_speed(0.5, 0.0)
    np.testing.assert_allclose(states.vel[0, 1, 2], -fall, rtol=5e-4)  # four digits; float32 hover to 1e-7 m/s^2 g dt
    np.testing.assert_allclose(states.vel[0, 0, 2], 0.0, atol=1e-7)
    np.testing.assert_array_equal(states.force, np.broadcast_to(np.float32([0.1, 0, 0]), (4, 3, 3)))


def test_law_07_above_the_drone_the_virtual_origin_does_no_harm():
    """Where the distance to the virtual origin is exactly zero, a formula of the far field would divide by it."""
    parameters = [jnp.array([x]) for x in (0.4, 0.125, 1.225)]
    offset = np.float32([0.1, 0.0, downwash.JET_DECAY * 0.125])  # a power of two: the product is exact
    value, gradient = jax.jit(
        jax.value_and_grad(lambda x: downwash.hover_jet_speed(x, jnp.array([0, 0, 1.0]), *parameters)[0])
    )(offset)
    assert value == 0
    np.testing.assert_array_equal(gradient, 0.0)


def test_drones_with_fitted_models_have_jets():
    """The thrust of ``so_rpy_rotor_drag`` is its rotor state times a coefficient."""
    sim = Sim(n_drones=2, dynamics="so_rpy_rotor_drag")
    thrust = 0.4
    sim.data = with_states(sim.data, pos=[[0, 0, 2.0], [0, 0, 1.5]], rotor_vel=thrust)
    sim.add(Downwash())
    air = air_velocity(sim, sim.data)
    np.testing.assert_allclose(air[0, 1, 2], -jet_speed(0.5, 0, 0.959471532998666 * thrust), rtol=1e-4)
