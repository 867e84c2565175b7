"""Rotors in moving air: against roots of the equations, values by hand, and recorded wrenches of RotorPy."""

import functools

import jax
import numpy as np
import pytest
from cases import hover_rotor_state, vectors, with_states
from hypothesis import given

from crazysim import RotorAerodynamics, Sim, load_airframe
from crazysim.dynamics import inflow

R, RHO = 0.0275, 1.225
"""Radius of a propeller, m, and density of the air, kg/m^3."""
WEIGHT = 0.0434 * 9.81
HOVER = 1661.27  # rad/s: 4.407354891648379e-10 n^2 - 3.133427287299859e-7 n = 0.0434 * 9.81 / 4 at n = 15,864 rpm
DRAG_XY, DRAG_Z = 0.021643637770852733, 0.02477138502714662
"""Linear drag of the airframe across and along its z axis, N s/m."""
QUAD = {"control": "rotor_vel", "engine": "interpret"}


def hover(n_worlds=1, drone="cf21B_500", **settings):
    sim = Sim(n_worlds, drone=drone, **QUAD)
    sim.data = with_states(sim.data, pos=[0, 0, 1.0], rotor_vel=hover_rotor_state(sim.data))
    return sim, sim.add(RotorAerodynamics(**settings))


def wrench(sim, plugin, **states):
    """Return force, N, and torque, N m, that the plugin adds to each drone, world frame. (n_worlds, 3) each"""
    return compile_wrench(sim, plugin)(**states)


def compile_wrench(sim, plugin):
    influence = jax.jit(plugin.stage(plugin.influence))

    def wrench(**states):
        after = influence(with_states(sim.data, **states)).states
        return np.asarray(after.force, float)[:, 0], np.asarray(after.torque, float)[:, 0]

    return wrench


@pytest.fixture(scope="module")
def quad():
    return hover(3)


@pytest.fixture(scope="module")
def compiled_wrench(quad):
    return compile_wrench(*quad)


@functools.cache
def compiled_thrust():
    return jax.jit(inflow.thrust_in_flight)


def thrust(static, ang_vel, axial, across, blade, factor=1.0):
    """Return the thrust, N, of a rotor with a static thrust, at speeds, m/s, along its axis and across it."""
    with jax.enable_x64(True):
        values = [np.float64(x) for x in (static, ang_vel, axial, across**2, blade, R, RHO, factor)]
        return float(compiled_thrust()(*values))


def blade():
    disc = inflow.disc_factor(R, RHO)
    return float(inflow.blade_coefficient(DRAG_Z / 4, WEIGHT / 4, HOVER, disc))


@pytest.mark.parametrize("axial", [-0.5, 0.0, 1.0, 6.0])
@pytest.mark.parametrize("across", [0.0, 1.0, 5.0, 12.0])
@pytest.mark.parametrize("factor", [1.0, 1.8])
def test_the_thrust_solves_blade_element_and_momentum_theory(axial, across, factor):
    """The inflow is the positive root of ``(g 2 rho A)^2 (w - u)^2 (V^2 + w^2) = (B - b omega w)^2``."""
    static, speed, b = 0.1, 1600.0, blade()
    disc = 2 * RHO * np.pi * R**2
    lift = static + b * speed * np.sqrt(static / disc)
    lift *= 1 + 1.5 * across**2 / ((speed * R) ** 2 + across**2)
    momentum = (disc * factor**2) ** 2 * np.polymul(np.polymul([1, -axial], [1, -axial]), [1, 0, across**2])
    roots = np.roots(np.polysub(momentum, np.polymul([-b * speed, lift], [-b * speed, lift])))
    real = roots[np.abs(roots.imag) < 1e-9].real
    expected = lift - b * speed * real
    same_sign = (real > 0) & (np.sign(real - axial) * np.sign(expected) > 0)  # squares have lost the sign
    assert same_sign.sum() == 1
    # three Newton steps, and 1 mm/s in quadrature for stopped rotors
    np.testing.assert_allclose(thrust(static, speed, axial, across, b, factor), expected[same_sign][0], rtol=1e-5)


def test_the_thrust_by_hand():
    """b omega = 2 d y / (y - d), d = 6.193e-3, y = 0.10644 / 4.276 = 0.02489 N s/m: 0.01649 N s/m."""
    b = blade()
    np.testing.assert_allclose(b * HOVER, 0.01649, rtol=1e-3)
    # positive root of 5.821e-3 w^2 + (0.01649 - 5.821e-3) w = 0.10644 + 0.01649 * 4.276
    w = (-0.010669 + np.sqrt(0.010669**2 + 4 * 5.821e-3 * 0.17695)) / (2 * 5.821e-3)
    np.testing.assert_allclose(thrust(WEIGHT / 4, HOVER, 1.0, 0.0, b), 0.17695 - 0.01649 * w, rtol=1e-3)
    assert 0.0995 < 0.17695 - 0.01649 * w < 0.1015
    assert thrust(0.0, 0.0, 5.0, 5.0, b) == 0.0, "a stopped rotor gives none"


