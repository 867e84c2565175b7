"""Attitude, body rates and angular acceleration of a thrust vector and a yaw that change."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import vectors
from hypothesis import example, given
from hypothesis import strategies as st

from crazysim.control.flatness import attitude_of_thrust

pytestmark = pytest.mark.usefixtures("x64")

attitude = jax.jit(attitude_of_thrust)
slopes = jax.jit(jax.jacrev(attitude_of_thrust, argnums=(0, 1, 2, 3)))
angles = st.floats(-3.0, 3.0)


def vee(a):
    return np.array([a[2, 1], a[0, 2], a[1, 0]])


@jax.jit
def derivatives(f, yaw):
    """Return the first two derivatives of the rotation matrix by jax.jvp.

    Thrust and heading are quadratic motions, each a value, a rate and an acceleration.
    """

    def matrix(t):
        thrust = [f[0] + f[1] * t + f[2] * t**2 / 2, f[1] + f[2] * t, f[2]]
        heading = [yaw[0] + yaw[1] * t + yaw[2] * t**2 / 2, yaw[1] + yaw[2] * t, yaw[2]]
        return attitude_of_thrust(*thrust, *(jnp.reshape(x, (1,)) for x in heading)).matrix

    def rate(t):
        return jax.jvp(matrix, (t,), (1.0,))[1]

    return jax.jvp(rate, (0.0,), (1.0,))


@example(f=(np.array([3.0, -2, 1]), np.array([4.0, 5, 6]), np.array([7.0, -8, 9])), yaw=(0.5, 1.0, -2.0), up=1.0)
@given(
    f=st.tuples(vectors(3, 8.0), vectors(3, 20.0), vectors(3, 50.0)),
    yaw=st.tuples(angles, angles, angles),
    up=st.sampled_from([1.0, -1.0]),
)
def test_rates_are_the_derivatives_of_the_attitude(f, yaw, up):
    """Differentiated once and twice by jax.jvp: R' = R w^ and R'' = R (w^ w^ + a^), upside down too."""
    f = (f[0] + np.array([0, 0, up * 12.0]), *f[1:])
    now = attitude(*f, *(np.array([x]) for x in yaw))
    first, second = (np.asarray(x) for x in derivatives(f, yaw))
    matrix = np.asarray(now.matrix)
    np.testing.assert_allclose(now.ang_vel, vee(matrix.T @ first), atol=1e-9 * (1 + np.abs(first).max()))
    skew = matrix.T @ first
    np.testing.assert_allclose(
        now.ang_acc,
        vee(matrix.T @ second - skew @ skew),
        atol=1e-9 * (1 + np.abs(second).max() + np.abs(first).max() ** 2),
    )


def test_level_and_turning_by_hand():
    """Thrust along z that begins to lean to x at 1/s of its size turns about y; the yaw rate turns about z."""
    up, lean, zero = np.array([0, 0, 9.81]), np.array([9.81, 0, 0]), np.zeros(3)
    now = attitude(up, lean, zero, np.zeros(1), np.array([0.5]), np.array([0.25]))
    np.testing.assert_allclose(now.matrix, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(now.ang_vel, [0, 1, 0.5], atol=1e-15)
    np.testing.assert_allclose(now.ang_acc, [0.5, 0, 0.25], atol=1e-12)


@pytest.mark.parametrize(
    "thrust", [[0, 0, 0], [9.81, 0, 0], [-9.81, 0, 0], [0, 0, -9.81], [0, 9.81, 0], [1e-20, 0, 0], [0, 1e-3, 0]]
)
def test_singular_directions_give_rotations_and_finite_gradients(thrust):
    thrust, rate_of_thrust, ones = np.array(thrust, float), np.array([1.0, 2.0, 3.0]), np.ones(1)
    now = attitude(thrust, rate_of_thrust, rate_of_thrust, np.zeros(1), ones, ones)
    np.testing.assert_allclose(now.matrix.T @ now.matrix, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(now.matrix), 1.0)
    gradient = slopes(thrust, rate_of_thrust, rate_of_thrust, np.zeros(1), ones, ones)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((now, gradient)))
