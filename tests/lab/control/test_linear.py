"""The rigid-body models that controllers are designed on, and their linearisation."""

import jax
import numpy as np
import pytest
from cases import vectors
from hypothesis import given
from scipy.spatial.transform import Rotation

from crazysim.lab.control.linear_models import drone_derivative, linearize, load_derivative, rod_angles, rod_direction

pytestmark = pytest.mark.usefixtures("x64")

MASS, J, LOAD, LENGTH = np.array([0.605]), np.diag([1.5e-3, 1.45e-3, 2.66e-3]), np.array([0.05]), np.array([0.4])
"""Mass and inertia of the drone, mass of the load, and length of its rod, in SI units."""
GRAVITY = np.array([0, 0, -9.81])
drone = jax.jit(lambda x, u: drone_derivative(x, u, MASS, J, GRAVITY))
load = jax.jit(lambda x, u: load_derivative(x, u, MASS, J, GRAVITY, LOAD, LENGTH))


rod = jax.jit(lambda angles, rates: jax.jvp(rod_direction, (angles,), (rates,)))
angles_of_rod = jax.jit(rod_angles)
slopes_of_rod = jax.jit(jax.jacrev(rod_angles, argnums=(0, 1)))
linearize_load = jax.jit(lambda x, u: linearize(load, x, u))


def integrate(f, x, u, dt, n):
    for _ in range(n):
        k1 = f(x, u)
        k2 = f(x + dt / 2 * k1, u)
        k3 = f(x + dt / 2 * k2, u)
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + f(x + dt * k3, u))
    return np.asarray(x)


@given(rpy=vectors(3, 1.2), ang_vel=vectors(3, 3.0))
def test_euler_angles_turn_as_the_matrix_does(rpy, ang_vel):
    """d/dt R = R w^, by differences of 1e-5 s."""
    x = np.concatenate([np.zeros(6), rpy, ang_vel])
    after = integrate(drone, x, np.array([1.0, 0, 0, 0]), 1e-5, 1)
    before = Rotation.from_euler("ZYX", rpy[::-1])
    turned = (before.inv() * Rotation.from_euler("ZYX", after[8:5:-1])).as_rotvec()
    np.testing.assert_allclose(turned / 1e-5, ang_vel, atol=1e-4)


def energy(x):
    v, rates = x[3:6], x[14:16]
    q, q_rate = (np.asarray(value) for value in rod(x[12:14], rates))
    v_load, z_load = v + LENGTH * q_rate, x[2] + LENGTH * q[2]
    kinetic = 0.5 * MASS * v @ v + 0.5 * LOAD * v_load @ v_load
    return float((kinetic + 9.81 * (MASS * x[2] + LOAD * z_load))[0])


def test_drone_and_load_keep_energy_and_the_height_of_free_fall():
    x = np.zeros(16)
    x[3:6], x[12:16] = [1, 2, 3], [0.6, -0.4, 2.0, 3.0]
    after = integrate(load, x, np.zeros(4), 1e-3, 500)
    assert energy(after) == pytest.approx(energy(x), rel=1e-8)

    def centre(x):
        return (MASS * x[:3] + LOAD * (x[:3] + LENGTH * np.asarray(rod_direction(x[12:14])))) / (MASS + LOAD)

    slope = rod(x[12:14], x[14:16])[1]
    start_vel = (MASS * x[3:6] + LOAD * (x[3:6] + LENGTH * np.asarray(slope))) / (MASS + LOAD)
    np.testing.assert_allclose(centre(after), centre(x) + 0.5 * start_vel + 0.125 * GRAVITY, atol=1e-8)
    assert np.abs(after[12:14] - x[12:14]).max() > 0.3


def test_a_load_off_the_centre_keeps_energy_and_momentum():
    attach, still = np.array([0.05, -0.03, 0.02]), np.zeros(3)
    rates_off_centre = jax.jit(lambda x, u: load_derivative(x, u, MASS, J, still, LOAD, LENGTH, attach))
    x = np.linspace(-0.4, 0.5, 16)
    x[14:16] = [2.0, 3.0]

    def invariants(x):
        turn = Rotation.from_euler("ZYX", x[8:5:-1])
        q, q_rate = rod(x[12:14], x[14:16])
        pos = x[:3] + turn.apply(attach) + LENGTH * np.asarray(q)
        vel = x[3:6] + turn.apply(np.cross(x[9:12], attach)) + LENGTH * np.asarray(q_rate)
        spin = turn.apply(J @ x[9:12])
        angular = MASS * np.cross(x[:3], x[3:6]) + LOAD * np.cross(pos, vel) + spin
        energy = 0.5 * (MASS * x[3:6] @ x[3:6] + LOAD * vel @ vel + x[9:12] @ J @ x[9:12])
        return np.concatenate([MASS * x[3:6] + LOAD * vel, angular, [energy]])

    after = integrate(rates_off_centre, x, np.zeros(4), 1e-3, 300)
    np.testing.assert_allclose(invariants(after), invariants(x), rtol=1e-8, atol=1e-10)
    u = np.array([7.0, 0.01, -0.02, 0.003])
    centred = jax.jit(load_derivative)(x, u, MASS, J, GRAVITY, LOAD, LENGTH, np.zeros(3))
    np.testing.assert_allclose(centred, load(x, u), rtol=1e-10)


def test_a_small_swing_has_the_period_of_a_pendulum_on_a_free_body():
    """Thrust equal to the weight: w^2 = (g / L)(m + m_L) / m, by hand from the linearised equations."""
    A, _ = linearize_load(np.zeros(16), np.array([0.655 * 9.81, 0, 0, 0]))
    frequency = np.sqrt(9.81 / 0.4 * 0.655 / 0.605)
    np.testing.assert_allclose(A[14, 12], -(frequency**2), rtol=1e-12)
    np.testing.assert_allclose(A[15, 13], -(frequency**2), rtol=1e-12)


def test_the_linearisation_with_a_load_agrees_with_the_lab():
    A, B = (np.asarray(x) for x in linearize_load(np.zeros(16), np.array([0.655 * 9.81, 0, 0, 0])))
    assert round(float(A[3, 7]), 4) == 10.6207
    assert round(float(A[3, 13]), 4) == -0.8107
    assert round(float(A[14, 6]), 4) == 26.5519
    assert A[14, 12] == -A[14, 6]
    np.testing.assert_allclose(B[5], [1 / 0.655, 0, 0, 0])


def test_a_load_without_mass_does_not_change_the_drone():
    x, u = np.linspace(-0.3, 0.4, 16), np.array([7.0, 0.01, -0.02, 0.003])
    bare = jax.jit(load_derivative)(x, u, MASS, J, GRAVITY, np.zeros(1), LENGTH)[:12]
    np.testing.assert_allclose(bare, drone(x[:12], u), rtol=1e-12)


@given(angles=vectors(2, 1.4), rates=vectors(2, 5.0))
def test_rod_angles_are_the_inverse_of_the_direction(angles, rates):
    result, found_rates = angles_of_rod(*rod(angles, rates))
    np.testing.assert_allclose(result, angles, atol=1e-9)
    np.testing.assert_allclose(found_rates, rates, atol=1e-9 * (1 + np.abs(rates).max()))


@pytest.mark.parametrize("direction", [[0, 1.0, 0], [0, -1.0, 0], [0, 0, 1.0]])
def test_level_and_upright_rods_have_finite_angles_and_gradients(direction):
    slopes = slopes_of_rod(np.asarray(direction), np.array([0.1, 0.2, 0.3]))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(slopes))