def test_a_ceiling_gives_thrust_by_mass_momentum_and_energy():
    """The far wake solves ``rho A v v_w = T - rho A v^2 (R / d)^2 / 16`` and ``T = rho A v_w^2 / 2`` at v = 1."""
    ceiling_factor = jax.jit(inflow.ceiling_factor)
    for gap in (0.1 * R, R, 5 * R):
        wake = max(np.roots([0.5, -1.0, -((R / gap) ** 2) / 16]))
        result = float(ceiling_factor(np.float64(gap), np.float64(R)))
        np.testing.assert_allclose(result, wake / 2, rtol=1e-5)
    assert ceiling_factor(np.float64(-1.0), np.float64(R)) == 1.0, "a rotor above it is in free air"


def test_near_hover_the_rotors_give_the_linear_drag_of_the_airframe(compiled_wrench):
    """The added wrench is zero in hover, and of second order for small velocities along the body's axes."""
    force, torque = compiled_wrench()
    np.testing.assert_allclose(force, 0.0, atol=1e-6)
    np.testing.assert_allclose(torque, 0.0, atol=1e-8)
    force, torque = compiled_wrench(vel=0.02 * np.eye(3)[:, None])
    # second order: 0.02 m/s over an induced velocity of 4.3 m/s, and rounding of float32 at 0.4 N
    np.testing.assert_allclose(force, 0.0, atol=0.02 * DRAG_Z * 0.01)
    np.testing.assert_allclose(
        torque, [[0, -0.014 * 0.02 * DRAG_XY, 0], [0.014 * 0.02 * DRAG_XY, 0, 0], [0, 0, 0]], atol=1e-8
    )


def test_rotor_drag_grows_with_the_speed_of_the_rotors(quad, compiled_wrench):
    """At twice the hover speed the drag is twice the airframe's: D v is added to that of the dynamics."""
    faster = 2 * hover_rotor_state(quad[0].data)
    force, _ = compiled_wrench(vel=[0.5, 0, 0], rotor_vel=faster)
    np.testing.assert_allclose(force[:, :2], np.broadcast_to([-0.5 * DRAG_XY, 0], (3, 2)), rtol=1e-3, atol=1e-6)


@given(vel=vectors(2, 8.0), rate=vectors(3, 3.0))
def test_law_08_drag_in_still_air_does_no_positive_work(compiled_wrench, vel, rate):
    """Across the axes of the rotors, and on rotation: the whole wrench with the linear drag of the dynamics."""
    force, _ = compiled_wrench(vel=[*vel, 0.0])
    drag = force[0, :2] - DRAG_XY * vel
    assert drag @ vel <= 1e-7
    np.testing.assert_allclose(drag, -DRAG_XY * vel, rtol=1e-3, atol=1e-6)
    _, torque = compiled_wrench(ang_vel=rate)
    assert torque[0] @ rate <= 1e-9


@pytest.fixture(scope="module")
def crazyflie_20():
    """The Crazyflie 2.0 of RotorPy 3.0.0 (BSD-3-Clause): mass, arm and thrust curve of its ``crazyflie_params``."""
    tables = dict(load_airframe("cf2x_L250").tables)
    arm = 0.043 * 0.70710678118
    position = np.array([[arm, arm, 0], [arm, -arm, 0], [-arm, -arm, 0], [-arm, arm, 0]])
    curve = np.array([0, 0, 2.3e-8 * (2 * np.pi / 60) ** 2])
    tables["rotors"] = dict(tables["rotors"]) | {"position": position, "thrust_curve": curve}
    tables["rigid_body"] = dict(tables["rigid_body"]) | {"mass": 0.03}
    sim = Sim(3, drone=tables, **QUAD)
    plugin = RotorAerodynamics(drag=10.2506e-7, inflow=7.553e-7, flapping=2e-8, hub_height=0.0)
    return sim, sim.add(plugin)


