"""Downwash: a value worked out by hand, the laws of a jet, and who blows at whom."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import hover_rotor_state, with_states

from crazysim import ConfigError, Downwash, Sim
from crazysim.plugins.effects import downwash

# World by world: one above the other, side by side, upper one tilted by 90 degrees (thrust along x), coincident.
POS = np.array([
    [[0, 0, 2.0], [0, 0, 1.5], [0.1, 0, 1.0]],
    [[0, 0, 1.0], [0.3, 0, 1.0], [0, 0.3, 1.0]],
    [[0, 0, 1.0], [-0.5, 0, 1.0], [0, 0, 0.5]],
    [[0, 0, 1.0], [0, 0, 1.0], [0, 0, 1.0]],
])  # fmt: skip
HALF = np.sqrt(0.5)


@pytest.fixture(scope="module")
def sim():
    sim = Sim(n_worlds=4, n_drones=3, control="rotor_vel")
    quat = np.zeros((4, 3, 4))
    quat[..., 3] = 1.0
    quat[2, 0] = 0, HALF, 0, HALF
    sim.data = with_states(sim.data, pos=POS, quat=quat, rotor_vel=hover_rotor_state(sim.data))
    sim.add(Downwash())
    return sim


@pytest.fixture(scope="module")
def air(sim):
    return np.asarray(blow(sim, sim.data), np.float64)


compiled = functools.cache(jax.jit)


def blow(sim, data):
    """Return the velocity of the air at the drones. (n_worlds, n_drones, 3)"""
    return np.asarray(compiled(sim.step_pipeline["downwash"])(data).plugins["downwash"].air_vel)


def by_hand(below, off, thrust=0.0434 * 9.81):
    """Return the speed for a Crazyflie 2.1 Brushless, d = sqrt(8) 27.5 mm = 77.8 mm, at sea level."""
    d = 0.07778
    start = np.sqrt(4 * thrust / (np.pi * 1.225)) / d
    return start / (1 + below / (5.8 * d)) / (1 + 0.41421 * (off / (0.094 * (below + 5.8 * d))) ** 2) ** 2


def test_the_jet_is_as_strong_as_worked_out_by_hand(air):
    """Half a metre below: 8.55 m/s at the rotors, over 1 + 0.5 / 0.451, is 4.06 m/s; half of that at 8.9 cm off."""
    assert abs(by_hand(0.5, 0.0) - 4.06) < 0.01
    assert abs(by_hand(0.5, 0.0894) / by_hand(0.5, 0.0) - 0.5) < 0.002
    np.testing.assert_allclose(air[0, 1], [0, 0, -by_hand(0.5, 0)], rtol=1e-4, atol=1e-6)  # numbers of four digits
    both = by_hand(1.0, 0.1) + by_hand(0.5, 0.1)
    np.testing.assert_allclose(air[0, 2], [0, 0, -both], rtol=1e-4, atol=1e-6)


def test_nothing_is_blown_upwards_sideways_or_at_oneself(air):
    np.testing.assert_array_equal(air[0, 0], 0.0)
    np.testing.assert_array_equal(air[1], 0.0)
    np.testing.assert_array_equal(air[3], 0.0)


def test_the_jet_leaves_against_the_thrust(air):
    """A drone on its side, thrusting along x, blows at the one behind it, and not at the one below it."""
    np.testing.assert_allclose(air[2, 1], [-by_hand(0.5, 0), 0, 0], rtol=1e-4, atol=1e-6)
    # what arrives there comes from the level one, half a metre aside; float32 turns the other's jet by 1e-7
    np.testing.assert_allclose(air[2, 2], [0, 0, -by_hand(0.5, 0.5)], rtol=1e-4, atol=1e-6)


def test_the_jet_carries_the_momentum_that_the_thrust_needs():
    """rho times the integral of u^2 over a level plane is T, at every depth; B and S as measured give 4 % less."""
    r = np.linspace(0, 3, 20001, dtype=np.float32)[:, None]
    one = [np.float32([x]) for x in (0.426, 0.0778, 1.225)]
    for depth in (0.3, 1.0, 2.0):
        apart = np.concatenate([r, 0 * r, 0 * r - np.float32(depth)], axis=-1)
        u = np.asarray(jax.jit(downwash.hover_jet_speed)(apart, np.float32([0, 0, 1.0]), *one), np.float64)[:, 0]
        flux = 1.225 * 2 * np.pi * np.trapezoid(u**2 * r[:, 0], r[:, 0])
        assert 0.95 < flux / 0.426 < 0.965


def test_the_lower_drone_is_pushed_down_by_its_drag_and_the_users_force_stays(sim):
    """First step from rest in hover: v = -dt D_z u / m, D_z = 24.77 mN s/m, m = 43.4 g."""
    before = sim.data
    sim.data = with_states(before, force=[0.1, 0, 0])
    sim.rotor_vel_control(np.asarray(before.states.rotor_vel))
    sim.step()
    states = jax.device_get(sim.data.states)
    sim.data = before
    fall = 0.002 * 0.02477 / 0.0434 * by_hand(0.5, 0.0)
    np.testing.assert_allclose(states.vel[0, 1, 2], -fall, rtol=5e-4)  # four digits; float32 hover to 1e-7 m/s^2 g dt
    np.testing.assert_allclose(states.vel[0, 0, 2], 0.0, atol=1e-7)
    np.testing.assert_array_equal(states.force, np.broadcast_to(np.float32([0.1, 0, 0]), (4, 3, 3)))


def test_still_rotors_blow_nothing(sim):
    data = with_states(sim.data, rotor_vel=0.0)
    np.testing.assert_array_equal(blow(sim, data), 0.0)


def test_a_mirrored_or_turned_world_is_blown_at_alike(sim, rng):
    """Places turned about the vertical or mirrored, the air turns along: the jet is round."""
    pos = rng.uniform(-0.3, 0.3, (4, 3, 3))
    blown = []
    c, s = np.cos(1.0), np.sin(1.0)
    for M in (np.eye(3), np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.diag([-1.0, 1, 1])):
        data = with_states(sim.data, pos=pos @ M.T, quat=[0, 0, 0, 1.0])
        blown.append(np.asarray(blow(sim, data)))
    assert np.abs(blown[0]).max() > 1.0
    np.testing.assert_allclose(blown[1], blown[0], atol=1e-5)  # float32 of places of 0.3 m, gradients of 100 /s
    np.testing.assert_allclose(blown[2], blown[0], atol=1e-5)


def test_law_07_gradients_are_finite_where_drones_coincide_and_rotors_stand(sim):
    def total(pos, rotor_vel, quat):
        states = sim.data.states.replace(pos=pos, rotor_vel=rotor_vel, quat=quat)
        data = sim.step_pipeline["downwash"](sim.data.replace(states=states))
        return jnp.sum(data.plugins["downwash"].air_vel ** 2)

    s, slopes = jax.device_get(sim.data.states), jax.jit(jax.grad(total, (0, 1, 2)))
    for rotor_vel in (s.rotor_vel, 0 * s.rotor_vel):
        for g in slopes(s.pos, rotor_vel, s.quat):
            assert np.isfinite(g).all()


def test_law_07_above_the_drone_the_virtual_origin_does_no_harm():
    """Where the distance to the virtual origin is exactly zero, a formula of the far field would divide by it."""
    one = [jnp.array([x]) for x in (0.4, 0.125, 1.225)]
    apart = np.float32([0.1, 0.0, downwash.DECAY * 0.125])  # a power of two: the product is exact
    value, gradient = jax.jit(
        jax.value_and_grad(lambda x: downwash.hover_jet_speed(x, jnp.array([0, 0, 1.0]), *one)[0])
    )(apart)
    assert value == 0
    np.testing.assert_array_equal(gradient, 0.0)


def test_fitted_models_blow_too():
    """The thrust of ``so_rpy_rotor_drag`` is its rotor state times a coefficient."""
    sim = Sim(n_drones=2, dynamics="so_rpy_rotor_drag")
    thrust = 0.4
    sim.data = with_states(sim.data, pos=[[0, 0, 2.0], [0, 0, 1.5]], rotor_vel=thrust)
    sim.add(Downwash())
    air = blow(sim, sim.data)
    np.testing.assert_allclose(air[0, 1, 2], -by_hand(0.5, 0, 0.959471532998666 * thrust), rtol=1e-4)


def test_law_09_a_radius_that_cannot_be_is_told():
    sim = Sim()
    with pytest.raises(ConfigError, match=r"propeller_radius.*positive"):
        sim.add(Downwash(propeller_radius=0.0))
    with pytest.raises(ConfigError, match="downwash acts through drag"):
        Sim(dynamics="so_rpy").add(Downwash())
