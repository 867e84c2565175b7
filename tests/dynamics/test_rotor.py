"""Rotors: lag, curves and their inverse, and the torques, by hand and by their invariants."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from crazysim.drones import load_airframe
from crazysim.dynamics import first_principles
from crazysim.dynamics.rigid_body import angular_acceleration
from crazysim.dynamics.rotor import (
    quadratic_curve,
    reaction_torque,
    rotor_acceleration,
    rotor_momentum,
    rotor_torque,
    rotor_vel_of_thrust,
)

pytestmark = pytest.mark.usefixtures("x64")

speeds = arrays(np.float64, 4, elements=st.floats(0, 25_000))
vectors = arrays(np.float64, 3, elements=st.floats(-20, 20))
SIGN = np.array([-1.0, 1.0, -1.0, 1.0])
"""Sign of the yaw torque of each rotor."""
LAG = np.array([[14.0, 1.1e-4, 6.0, 3.2e-4]])
"""Linear and quadratic coefficients of a rotor that speeds up, then of one that slows down."""


def test_rotor_acceleration_by_hand():
    """Up from 10,000 to 12,000 rpm: 14 * 2000 + 1.1e-4 * 44e6 = 32840; down: -(6 * 2000 + 3.2e-4 * 44e6) = -26080."""
    up, down, still, _ = rotor_acceleration(
        np.array([12e3, 10e3, 5e3, 0]), np.array([10e3, 12e3, 5e3, 0]), np.asarray(LAG)
    )
    np.testing.assert_allclose([up, down, still], [32840, -26080, 0], rtol=1e-14)


def test_law_07_rotor_acceleration_has_the_gradient_of_one_side_where_rise_turns_into_fall():
    """At cmd = r the two sides' slopes differ, a + 2 b r; the gradient is the slope of the falling side, and finite."""
    rotor_vel = jnp.array([0.0, 10e3])
    slope = jax.vmap(jax.grad(lambda c, r: rotor_acceleration(c[None], r[None], LAG)[0]))(rotor_vel, rotor_vel)
    np.testing.assert_allclose(slope, 6.0 + 2 * 3.2e-4 * rotor_vel, rtol=1e-14)


@given(rotor_vel=speeds)
def test_curve_is_a_polynomial_one_for_all_or_one_per_rotor(rotor_vel):
    coefficients = np.array([[1e-3, -3e-7, 4e-10], [0, 1e-7, 5e-10], [0, 0, 6e-10], [2e-3, 0, 0]])
    expected = [np.polyval(k[::-1], r) for k, r in zip(coefficients, rotor_vel, strict=True)]
    np.testing.assert_allclose(quadratic_curve(rotor_vel, coefficients), expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(
        quadratic_curve(rotor_vel, coefficients[:1]),
        np.polyval(coefficients[0][::-1], rotor_vel),
        rtol=1e-12,
        atol=1e-15,
    )


@given(thrust=arrays(np.float64, 4, elements=st.floats(0, 0.3)))
def test_rotor_vel_of_thrust_undoes_the_curve(thrust):
    coefficients = np.array([[0.0, -3.1e-7, 4.4e-10]])
    np.testing.assert_allclose(
        quadratic_curve(rotor_vel_of_thrust(thrust, coefficients), coefficients), thrust, atol=1e-15
    )


def test_law_07_rotor_vel_of_thrust_is_finite_below_the_least_thrust_of_the_curve():
    coefficients = np.array([[0.0, -3.1e-7, 4.4e-10]])
    vertex = 3.1e-7 / (2 * 4.4e-10)
    thrust = jnp.array([-1.0, -1e-3, -(3.1e-7**2) / (4 * 4.4e-10), 0.0])
    speed, slope = jax.vmap(jax.value_and_grad(lambda f: rotor_vel_of_thrust(f[None], coefficients)[0]))(thrust)
    np.testing.assert_allclose(speed[:2], vertex, rtol=1e-12)
    assert np.all(np.isfinite(slope))


def test_rotor_torque_by_hand():
    """Crazyflie: thrust 0.1 N on the two left rotors, 3 and 4, arm 35.355 mm: roll torque 2 * 0.1 * 0.035355."""
    mixing = load_airframe("cf21B_500").mixing_matrix
    thrust, drag_torque = np.array([0, 0, 0.1, 0.1]), np.array([1e-4, 2e-4, 4e-4, 8e-4])
    torque = rotor_torque(thrust, drag_torque, np.array([0.035355]), mixing)
    np.testing.assert_allclose(torque, [0.007071, 0, 5e-4], atol=1e-18)


def test_law_08_gyroscopic_torque_of_a_rotor_by_hand():
    """A gyroscopic torque does no work, so tests of energy would not find a wrong size or sign.

    One rotor of 4e-8 kg m^2 at 15,000 rpm = 500 pi rad/s spins to the right, as its drag turns the body to the left:
    h = -2e-5 pi along z. Rolling with 2 rad/s: -w x h = -(2, 0, 5) x (0, 0, h) = (0, 2 h, 0) = (0, -4e-5 pi, 0).
    """
    momentum = rotor_momentum(np.array([0.0, 15_000.0, 0.0, 0.0]), SIGN, np.array([4e-8]))
    np.testing.assert_allclose(momentum, [0, 0, -2e-5 * math.pi], rtol=1e-14)
    ang_acc = angular_acceleration(np.zeros(3), np.array([2.0, 0.0, 5.0]), np.eye(3), np.eye(3), momentum)
    np.testing.assert_allclose(ang_acc, [0, -4e-5 * math.pi, 0], atol=1e-14)  # rounding of products of 10 N m


def test_reaction_torque_by_hand():
    """Speeding up by 30,000 rpm/s = 1000 pi rad/s^2, 4e-8 kg m^2: the body is turned as by the rotor's drag."""
    torque = reaction_torque(np.array([0.0, 30_000.0, 0.0, 0.0]), SIGN, np.array([4e-8]))
    np.testing.assert_allclose(torque, [0, 0, 4e-5 * math.pi], rtol=1e-14)


@given(rotor_vel=speeds, ang_vel=vectors)
def test_law_08_spinning_rotors_and_body_keep_their_angular_momentum(rotor_vel, ang_vel):
    inertia, acc = np.array([38.93e-9]), rotor_acceleration(np.full(4, 15e3), rotor_vel, LAG)
    spin = -SIGN * (2 * math.pi / 60) * inertia
    h, h_dot = np.array([0, 0, spin @ rotor_vel]), np.array([0, 0, spin @ acc])
    momentum, reaction = rotor_momentum(rotor_vel, SIGN, inertia), reaction_torque(acc, SIGN, inertia)
    torque = angular_acceleration(reaction, ang_vel, 0 * np.eye(3), np.eye(3), momentum)  # of a body without inertia
    np.testing.assert_allclose(torque, -(h_dot + np.cross(ang_vel, h)), atol=1e-16)


def test_saturate_turns_motors_off_or_keeps_them_within_their_limits():
    params = first_principles.Params.create(load_airframe("cf21B_500"))
    low, high = float(params.rotor_vel_min[0]), float(params.rotor_vel_max[0])
    cmd = np.array([-1.0, 0.0, 1.0, low + 1, high + 1, 1e9])
    np.testing.assert_allclose(first_principles.saturate(cmd, params), [0, 0, low, low + 1, high, high])
