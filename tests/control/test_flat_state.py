"""State and wrench of a flat trajectory: they obey Newton's and Euler's laws, by finite differences in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from crazysim import rotation
from crazysim.control.flatness import flat_state
from crazysim.control.setpoint import Setpoint

pytestmark = pytest.mark.usefixtures("x64")

MASS, INERTIA = 0.5, np.array([[2e-3, 1e-4, 0.0], [1e-4, 3e-3, 2e-4], [0.0, 2e-4, 5e-3]])
"""Mass, kg, and inertia, kg m^2."""
GRAVITY = np.array([0.0, 0.0, -9.81])
STEP = 1e-4
"""Step of the central differences, s."""


def wave(amplitude, rate, phase, order, t):
    return amplitude * rate**order * jnp.sin(rate * t + phase + order * jnp.pi / 2)


def setpoint_on_curve(curve, t):
    amplitude, rate, phase, yaw = curve
    derivatives = [wave(amplitude, rate, phase, k, t) for k in range(5)]
    heading = [jnp.reshape(wave(*yaw, k, t), (1,)) for k in range(3)]
    return Setpoint(*derivatives, *heading)


state_at = jax.jit(lambda curve, t: flat_state(setpoint_on_curve(curve, t), MASS, INERTIA))
compute_state = jax.jit(lambda setpoint: flat_state(setpoint, MASS, INERTIA))
setpoint_at = jax.jit(setpoint_on_curve)
coefficients = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)


@given(
    amplitude=coefficients,
    rate=st.floats(0.3, 1.8),
    phase=coefficients,
    yaw=st.tuples(*[st.floats(-2, 2)] * 3),
    t=st.floats(0, 3),
)
def test_motion_obeys_newton_and_euler(amplitude, rate, phase, yaw, t):
    curve = (amplitude, rate, phase, yaw)
    before, now, after = (jax.tree.map(np.array, state_at(curve, t + h)) for h in (-STEP, 0.0, STEP))
    setpoint = jax.tree.map(np.asarray, setpoint_at(curve, t))
    np.testing.assert_allclose(now.thrust * rotation.z_axis(now.quat) / MASS + GRAVITY, setpoint.acc, atol=1e-12)
    yaw = setpoint.yaw[0]
    x_axis, y_axis, _ = Rotation.from_quat(now.quat).as_matrix().T
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0])
    np.testing.assert_allclose(y_axis @ ahead, 0.0, atol=1e-12)
    assert x_axis @ ahead > 0

    rotation_between = Rotation.from_quat(before.quat).inv() * Rotation.from_quat(after.quat)
    np.testing.assert_allclose(rotation_between.as_rotvec() / (2 * STEP), now.ang_vel, atol=1e-6)

    def momentum(state):
        return Rotation.from_quat(state.quat).apply(INERTIA @ np.asarray(state.ang_vel))

    rate_of_momentum = (momentum(after) - momentum(before)) / (2 * STEP)
    np.testing.assert_allclose(Rotation.from_quat(now.quat).apply(now.torque), rate_of_momentum, atol=1e-7)


def test_hover_takes_the_weight_and_no_torque():
    hover = Setpoint(*[np.zeros(3)] * 5, *[np.zeros(1)] * 3)
    state = compute_state(hover)
    np.testing.assert_allclose(state.thrust, [0.5 * 9.81])
    np.testing.assert_allclose(np.abs(state.quat), [0, 0, 0, 1])
    np.testing.assert_array_equal(state.torque, np.zeros(3))


def test_law_01_and_07_a_batch_equals_single_states_and_gradients_are_finite():
    """Values and gradients are finite, also in free fall and upside down, and values equal those of single states."""
    accelerations = np.array([[0, 0, 0], [0, 0, -9.81], [9.81, 0, -9.81], [0, 0, -30.0], [1.0, 2.0, 3.0]])
    ones = np.ones((5, 1))
    setpoints = Setpoint(*[np.ones((5, 3))] * 2, accelerations, *[np.ones((5, 3))] * 2, 0 * ones, ones, ones)
    batched = compute_state(setpoints)
    for k in range(5):
        single = compute_state(jax.tree.map(lambda x, k=k: x[k], setpoints))
        for a, b in zip(jax.tree.leaves(single), jax.tree.leaves(batched), strict=True):
            np.testing.assert_allclose(a, b[k], atol=1e-12)

    def total(setpoint):
        return sum(jnp.sum(x) for x in jax.tree.leaves(flat_state(setpoint, MASS, INERTIA)))

    assert all(np.isfinite(x).all() for x in jax.tree.leaves((batched, jax.jit(jax.grad(total))(setpoints))))