def test_the_wrench_is_that_of_rotorpy_where_both_models_are_linear(crazyflie_20):
    """``Multirotor(crazyflie_params).compute_body_wrench`` of RotorPy 3.0.0, aero=True less aero=False, k_flap = 2e-8.

    Rotors at 1788.55 rad/s, for the velocities, body rates and factors of the rotor speeds below. RotorPy's moment of
    flapping tips a drone into the direction of flight, ours back. Its thrust is linear in the axial velocity, ours has
    a curvature: 3 % at 0.15 m/s of an induced velocity of 4.2 m/s.
    """
    vel = np.array([[0.03, -0.02, 0.1], [0.01, 0.02, -0.15], [0.02, 0.01, 0.05]])
    rate = np.array([[0, 0, 0], [0.5, -0.4, 0.8], [1.0, -2.0, 0.5]])
    factor = np.array([[1, 1, 1, 1], [1, 1, 1, 1], [1.02, 0.98, 1.01, 0.99]])
    force = np.array([[-0.00022000459, 0.00014666973, -0.00054035689],
                      [-7.3334865e-05, -0.00014666973, 0.00081053533],
                      [-0.00014611228, -7.3334865e-05, -0.00027099994]])  # fmt: skip
    torque = np.array([[2.8616809e-06, 4.2925213e-06, 0],
                       [-5.3594806e-06, 3.4290802e-06, -1.0847693e-05],
                       [-6.6173825e-06, 1.2916937e-05, -6.7575103e-06]])  # fmt: skip
    sim, plugin = crazyflie_20
    speed = 1788.5505426 * factor
    states = {"vel": vel[:, None], "ang_vel": rate[:, None], "rotor_vel": 30 / np.pi * speed[:, None]}
    ours, moment = wrench(sim, plugin, **states)
    ours = ours - vel * [0.014953790232821078, 0.014953790232821078, 0.013900090000325344]  # the drag that is replaced
    hubs = np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]]) * 0.043 * 0.70710678118
    local = vel[:, None] + np.cross(rate[:, None], hubs)
    flapping = 2e-8 * np.sum(speed[..., None] * np.cross(local, [0.0, 0.0, 1.0]), axis=1)
    np.testing.assert_allclose(ours[:, :2], force[:, :2], rtol=1e-4, atol=1e-8)
    np.testing.assert_allclose(ours[:, 2], force[:, 2], rtol=0.03)
    np.testing.assert_allclose(moment - flapping, torque + flapping, rtol=0.04, atol=1e-8)
    assert np.abs(flapping[1:, :2] / torque[1:, :2]).max() > 0.1


def test_a_drone_tips_back_in_forward_flight_and_is_lifted_below_a_ceiling():
    sim, _ = hover(3, ceiling=[[50.0], [1.05], [1.02]])
    sim.data = with_states(sim.data, vel=np.array([[[2.0, 0, 0]], [[0, 0, 0]], [[0, 0, 0]]]))
    sim.rotor_vel_control(sim.data.states.rotor_vel)
    sim.step()
    rate, climb = np.asarray(sim.data.states.ang_vel)[:, 0], np.asarray(sim.data.states.vel)[:, 0, 2]
    np.testing.assert_allclose(rate[0, 1], -0.002 * 0.014 * 2 * DRAG_XY / 28e-6, rtol=1e-3)
    assert 0 < climb[1] < climb[2] < 0.002 * 9.81 * 0.66, "at most the thrust without inflow"
    gap = 1.02 - 1.014
    factor = 0.5 + 0.5 * np.sqrt(1 + (R / gap) ** 2 / 8)
    expected = 4 * thrust(WEIGHT / 4, HOVER, 0.0, 0.0, blade(), factor) - WEIGHT
    np.testing.assert_allclose(climb[2], 0.002 * expected / 0.0434, rtol=1e-3)


def test_terms_can_be_left_out_and_a_ceiling_below_the_drone_has_no_effect():
    """At 2 m/s: only drag, only thrust, neither, and a ceiling below and above the drone."""
    vel = [2.0, 0, 0]
    for settings, drag, lift in (
        ({"inflow": 0.0}, 2 * DRAG_XY, 0.0),
        ({"drag": 0.0}, 0.0, 4 * thrust(WEIGHT / 4, HOVER, 0.0, 2.0, blade()) - WEIGHT),
        ({"drag": 0.0, "inflow": 0.0}, 0.0, 0.0),
    ):
        force, torque = wrench(*hover(**settings), vel=vel)
        # the linear drag of the dynamics is taken off; 0.4 N in float32
        np.testing.assert_allclose(force[0], [2 * DRAG_XY - drag, 0, lift], rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(torque[0, 1], -0.014 * drag, rtol=1e-3, atol=1e-8)
    above, below = (wrench(*hover(ceiling=z), vel=vel) for z in (0.5, 1.05))
    np.testing.assert_array_equal(above[0], wrench(*hover(), vel=vel)[0])
    assert below[0][0, 2] > above[0][0, 2] + 1e-4
