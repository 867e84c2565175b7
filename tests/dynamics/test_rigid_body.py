"""Equations of Newton and Euler: compared with NumPy, invariants of a free body, and stability of its wobble."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from crazysim.dynamics.rigid_body import (
    MAX_EXPLICIT_ANGLE,
    MIN_STABLE_ANGLE,
    angular_acceleration,
    linear_acceleration,
    stable_angular_acceleration,
)

pytestmark = pytest.mark.usefixtures("x64")

vectors = arrays(np.float64, 3, elements=st.floats(-10, 10))
# A full inertia, kg m^2: positive definite, and such as a real body has.
J = np.array([[2.0, 0.3, -0.2], [0.3, 2.5, 0.1], [-0.2, 0.1, 3.5]])
NO_ROTORS = np.zeros(3)
accelerate = jax.jit(angular_acceleration)
accelerate_stably = jax.jit(stable_angular_acceleration)


@given(force=vectors, mass=st.floats(0.01, 10))
def test_linear_acceleration_is_newtons_law(force, mass):
    out = linear_acceleration(force, np.array([mass]), np.array([0.0, 0.0, -9.81]))
    np.testing.assert_allclose(out, force / mass + [0, 0, -9.81], rtol=1e-14)


@given(torque=vectors, ang_vel=vectors, rotor_momentum=vectors)
def test_angular_acceleration_is_eulers_equation(torque, ang_vel, rotor_momentum):
    """Its residual is rounding of terms up to 350 N m."""
    ang_acc = accelerate(torque, ang_vel, J, np.linalg.inv(J), rotor_momentum)
    gyroscopic = np.cross(ang_vel, J @ ang_vel + rotor_momentum)
    np.testing.assert_allclose(J @ ang_acc + gyroscopic, torque, atol=1e-11)


@given(ang_vel=vectors)
def test_law_08_a_free_body_keeps_energy_and_momentum(ang_vel):
    """Law 8: without torque the energy's rate w . J w' and the rate of |J w|^2 vanish, up to rounding of 1e4 terms."""
    ang_acc = accelerate(np.zeros(3), ang_vel, J, np.linalg.inv(J), NO_ROTORS)
    assert abs(ang_vel @ J @ ang_acc) < 1e-11
    assert abs((J @ ang_vel) @ (J @ ang_acc)) < 1e-10


def test_angular_acceleration_by_hand():
    """J = diag(1, 2, 3), w = (1, 1, 1): w x J w = (1, -2, 1); with torque (2, 2, 4), J w' = (1, 4, 3)."""
    inertia = np.diag([1.0, 2.0, 3.0])
    out = accelerate(np.array([2.0, 2.0, 4.0]), np.ones(3), inertia, np.linalg.inv(inertia), NO_ROTORS)
    np.testing.assert_allclose(out, [1, 2, 1], rtol=1e-15)


@given(torque=vectors, rotor_momentum=vectors, ang_vel=vectors, rate=st.floats(0, 20))
def test_slow_rotation_has_the_exact_derivative(torque, rotor_momentum, ang_vel, rate):
    """Up to 20 rad/s at 500 Hz an Euler step is explicit, to the last bit."""
    ang_vel = rate * ang_vel / max(np.linalg.norm(ang_vel), 1.0) * (1 - 1e-12)
    args = (torque, ang_vel, J, np.linalg.inv(J), rotor_momentum)
    np.testing.assert_array_equal(accelerate_stably(*args, MAX_EXPLICIT_ANGLE / 20), accelerate(*args))


@pytest.mark.parametrize("rotation_per_step", [MIN_STABLE_ANGLE + 1e-9, 0.12, 0.3, 0.6, 1.0])
def test_law_08_a_fast_spin_does_not_feed_its_wobble(rotation_per_step):
    """Law 8: a disc wobbles as fast as it spins, the worst case: |1 + z| of explicit Euler is 1 + x^2 / 2 and more.

    With ``theta = (1 + x^2) / 2`` the squared factor is ``1 - x^4 (3 - 2 x^2 - x^4) / 4``: damping of fourth order,
    which vanishes where a step rotates by 1 rad.
    """
    x, wobble, inertia = rotation_per_step, 1e-6, np.diag([1.0, 1.0, 2.0])
    dt = x / 60.0
    ang_vel = np.array([wobble, 0, 60.0])
    args = (np.zeros(3), ang_vel, inertia, np.linalg.inv(inertia), NO_ROTORS)
    explicit = ang_vel + dt * accelerate(*args)
    stable = ang_vel + dt * accelerate_stably(*args, dt)
    np.testing.assert_allclose(np.linalg.norm(explicit[:2]) / wobble, np.sqrt(1 + x**2), rtol=1e-9)
    factor = np.sqrt(1 - x**4 * (3 - 2 * x**2 - x**4) / 4)
    np.testing.assert_allclose(np.linalg.norm(stable[:2]) / wobble, factor, rtol=1e-9)
