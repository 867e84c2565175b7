"""Newton and Euler: against numpy, and the invariants of a free body."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from crazysim.dynamics.rigid_body import angular_acceleration, linear_acceleration

pytestmark = pytest.mark.usefixtures("x64")

vectors = arrays(np.float64, 3, elements=st.floats(-10, 10))
# A full inertia, kg m^2: positive definite, and such as a real body has.
J = np.array([[2.0, 0.3, -0.2], [0.3, 2.5, 0.1], [-0.2, 0.1, 3.5]])
accelerate = jax.jit(angular_acceleration)


@given(force=vectors, mass=st.floats(0.01, 10))
def test_linear_acceleration_is_newtons_law(force, mass):
    out = linear_acceleration(force, np.array([mass]), np.array([0.0, 0.0, -9.81]))
    np.testing.assert_allclose(out, force / mass + [0, 0, -9.81], rtol=1e-14)


@given(torque=vectors, ang_vel=vectors)
def test_angular_acceleration_is_eulers_equation(torque, ang_vel):
    """Its residual is rounding of terms up to 350 N m."""
    ang_acc = accelerate(torque, ang_vel, J, np.linalg.inv(J))
    np.testing.assert_allclose(J @ ang_acc + np.cross(ang_vel, J @ ang_vel), torque, atol=1e-11)


@given(ang_vel=vectors)
def test_law_08_a_free_body_keeps_energy_and_momentum(ang_vel):
    """Law 8: without torque the energy's rate w . J w' and the rate of |J w|^2 vanish, up to rounding of 1e4 terms."""
    ang_acc = accelerate(np.zeros(3), ang_vel, J, np.linalg.inv(J))
    assert abs(ang_vel @ J @ ang_acc) < 1e-11
    assert abs((J @ ang_vel) @ (J @ ang_acc)) < 1e-10


def test_angular_acceleration_by_hand():
    """J = diag(1, 2, 3), w = (1, 1, 1): w x J w = (1, -2, 1); with torque (2, 2, 4), J w' = (1, 4, 3)."""
    inertia = np.diag([1.0, 2.0, 3.0])
    out = accelerate(np.array([2.0, 2.0, 4.0]), np.ones(3), inertia, np.linalg.inv(inertia))
    np.testing.assert_allclose(out, [1, 2, 1], rtol=1e-15)
